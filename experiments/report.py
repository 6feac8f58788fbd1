"""The run's report for a reader who was not there, and its summary for the terminal."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from experiments.figures import draw_figures
from experiments.markdown import table as _table
from experiments.standing import lowest, standings
from experiments.summary import (
    COMPARISONS,
    HEADLINE,
    METHODS,
    MOST_FROM_A_WRONG_SENTENCE,
    ORACLE,
    PARTNER_SIGHT,
    UNIVERSAL,
    UNIVERSAL_WITH_LABEL,
    WRONG,
    MethodSummary,
    dead_partners,
    mean,
    ordered_methods,
    ratios,
    return_digits,
    returns,
    sight_shares,
    spread,
    summarise,
)
from experiments.worth import steps_in_words, worth_of_the_style

_AIM = 0.95
_NOTABLE_FALL = 0.1
_WORTH_FIGURE = "cross_play"
_MEANING = {
    ORACLE: "the best of several egos refitted to that very partner: the upper bound",
    "Best response": "the archived egos of the same style, which never met these partners: the "
    "ceiling of all below",
    "VAE reconstruction": "the same egos after encoding and decoding",
    "Diffusion, true task language": "policies drawn from the diffusion model, given the measured "
    "event frequencies",
    "Haland, training sentences": "policies from sentences that the translator was trained on, at "
    "most 40 of a style",
    HEADLINE: "policies from sentences that it was not trained on, one sample each: **the "
    "headline**",
    WRONG: "policies from another style's sentence: the control, which must fall",
}
_CAPTIONS = {
    "share_of_oracle": "Return divided by the Oracle's, with the standard deviation over held-out "
    "seeds.\nEach dot is one held-out seed, averaged over the styles.",
    "returns_by_style": "Return with held-out partners by style; each dot is one of them.\nEach "
    "bar adds one step of the method: what a bar loses to the one on its left is that step's cost.",
    "comparisons_by_style": "The same for universal egos and, below them, for ablations and other "
    "methods, beside the Oracle and Haland.\nA baseline as tall as Haland means that in this "
    "style the sentence was not needed.",
    "cross_play": "Best responses to each style with held-out partners of every style: return, and "
    "below it the share of the Oracle of the partner's style.\nA dark diagonal means that knowing "
    "the partner's style pays; an even row means an ego that suits everyone.",
    "learning_curves": "Return in training: each seed (grey), their mean and one standard "
    "deviation.\nA curve that stays low is a partner that did not learn, and makes an Oracle that "
    "says little.",
    "task_language": "Normalised event frequencies, from which Eq. 8 makes the task language.\n"
    "Two columns that look alike are two styles that the diffusion model cannot tell apart.",
}


def write_report(results: Mapping[str, Any], folder: str | Path) -> Path:
    """Draws the figures into `folder`/figures and writes `folder`/report.md.

    Args:
        results: the content of results.json; the parts that it lacks are left out. Further
            methods may be described in its "descriptions", {method: text}.
        folder: the run's folder. Recordings in figures/episodes/<style>.gif are shown as well.

    Returns:
        The report's path.

    Raises:
        UserError: the results contradict themselves, such as a method without one of the styles.
    """
    folder = Path(folder)
    figures = draw_figures(results, folder / "figures")
    report = folder / "report.md"
    writing = report.with_name(".report.md.writing")
    writing.write_text(report_text(results, folder, figures), encoding="utf-8")
    writing.replace(report)
    return report


def report_text(results: Mapping[str, Any], folder: Path, figures: Sequence[Path]) -> str:
    """The report in `folder` with those figures; see `write_report`."""
    sections = [
        _opening(results),
        _headline(results),
        _gates(results),
        _by_style(results),
        _worth(results, figures),
        _standings(results),
        _translator(results),
        _memorisation(results),
        _figures(figures),
        _episodes(results, folder),
        _costs(results),
    ]
    return "\n\n".join(filter(None, sections)) + "\n"


def summary_table(results: Mapping[str, Any]) -> Table:
    """The headline table for the terminal."""
    table = Table(
        title=f"{results['environment']}, preset {results['preset']}", title_justify="left"
    )
    table.add_column("method")
    rows = summarise(results)
    for name in _columns(rows, "of the Oracle"):
        table.add_column(name, justify="right")
    for row in rows:
        style = "bold" if row.method == HEADLINE else ""
        table.add_row(row.method, *_numbers(row, rows), style=style)
    for name, gate in results.get("gates", {}).items():
        verdict = "[green]met[/]" if gate["met"] else "[red]missed[/]"
        table.add_row(f"gate: {name}", _number(gate["value"]), _bar(gate), verdict)
    return table


def _bar(gate: Mapping[str, Any]) -> str:
    return f"{'≤' if gate.get('at_most') else '≥'} {_number(gate['bar'])}"


def _opening(results: Mapping[str, Any]) -> str:
    seeds = returns(results, ORACLE).shape[1]
    return (
        f"# {results['environment']}, preset `{results['preset']}`, seed {results['seed']}\n\n"
        f"{_verdict(results)}\n\n"
        f"All returns are with held-out partners, {len(results['styles'])} styles × {seeds} seeds, "
        "that no learnt part has met; only the Oracle was fitted to them."
    )


def _verdict(results: Mapping[str, Any]) -> str:
    """The finding in two or three sentences, good or bad."""
    rows = {row.method: row for row in summarise(results)}
    if HEADLINE not in rows or np.isnan(rows[HEADLINE].ratio):
        return "Haland was not measured from test sentences in this run."
    headline, digits = rows[HEADLINE], return_digits(row.mean for row in rows.values())
    reached = "reaches the aim of" if headline.ratio >= _AIM else "misses the aim of"
    said = [
        f"From sentences it was not trained on, Haland earns **{headline.ratio:.0%} of the "
        f"Oracle** ({_with_spread(headline.mean, headline.std, digits)} per episode): "
        f"it {reached} {_AIM:.0%}."
    ]
    if "Best response" in rows and rows["Best response"].ratio > 0:
        ceiling = rows["Best response"].ratio
        said.append(
            f"Its ceiling, the archived best responses, is at {ceiling:.0%}, of which Haland "
            f"keeps {headline.ratio / ceiling:.0%}."
        )
    if WRONG in rows:
        wrong = rows[WRONG].ratio
        if wrong <= MOST_FROM_A_WRONG_SENTENCE:
            judgement = "the sentence matters"
        elif headline.ratio - wrong > _NOTABLE_FALL:
            judgement = "the sentence matters, but an ego made for another style gets far here"
        else:
            judgement = "the sentence hardly matters here"
        said.append(f"With a wrong sentence it earns {wrong:.0%}: {judgement}.")
    missed = [name for name, gate in results.get("gates", {}).items() if not gate["met"]]
    if missed:
        said.append(f"**Gates missed: {'; '.join(missed)}.**")
    return " ".join(said)


def _headline(results: Mapping[str, Any]) -> str:
    meaning = {**_MEANING, **_universal(results), **results.get("descriptions", {})}
    summary = summarise(results)
    rows = [(row.method, *_numbers(row, summary), meaning.get(row.method, "")) for row in summary]
    head = ("method", *_columns(summary, "return / Oracle"), "what it is")
    table = _table(head, rows, "l" + "r" * (len(head) - 2) + "l")
    note = (
        "Mean ± sample standard deviation over the held-out seeds, of each seed's mean over "
        "styles. The ratio divides each partner's return by that partner's own Oracle. *IQM*: the "
        "interquartile mean of those ratios over styles and held-out seeds, with its stratified "
        "bootstrap interval (Agarwal et al., 2021)."
    )
    if dead := dead_partners(results):
        note += (
            f" **Left out of the ratio: {dead} held-out partners whose Oracle is zero or less.**"
        )
    return f"## Returns\n\n{table}\n\n{note}"


def _gates(results: Mapping[str, Any]) -> str:
    if not results.get("gates"):
        return ""
    rows = [
        (name, _number(gate["value"]), _bar(gate), "met" if gate["met"] else "**missed**")
        for name, gate in results["gates"].items()
    ]
    return (
        f"## Gates\n\n{_table(('gate', 'value', 'bar', ''), rows, 'lrrl')}\n\n"
        "A gate is checked before the next stage builds on its stage.\nA missed one bounds "
        "everything after it, however well that was trained."
    )


def _by_style(results: Mapping[str, Any]) -> str:
    methods = [name for name in ordered_methods(results) if name in (*METHODS, *COMPARISONS)]
    tables = {name: (returns(results, name), ratios(results, name)) for name in methods}
    bounds = results.get("upper_bounds")
    digits = return_digits(values.mean() for values, _ in tables.values())
    rows = []
    for index, style in enumerate(results["styles"]):
        cells = []
        for method, (values, shares) in tables.items():
            share = mean(shares[index])
            of_oracle = "" if method == ORACLE or np.isnan(share) else f" ({share:.2f})"
            centre, deviation = values[index].mean(), spread(values[index])
            cells.append(_with_spread(centre, deviation, digits) + of_oracle)
        if bounds:
            of_bound = tables[ORACLE][0][index].mean() / bounds[style]
            cells += [f"{bounds[style]:g}", f"{of_bound:.2f}"]
        rows.append((style.replace("_", " "), *cells))
    head = ("style", *methods, *(("upper bound", "Oracle / bound") if bounds else ()))
    table = _table(head, rows, "l" + "r" * (len(head) - 1))
    note = "Return ± deviation over seeds; in brackets the share of the Oracle."
    if bounds:
        note += " No two players, whatever they know, can exceed the upper bound."
    return f"## By style\n\n{table}\n\n{note}"


def _universal(results: Mapping[str, Any]) -> dict[str, str]:
    """What the universal egos are, with the budget that they had."""
    if not (trained := results.get("universal")):
        return {}
    what = (
        "one feed-forward ego trained with all partners of all styles that are not held out "
        f"({steps_in_words(trained['steps'])} steps), {{}} the style's label"
    )
    if guided := trained.get("guided_steps"):
        what += f"; for the first {steps_in_words(guided)} steps the pairs' egos guide it"
    return {UNIVERSAL: what.format("without"), UNIVERSAL_WITH_LABEL: what.format("with")}


def _worth(results: Mapping[str, Any], figures: Iterable[Path]) -> str:
    shown = [_shown(file) for file in figures if file.stem == _WORTH_FIGURE]
    parts = list(filter(None, [worth_of_the_style(results), *shown, _sights(results)]))
    return "\n\n".join(["## What the style is worth", *parts]) if parts else ""


def _standings(results: Mapping[str, Any]) -> str:
    """Haland beside the methods that were compared with it."""
    found = standings(results)
    if "compared" not in results or not found:
        return ""
    ours = ratios(results, HEADLINE)
    headline = f"{mean(ours):.2f} ({lowest(ours):.2f})"
    rows = [(HEADLINE, str(found[0].haland), headline, "", "", "", "")]
    for one in found:
        steps = "–" if one.steps is None else steps_in_words(one.steps)
        budget = "–" if one.budget is None else f"{one.budget:.0%}"
        means = f"{one.mean:.2f} ({one.lowest:.2f})"
        verdict = f"**{one.verdict}**"
        rows.append((one.method, str(one.share), means, one.lead.signed, verdict, steps, budget))
    head = (
        *("method", "return / Oracle, IQM (95%)", "mean (lowest style)", "Haland's lead (95%)"),
        *("Haland is", "steps", "of all best responses'"),
    )
    return (
        f"## Beside other methods\n\n{_table(head, rows, 'lrrrlrr')}\n\n"
        "With the same held-out partners. *Lead*: the mean of the differences in return / Oracle "
        "with each partner. *Level*: its interval has 0 in it. *Steps*: environment steps of each "
        "ego, and as a share of those of all best responses together."
    )


def _sights(results: Mapping[str, Any]) -> str:
    """The same for egos that see the partner only nearby, where that was measured."""
    if not results.get(PARTNER_SIGHT):
        return ""
    rows = [
        (seen, *(f"{mean(by_method[method]):.3f}" for method in COMPARISONS))
        for seen, by_method in sight_shares(results).items()
    ]
    table = _table(("ego sees the partner", *COMPARISONS), rows, "lrr")
    return (
        f"{table}\n\nShare of the Oracle, which sees the partner everywhere. Partners and kitchen "
        "are the same;\nonly the ego's view of the partner ends at that many rows and columns."
    )


def _translator(results: Mapping[str, Any]) -> str:
    if not (translator := results.get("translator")):
        return ""
    text = (
        f"## Translator\n\n{translator['accuracy']:.0%} of the test sentences are translated "
        "into their own style rather than another."
    )
    by_style = translator.get("by_style", {})
    imperfect = [
        f"{style.replace('_', ' ')} {share:.0%}" for style, share in by_style.items() if share < 1
    ]
    if imperfect:
        text += f"\nStyles with mistakes: {', '.join(imperfect)}."
    return text


def _memorisation(results: Mapping[str, Any]) -> str:
    if not (measured := results.get("memorisation")):
        return ""
    rows = [(name.replace("_", " "), _number(value)) for name, value in measured.items()]
    return (
        f"## Memorisation\n\n{_table(('measure', 'value'), rows, 'lr')}\n\n"
        "How far generated latents are from the nearest training latent.\nFar less than training "
        "latents are from each other means that policies are copied, not generated."
    )


def _figures(figures: Iterable[Path]) -> str:
    shown = [_shown(file) for file in figures if file.stem != _WORTH_FIGURE]
    return "## Figures\n\n" + "\n\n".join(shown) if shown else ""


def _shown(file: Path) -> str:
    return f"![{file.stem.replace('_', ' ')}](figures/{file.name})\n\n{_CAPTIONS[file.stem]}"


def _episodes(results: Mapping[str, Any], folder: Path) -> str:
    recorded = [
        (style.replace("_", " "), f"![{style}](figures/episodes/{style}.gif)")
        for style in results["styles"]
        if (folder / "figures" / "episodes" / f"{style}.gif").is_file()
    ]
    if not recorded:
        return ""
    table = _table(("style", "episode"), recorded, "ll")
    return f"## Episodes\n\nGenerated egos with held-out partners.\n\n{table}"


def _costs(results: Mapping[str, Any]) -> str:
    parts = []
    if times := results.get("times"):
        rows = [(stage.replace("_", " "), f"{seconds:,.1f}") for stage, seconds in times.items()]
        rows.append(("**all**", f"**{sum(times.values()):,.1f}**"))
        parts.append("## Time\n\n" + _table(("stage", "seconds"), rows, "lr"))
    if machine := results.get("machine"):
        rows = [(name.replace("_", " "), str(value)) for name, value in machine.items()]
        parts.append("## Machine\n\n" + _table(("", ""), rows, "ll"))
    return "\n\n".join(parts)


def _columns(rows: Sequence[MethodSummary], ratio: str) -> tuple[str, ...]:
    """Heads of what `_numbers` gives."""
    success = ("success",) if any(row.success is not None for row in rows) else ()
    return ("return", ratio, "IQM (95%)", *success, "episodes")


def _numbers(row: MethodSummary, rows: Sequence[MethodSummary]) -> tuple[str, ...]:
    """A row's cells under `_columns(rows, …)`."""
    count = "–" if row.episodes is None else f"{row.episodes:,}"
    ratio = "–" if np.isnan(row.ratio) else f"{row.ratio:.3f} ± {row.ratio_std:.3f}"
    success = ("–",) if row.success is None else (f"{row.success:.0%}",)
    success = success if any(other.success is not None for other in rows) else ()
    interval = "–" if row.interval is None or row.method == ORACLE else str(row.interval)
    digits = return_digits(other.mean for other in rows)
    return _with_spread(row.mean, row.std, digits), ratio, interval, *success, count


def _with_spread(centre: float, deviation: float, digits: int) -> str:
    return f"{centre:.{digits}f} ± {deviation:.{digits}f}"


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
