"""The figures of a run, drawn from results.json alone, each as PNG and PDF."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from experiments.figures.style import (
    STYLE,
    TARGET,
    draw_cell_borders,
    fills_of,
    label_styles,
    new_figure,
    save,
    words,
    wrap,
)
from experiments.standing import EGOS
from experiments.summary import HEADLINE, METHODS, ORACLE, mean, ratios, returns, shares, spread
from experiments.summary import ordered_methods as methods_of


def draw_figures(results: Mapping[str, Any], folder: str | Path) -> list[Path]:
    """Draws every figure whose numbers are there.

    Args:
        results: the content of results.json.
        folder: where `<name>.png` and `<name>.pdf` go; made if it is missing.

    Returns:
        The PNG files, in the order of the report.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    for name, (needed, draw) in FIGURES.items():
        if any(key not in results for key in needed):
            continue
        with matplotlib.rc_context(STYLE):
            figure = draw(results)
            if figure is None:
                continue
            drawn.append(save(figure, folder, name))
    return drawn


def share_of_oracle(results: Mapping[str, Any]) -> Figure:
    """Return divided by the Oracle's, a bar a method, a dot a held-out seed."""
    methods = methods_of(results)
    figure = new_figure(7.2, 0.9 + 0.32 * len(methods))
    axes = figure.add_subplot()
    fills = fills_of(methods)
    for row, method in enumerate(methods):
        by_seed = np.asarray([mean(column) for column in ratios(results, method).T])
        centre = mean(ratios(results, method))
        colour, hatch = fills[method]
        axes.barh(row, centre, 0.72, color=colour, hatch=hatch, edgecolor="black", linewidth=0.6)
        offsets = np.linspace(-0.2, 0.2, by_seed.size) if by_seed.size > 1 else np.zeros(1)
        axes.plot(
            by_seed, row + offsets, "o", markersize=3, color="white", markeredgecolor="black",
            markeredgewidth=0.6, linestyle="none",
        )  # fmt: skip
        label = "–" if np.isnan(centre) else f"{centre:.2f} ± {spread(by_seed):.2f}"
        axes.text(1.02, row, label, transform=axes.get_yaxis_transform(), va="center")
    axes.axvline(TARGET, color="#c02020", linewidth=1.0, linestyle="--")
    axes.text(TARGET, -0.62, f"aim {TARGET}", ha="center", va="bottom", fontsize=8)
    axes.set_yticks(range(len(methods)), methods)
    axes.set_ylim(len(methods) - 0.45, -0.62)
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("return / Oracle (mean over styles; dots: held-out seeds)")
    return figure


def returns_by_style(results: Mapping[str, Any]) -> Figure:
    """Bars of the return by style, one for each step from the Oracle to Haland."""
    return grouped_bars(results, [name for name in methods_of(results) if name in METHODS])


def comparisons_by_style(results: Mapping[str, Any]) -> Figure | None:
    """Return by style: Haland beside universal egos, and below that beside all else; if any."""
    others = [name for name in methods_of(results) if name not in METHODS]
    ours = [name for name in (ORACLE, HEADLINE) if name in methods_of(results)]
    egos = [name for name in EGOS if name in others]
    rest = [name for name in others if name not in EGOS]
    panels = [[*ours, *some] for some in (egos, rest) if some]
    return grouped_bars(results, *panels) if panels else None


