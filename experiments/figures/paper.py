"""The paper's figures and Table 1 from the results of several runs."""

import concurrent.futures
import multiprocessing
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.figures.of_run import grouped_bars, task_language
from experiments.figures.strips import strip_of_all, strip_of_two
from experiments.figures.style import (
    STYLE,
    draw_cell_borders,
    fills_of,
    label_styles,
    new_figure,
    save,
    words,
)
from experiments.markdown import table
from experiments.standing import ABLATIONS, ADAPTIVE, EGOS, Results, compared, estimates
from experiments.summary import HEADLINE, ORACLE, mean, ratios, returns, shares, spread

TRAINING = "Haland, training sentences"
LEGEND_COLUMNS = 3
_MARKERS = "osD^vPX*<>"
"""Of styles, so that they can be told apart in grey."""


class Drawing(NamedTuple):
    """A figure of the paper.

    Attributes:
        title: what it shows.
        runs: picks the runs that have what it needs.
        draw: makes a figure of each, or one of all.
        together: whether one figure shows all runs.
    """

    title: str
    runs: Callable[[Results], bool]
    draw: Callable[..., Figure]
    together: bool = False


def normalised_returns(runs: Sequence[Results]) -> Figure:
    """Fig. 3: share of the Oracle by environment and method, with 95% intervals."""
    methods = compared(runs)
    groups: dict[str, Sequence[Results]] = {_short(run): [run] for run in runs}
    if len(runs) > 1:
        groups["all"] = runs
    rows = -(-len(methods) // LEGEND_COLUMNS)
    figure = new_figure(max(7.4, 1.7 * len(groups)), 3.0 + 0.2 * rows)
    axes = figure.add_subplot()
    fills = fills_of(methods)
    width, lacking = 0.84 / len(methods), False
    for index, method in enumerate(methods):
        found = [estimates(group, method) for group in groups.values()]
        offset = (index - (len(methods) - 1) / 2) * width
        for place, one in enumerate(found):
            if one is None:
                axes.text(place + offset, 0.0, "–", ha="center", va="bottom", color="#575757")
                lacking = True
        places = [place for place, one in enumerate(found) if one is not None]
        shown = [one for one in found if one is not None]
        if not shown:
            continue
        colour, hatch = fills[method]
        axes.bar(
            np.array(places) + offset,
            [one.value for one in shown], width, color=colour, hatch=hatch, edgecolor="black",
            linewidth=0.5, ecolor="black", label=method.removesuffix(", test sentences"),
            yerr=np.array([[one.value - one.low, one.high - one.value] for one in shown]).T,
            error_kw={"elinewidth": 0.9, "capsize": 2},
        )  # fmt: skip
    axes.axhline(1.0, color="black", linewidth=0.8, linestyle=":")
    axes.set_xticks(range(len(groups)), [words(name) for name in groups])
    axes.tick_params(axis="x", length=0)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_ylabel("return / Oracle, interquartile mean\n(whiskers: its 95% interval)")
    if lacking:
        axes.set_title("–: not measured", loc="right", fontsize=8)
    if axes.containers:
        figure.legend(loc="outside upper center", ncols=LEGEND_COLUMNS, frameon=False)
    return figure


def adaptive_egos(results: Results) -> Figure:
    """Fig. 4: return of each Adaptive Ego by training seed, below the Oracle's, by style."""
    styles = results["styles"]
    oracle = returns(results, ORACLE).mean(axis=1)
    trained = results["compared"]["universal"]
    played = np.asarray(trained["by_ego"][ADAPTIVE], float)  # [style, ego]
    seeds = min(trained["seeds"], played.shape[1])
    # An ego was asked for several times; its seeds came in turn.
    by_seed = np.array([played[:, seed::seeds].mean(axis=1) for seed in range(seeds)])
    values = np.concatenate([oracle[None], by_seed])
    figure = new_figure(2.6 + 0.62 * len(styles), 1.6 + 0.5 * len(values))
    axes = figure.add_subplot()
    share = shares(values, np.broadcast_to(oracle, values.shape))
    colours = matplotlib.colormaps["Blues"].with_extremes(bad="#eeeeee")
    image = axes.imshow(share, cmap=colours, vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        dark = share[row, column] > 0.6
        axes.text(
            column, row, f"{value:.0f}", ha="center", va="center", fontsize=8,
            color="white" if dark else "black",
        )  # fmt: skip
    names = [ORACLE, *(f"{ADAPTIVE}, seed {seed}" for seed in range(seeds))]
    axes.set_yticks(range(len(values)), names)
    label_styles(axes, styles)
    draw_cell_borders(axes, *values.shape)
    bar = figure.colorbar(image, ax=axes, shrink=0.9, aspect=20, pad=0.02)
    bar.set_label("share of the Oracle")
    bar.outline.set_linewidth(0.6)  # pyright: ignore[reportCallIssue]
    return figure


def sentence_embedding(results: Results) -> Figure:
    """Fig. 6a: t-SNE of translated sentences before and after BERT's fine-tuning."""
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    translations = results["compared"]["no-fine-tuning"]["translations"]
    figure = new_figure(7.2, 3.7)
    panels = figure.subplots(1, 2)
    colours = matplotlib.colormaps["tab10"]
    for axes, (when, spoken) in zip(panels, translations.items(), strict=True):
        train, test = (np.asarray(spoken[name], float) for name in ("train", "test"))
        flat = np.concatenate([part.reshape(-1, part.shape[-1]) for part in (train, test)])
        perplexity = min(15.0, (len(flat) - 1) / 4)
        # Threads wait busily: two take a hundred times as long as one beside another program.
        with threadpool_limits(1):
            places = TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(flat)
        first = train.shape[0] * train.shape[1]
        parts = (
            places[:first].reshape(*train.shape[:2], 2),
            places[first:].reshape(*test.shape[:2], 2),
        )
        for dots, size, edge in zip(parts, (18, 60), ("none", "black"), strict=True):
            for style, (of_style, marker) in enumerate(zip(dots, _MARKERS, strict=False)):
                axes.scatter(
                    of_style[:, 0], of_style[:, 1], s=size, marker=marker, linewidth=0.9,
                    color=colours(style % 10), edgecolor=edge,
                )  # fmt: skip
        axes.set_title(f"{when} fine-tuning (large, edged: test sentences)")
        axes.set_xticks([])
        axes.set_yticks([])
    handles = [
        Line2D([], [], color=colours(style % 10), marker=marker, linestyle="none")
        for style, marker in zip(range(len(results["styles"])), _MARKERS, strict=False)
    ]
    names = [words(style) for style in results["styles"]]
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    return figure


def sentences_by_style(results: Results) -> Figure:
    """Fig. 6b: return from training and from test sentences, by style."""
    methods = [ORACLE, TRAINING, HEADLINE]
    methods += [name for name in ("Without fine-tuning",) if name in results["methods"]]
    return grouped_bars(results, methods)


def ablation_bars(results: Results) -> Figure:
    """Table 1 as bars: return by style without a part of Haland."""
    return grouped_bars(results, table_1_methods(results))


def universal_learning(results: Results) -> Figure:
    """Not in the paper: how the universal egos learnt, and whether they had learnt all they could.

    Return of training games by environment steps of an ego, a line a kind (mean over its seeds). In
    the kitchens some of the games start at a random moment, with soups half made; their share falls
    in the second half of the training, and with it the return.
    """
    figure = new_figure(6.4, 3.6)
    axes = figure.add_subplot()
    for trained in results["compared"].values():
        for name, curves in trained.get("curve_returns", {}).items():
            number = EGOS.index(name) if name in EGOS else len(EGOS)
            axes.plot(
                np.asarray(trained["curve_steps"], float) / 1e6,
                np.asarray(curves, float).mean(axis=0),
                label=name, linewidth=1.4, markersize=4.5, markevery=4, markeredgewidth=0.5,
                marker=_MARKERS[number % len(_MARKERS)], color=fills_of([name])[name][0],
                markeredgecolor="black",
            )  # fmt: skip
    axes.set_xlabel("environment steps of an ego (millions)")
    axes.set_ylabel("return of training games")
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_xlim(left=0)
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def table_1_methods(results: Results) -> list[str]:
    """The columns of Table 1 that were measured."""
    return [
        name for name in (ORACLE, HEADLINE, *ABLATIONS)
        if name == ORACLE or name in results["methods"]
    ]  # fmt: skip


def table_1(results: Results) -> str:
    """Table 1 in Markdown: return ± deviation over held-out seeds, by style."""
    methods = table_1_methods(results)
    measured = {method: returns(results, method) for method in methods}
    rows = [
        (words(style), *(f"{values[index].mean():.1f} ± {spread(values[index]):.1f}"
                         for values in measured.values()))
        for index, style in enumerate(results["styles"])
    ]  # fmt: skip
    share = (f"{mean(ratios(results, method)):.2f}" for method in methods)
    rows.append(("**return / Oracle**", *share))
    return table(("partner", *methods), rows, "l" + "r" * len(methods))


def _short(results: Results) -> str:
    return results["environment"].split("/")[-1]


def _has(*names: str) -> Callable[[Results], bool]:
    return lambda run: all(name in run["methods"] for name in names)


FIGURES = {
    "figure_3": Drawing(
        "return of all methods in all environments", _has(HEADLINE), normalised_returns, True
    ),
    "figure_4": Drawing(
        "Adaptive Egos by training seed, beside the Oracle",
        lambda run: ADAPTIVE in run.get("compared", {}).get("universal", {}).get("by_ego", {}),
        adaptive_egos,
    ),
    "figure_5": Drawing(
        "what both players do, two styles", lambda run: "episodes" in run, strip_of_two
    ),
    "figure_12": Drawing(
        "what both players do, all styles", lambda run: "episodes" in run, strip_of_all
    ),
    "figure_6a": Drawing(
        "translated sentences before and after fine-tuning",
        lambda run: "translations" in run.get("compared", {}).get("no-fine-tuning", {}),
        sentence_embedding,
    ),
    "figure_6b": Drawing(
        "return from training and test sentences", _has(TRAINING, HEADLINE), sentences_by_style
    ),
    "figure_8_to_11": Drawing(
        "frequencies of events by style", lambda run: "task_language" in run, task_language
    ),
    "universal_learning": Drawing(
        "how universal egos learnt (not in the paper)",
        lambda run: any("curve_returns" in one for one in run.get("compared", {}).values()),
        universal_learning,
    ),
    "table_1": Drawing(
        "Haland without its parts",
        lambda run: any(name in run["methods"] for name in ABLATIONS),
        ablation_bars,
    ),
}


def draw_paper(
    runs: Sequence[Results],
    folder: Path,
    names: Collection[str] = FIGURES,
    *,
    processes: int = 1,
) -> dict[str, list[Path]]:
    """Draws all figures whose numbers are there.

    Args:
        runs: contents of results.json, one an environment.
        folder: where the files go; made if it is missing.
        names: which figures; all by default.
        processes: how many draw at the same time, an environment each; 1: none but this one.

    Returns:
        By figure, its files; a figure that no run has the numbers for has none.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The figures of an environment in one process, for what they share.
    tasks: dict[str, list[tuple[str, Sequence[Results]]]] = {}
    for name in names:
        having = [run for run in runs if FIGURES[name].runs(run)]
        if FIGURES[name].together and having:
            tasks.setdefault("", []).append((name, having))
        elif not FIGURES[name].together:
            for run in having:
                tasks.setdefault(_short(run), []).append((name, [run]))
    folders = [folder] * len(tasks)
    if processes > 1 and len(tasks) > 1:
        spawned = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(processes, spawned) as pool:
            found = list(pool.map(_draw, tasks.values(), folders))
    else:
        found = list(map(_draw, tasks.values(), folders))
    drawn: dict[str, list[Path]] = {name: [] for name in names}
    for some, files in zip(tasks.values(), found, strict=True):
        for (name, _), file in zip(some, files, strict=True):
            drawn[name].append(file)
    for run in runs:
        if "table_1" in names and FIGURES["table_1"].runs(run):
            file = folder / f"table_1_{_short(run)}.md"
            file.write_text(f"{table_1(run)}\n", encoding="utf-8")
            drawn["table_1"].append(file)
    return drawn


def _draw(tasks: Sequence[tuple[str, Sequence[Results]]], folder: Path) -> list[Path]:
    """Draws figures, each by name of the runs that it shows."""
    files = []
    for name, runs in tasks:
        together, draw = FIGURES[name].together, FIGURES[name].draw
        stem = name if together else f"{name}_{_short(runs[0])}"
        with matplotlib.rc_context(STYLE):
            files.append(save(draw(runs if together else runs[0]), folder, stem))
    return files