def learning_curves(results: Mapping[str, Any]) -> Figure:
    """Return in training, a panel a style: each seed, their mean, one standard deviation."""
    steps = np.asarray(results["curves"]["steps"], float)
    curves = results["curves"]["returns"]
    columns = min(4, len(curves))
    rows = -(-len(curves) // columns)
    figure = new_figure(2.3 * columns + 0.5, 1.75 * rows + 0.45)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    scale, unit = (1e6, " (millions)") if steps.max() >= 1e6 else (1e3, " (thousands)")
    for axes, (style, seeds) in zip(grid.flat, curves.items(), strict=False):
        seeds = np.asarray(seeds, float)
        centre = seeds.mean(axis=0)
        half = seeds.std(axis=0, ddof=1) if len(seeds) > 1 else np.zeros_like(centre)
        axes.fill_between(
            steps / scale, centre - half, centre + half, color="#8fc1e3", alpha=0.6, linewidth=0
        )
        axes.plot(steps / scale, seeds.T, color="#6d6d6d", linewidth=0.5, alpha=0.7)
        axes.plot(steps / scale, centre, color="#1f5fa8", linewidth=1.6)
        axes.set_title(words(style))
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.margins(x=0.01)
    for axes, above in zip(grid[-1], grid[-2] if rows > 1 else grid[-1], strict=True):
        if not axes.has_data():
            above.tick_params(labelbottom=True)
            axes.remove()
    figure.supxlabel(f"environment steps{unit}", fontsize=9)
    figure.supylabel("return per episode", fontsize=9)
    return figure


def task_language(results: Mapping[str, Any]) -> Figure:
    """Normalised event frequencies by style; a panel for each player that the events name."""
    events = results["task_language"]["events"]
    frequencies = np.asarray(results["task_language"]["v_hat"], float)  # [style, U]
    players = list(dict.fromkeys(_player(event) for event in events))
    columns = {
        player: [index for index, event in enumerate(events) if _player(event) == player]
        for player in players
    }
    tallest = max(len(indices) for indices in columns.values())
    width = 1.9 + 0.3 * len(results["styles"])
    figure = new_figure(width * len(players) + 0.8, 1.5 + 0.19 * tallest)
    grid = figure.subplots(1, len(players), squeeze=False)[0]
    image = None
    for axes, player in zip(grid, players, strict=True):
        indices = columns[player]
        image = axes.imshow(
            frequencies[:, indices].T, cmap="Blues", vmin=0, vmax=1, aspect="auto"
        )  # fmt: skip
        names = [words(events[index].partition(":")[2] or events[index]) for index in indices]
        axes.set_yticks(range(len(indices)), names, fontsize=7.5)
        label_styles(axes, results["styles"])
        draw_cell_borders(axes, len(indices), len(results["styles"]))
        if player:
            axes.set_title(f"events of the {player}")
    if image is not None:
        bar = figure.colorbar(image, ax=list(grid), shrink=0.6, aspect=25, pad=0.02)
        bar.set_label("normalised frequency")
        bar.outline.set_linewidth(0.6)  # pyright: ignore[reportCallIssue]
    return figure


def cross_play(results: Mapping[str, Any]) -> Figure:
    """Return of the best responses of each style with held-out partners of each style.

    A cell also has the share of the Oracle of the partner's style, which colours it.
    """
    values = np.asarray(results["cross_play"], float)  # [ego's style, partner's style]
    styles = results["styles"]
    oracle = np.broadcast_to(returns(results, ORACLE).mean(axis=1), values.shape)
    share = shares(values, oracle)
    figure = new_figure(2.6 + 0.62 * len(styles), 2.1 + 0.5 * len(styles))
    axes = figure.add_subplot()
    colours = matplotlib.colormaps["Blues"].with_extremes(bad="#eeeeee")
    image = axes.imshow(share, cmap=colours, vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        of_oracle = share[row, column]
        shown = "–" if np.isnan(of_oracle) else f"{of_oracle:.0%}"
        axes.text(
            column, row, f"{value:.0f}\n{shown}", ha="center", va="center", fontsize=8,
            color="white" if of_oracle > 0.6 else "black", linespacing=1.1,
            fontweight="bold" if row == column else "normal",
        )  # fmt: skip
    axes.set_yticks(range(len(styles)), [words(style) for style in styles])
    label_styles(axes, styles)
    draw_cell_borders(axes, *values.shape)
    axes.set_ylabel("ego: best response to the style")
    axes.set_xlabel("held-out partners of the style")
    bar = figure.colorbar(image, ax=axes, shrink=0.8, aspect=25, pad=0.02)
    bar.set_label("share of the Oracle of the partner's style")
    bar.outline.set_linewidth(0.6)  # pyright: ignore[reportCallIssue]
    return figure


def grouped_bars(results: Mapping[str, Any], *panels: Sequence[str]) -> Figure:
    """Bars of the return by style, a bar a method, a dot a held-out partner.

    Args:
        results: the content of results.json.
        panels: the methods of each panel.
    """
    styles = results["styles"]
    methods = list(dict.fromkeys(method for panel in panels for method in panel))
    figure = new_figure(max(6.0, 1.35 * len(styles)), 1.2 + 2.7 * len(panels))
    fills, labelled = fills_of(methods), set()
    every = figure.subplots(len(panels), 1, sharey=True, squeeze=False)[:, 0]
    for axes, shown in zip(every, panels, strict=True):
        width = 0.84 / len(shown)
        for index, method in enumerate(shown):
            values = returns(results, method)  # [style, seed]
            places = np.arange(len(styles)) + (index - (len(shown) - 1) / 2) * width
            colour, hatch = fills[method]
            axes.bar(
                places, values.mean(axis=1), width, color=colour, hatch=hatch, edgecolor="black",
                linewidth=0.5, label=None if method in labelled else method,
            )  # fmt: skip
            labelled.add(method)
            axes.plot(
                np.repeat(places, values.shape[1]), values.ravel(), "o", markersize=2.2,
                color="white", markeredgecolor="black", markeredgewidth=0.5, linestyle="none",
            )  # fmt: skip
        axes.set_xticks(range(len(styles)), [wrap(style) for style in styles])
        axes.tick_params(axis="x", length=0)
        axes.set_axisbelow(True)
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.margins(x=0.01)
        axes.set_ylabel("return per episode\n(dots: held-out partners)")
    figure.legend(loc="outside upper center", ncols=min(4, len(methods)), frameon=False)
    return figure


def _player(event: str) -> str:
    return event.partition(":")[0] if ":" in event else ""


# Name of the file -> what of results.json it needs, and the function that draws it.
FIGURES: dict[str, tuple[tuple[str, ...], Callable[[Mapping[str, Any]], Figure | None]]] = {
    "share_of_oracle": (("methods", "oracle"), share_of_oracle),
    "returns_by_style": (("methods", "oracle"), returns_by_style),
    "comparisons_by_style": (("methods", "oracle"), comparisons_by_style),
    "cross_play": (("cross_play", "oracle"), cross_play),
    "learning_curves": (("curves",), learning_curves),
    "task_language": (("task_language",), task_language),
}
