"""The pages that compare recorded environments, as Markdown."""

from collections.abc import Callable, Mapping, Sequence

import envs
from experiments.intervals import Estimate
from experiments.markdown import table
from experiments.overview import Overview, number, percent
from experiments.run_all import ALL, default_path
from experiments.standing import PLACES, improvement_in_words, in_order
from experiments.summary import COMPARISONS, HEADLINE
from experiments.worth import steps_in_words

AIM = 0.95
_Column = tuple[str, Callable[[Overview], str], str]

_ENVIRONMENT: _Column = (
    "environment",
    lambda row: f"[{row.environment}]({row.environment}/report.md)",
    "leads to the run's full report.",
)
_SHARE: _Column = (
    "Haland / Oracle",
    lambda row: f"**{number(row.share, 3)}**",
    f"the same divided by each partner's own Oracle: the headline. The aim is {AIM}.",
)
_MEASURED: tuple[_Column, ...] = (
    _ENVIRONMENT,
    (
        "Oracle",
        lambda row: row.amount_with_spread(row.oracle),
        "return per episode of an ego that was trained for that very held-out partner; mean over "
        "styles, ± the standard deviation over held-out seeds.",
    ),
    (
        "upper bound",
        lambda row: row.amount(row.upper_bound),
        "a return that no pair of players can exceed, worked out from the rules without learning; "
        "mean over styles.",
    ),
    (
        "Oracle / bound",
        lambda row: _with_lowest(row.oracle_of_bound, row.lowest_oracle_of_bound),
        "how good the Oracle itself is: mean over styles, in brackets the lowest style. Shares "
        "of a weak Oracle say little.",
    ),
    (
        "ceiling",
        lambda row: number(row.ceiling, 2),
        "best response / Oracle: the archived egos of the same style with partners that they "
        "have not met. Haland is generated from them, so it is measured against this too.",
    ),
    (
        "Haland",
        lambda row: row.amount_with_spread(row.haland),
        "return with held-out partners from test sentences, which no part was trained on; one "
        "sample each, no trial episodes.",
    ),
    _SHARE,
    (
        "wrong sentence",
        lambda row: number(row.wrong_share, 2),
        "Haland / Oracle from another style's sentence: the control, which must fall.",
    ),
    (
        "success",
        lambda row: _success(row.successes),
        "share of the games that succeed with Haland from test sentences, in brackets with the "
        "Oracle; – where games only earn a return.",
    ),
    (
        "translator",
        lambda row: percent(row.accuracy),
        "share of the test sentences that are translated into their own style.",
    ),
    (
        "gates met",
        lambda row: f"{row.gates_met} of {row.gates}",
        "bars that the stages set themselves before the next one builds on them.",
    ),
)
_WORTH: tuple[_Column, ...] = (
    _ENVIRONMENT,
    (
        "own style",
        lambda row: row.amount(row.diagonal),
        "best responses with partners of their style.",
    ),
    (
        "other styles",
        lambda row: row.amount(row.off_diagonal),
        "the same egos with partners of the seven other styles.",
    ),
    (
        "universal ego",
        lambda row: row.amount(row.universal),
        "one ego without a memory, trained with the partners of all styles and told nothing; that "
        "which learnt longest.",
    ),
    (
        "universal ego, told",
        lambda row: row.amount(row.universal_with_label),
        "the same, told the partner's style in every observation.",
    ),
    (
        "Haland",
        lambda row: row.amount(row.haland[0] if row.haland else None),
        "from test sentences.",
    ),
)
_HOW: tuple[_Column, ...] = (
    _ENVIRONMENT,
    ("preset", lambda row: f"`{row.preset}`", ""),
    ("seed", lambda row: str(row.seed), ""),
    ("held-out partners", lambda row: f"{row.styles} styles × {row.held_out_seeds} seeds", ""),
    ("minutes", lambda row: number(row.minutes), ""),
    ("machine", lambda row: row.machine or "–", ""),
    ("date", lambda row: row.date or "–", ""),
)


def page(
    overviews: Sequence[Overview],
    remarks: str,
    picture: str = "",
    options: str = "",
    overall: Mapping[str, Estimate] | None = None,
) -> str:
    """The page of all recorded results.

    Args:
        overviews: a row for each recorded environment, in order.
        remarks: Markdown by hand, included as it is; empty for none.
        picture: link to a figure of all methods; empty for none.
        options: of the command that records these results.
        overall: by method that was measured in all environments where others were compared, the
            interquartile mean of return / Oracle over all their partners.
    """
    sections = [
        "<!-- Made by python -m experiments.record; remarks by hand belong in remarks.md. -->",
        f"# {_title(overviews)}\n\n{_verdict(overviews)}",
        _table(overviews, _MEASURED),
        _meanings(_MEASURED),
        beside_others(overviews, picture, overall or {}),
        "## What knowing the style is worth\n\nReturns per episode with held-out partners, mean "
        "over styles.\n\n" + _table(overviews, _WORTH),
        _meanings(_WORTH[1:]),
        "\n".join(f"- **{row.environment}**: {row.worth}" for row in overviews if row.worth),
        "A wide gap between *own style* and *other styles* means that an ego must know its "
        "partner's style. Where the *universal ego* comes near *own style*, it can see the style "
        "for itself, and a sentence has little to add; where being *told* helps it, it cannot.",
        _sights(overviews),
        "## How it was measured\n\n" + _table(overviews, _HOW),
        "To make the same runs, and this page from them:\n\n```bash\n"
        + "\n".join(_commands(overviews, options))
        + "\n```",
        _added(overviews),
    ]
    if remarks.strip():
        sections.append(f"## Remarks\n\n{remarks.strip()}")
    return "\n\n".join(filter(None, sections)) + "\n"


def short_table(overviews: Sequence[Overview], folder: str) -> str:
    """The table for the README.

    Args:
        overviews: a row for each recorded environment, in order.
        folder: the folder of the recorded results, as a link from the README.
    """
    columns = [
        (
            "environment",
            lambda row: f"[{row.environment}]({folder}/{row.environment}/report.md)",
            "",
        ),
        *(column for column in _MEASURED[1:] if column[0] not in ("upper bound", "gates met")),
    ]
    return (
        f"{_verdict(overviews)} [What the columns mean, all "
        f"environments in detail, and how to make them again]({folder}/README.md).\n\n"
        + _table(overviews, columns)
    )


def _sights(overviews: Sequence[Overview]) -> str:
    """What the style is worth to egos that see the partner only nearby; empty if unmeasured."""
    rows = [
        (row.environment, seen, f"{untold:.2f}", f"{told:.2f}", f"{told - untold:+.2f}")
        for row in overviews
        for seen, untold, told in row.sights
    ]
    if not rows:
        return ""
    head = ("environment", "ego sees the partner", "universal ego", "told", "worth of the label")
    return (
        "### When the partner can be seen only nearby\n\nShares of the Oracle, which sees the "
        "partner everywhere. Kitchen, styles and partners are the same; the ego's view of the "
        "partner ends at that many rows and columns (`partner_sight` of `envs.make`), and the "
        "universal egos are trained anew (`python -m experiments.sight RUN`).\n\n"
        + table(head, rows, "llrrr")
    )


def beside_others(
    overviews: Sequence[Overview], picture: str, overall: Mapping[str, Estimate]
) -> str:
    """Haland and all other methods by environment; empty where nothing was compared."""
    found = [row for row in overviews if _is_compared(row)]
    if not found:
        return ""
    methods = in_order(name for row in found for name in row.shares)

    def in_each(method: str, cell: Callable[[Overview, str], str]) -> list[str]:
        return [cell(row, method) if method in row.shares else "–" for row in found]

    def in_all(method: str) -> str:
        means = [row.means[method][0] for row in found if method in row.means]
        return f"{sum(means) / len(means):.2f}" if len(means) == len(found) else "–"

    shares = [(name, *in_each(name, _share), str(overall.get(name, "–"))) for name in methods]
    means = [(name, *in_each(name, _mean_with_lowest), in_all(name)) for name in methods]
    head = ("method", *(row.environment for row in found), "all")
    alignment = "l" + "r" * (len(found) + 1)
    said = [f"- **{row.environment}**: {_beside(row)}" for row in found if row.best_ego]
    parts = (
        "## Beside other methods\n\nReturn / Oracle with held-out partners: interquartile mean "
        "over styles and held-out seeds, with its stratified bootstrap interval (95%), which says "
        "what other partners of the same styles would give. *All*: over all environments' partners "
        "alike. –: not measured.",
        f"![return / Oracle of all methods]({picture})" if picture else "",
        table(head, shares, alignment),
        "The interquartile mean leaves out the quarter of the partners with which a method earns "
        "most and the quarter with which it earns least: two styles that fail do not show in it. "
        "So here is the plain mean, in brackets the lowest style, and over all environments the "
        "mean of their means:",
        table(head, means, alignment),
        "Haland beside the best universal ego by that mean; *ahead*, *level* and *behind* go by "
        "the differences with the same partners:",
        "\n".join(said),
        improvement_in_words(row.gain for row in found),
        _budgets(found),
    )
    return "\n\n".join(filter(None, parts))


def _is_compared(row: Overview) -> bool:
    """Whether other methods were measured than those that every run measures."""
    return bool(set(row.shares) - {HEADLINE, *COMPARISONS})


def _share(row: Overview, method: str) -> str:
    return str(row.shares[method])


def _mean_with_lowest(row: Overview, method: str) -> str:
    return _with_lowest(*row.means[method])


def _budgets(found: Sequence[Overview]) -> str:
    """What the egos of other methods took to learn; empty where none learnt in games."""
    methods = in_order(name for row in found for name in row.steps)
    if not methods:
        return ""

    def shown(row: Overview, method: str) -> str:
        steps, budget = row.steps.get(method, (None, None))
        if steps is None:
            return "–"
        return steps_in_words(steps) + ("" if budget is None else f" ({budget:.0%})")

    rows = [(method, *(shown(row, method) for row in found)) for method in methods]
    return (
        "Environment steps that one ego took to learn, and as a share of those of all best "
        "responses together (pairs, refits, and universal egos where these were a start):\n\n"
        + table(("method", *(row.environment for row in found)), rows, "l" + "r" * len(found))
    )


def _beside(row: Overview) -> str:
    """Haland beside the best universal ego, in a sentence."""
    best = row.best_ego
    assert best is not None
    budget = "" if best.budget is None else f", {best.budget:.0%} of those of all best responses"
    steps = "" if best.steps is None else f" ({steps_in_words(best.steps)} steps{budget})"
    return (
        f"Haland is {PLACES[best.verdict]} {best.method}{steps}: {row.means[HEADLINE][0]:.2f} and "
        f"{best.mean:.2f} of the Oracle in the mean, {best.lead.signed}. The "
        f"intervals of the interquartile means {'are apart' if best.apart else 'overlap'}."
    )


def _title(overviews: Sequence[Overview]) -> str:
    return "Results beside other methods" if any(map(_is_compared, overviews)) else "Results"


def _verdict(overviews: Sequence[Overview]) -> str:
    """What was found, in a sentence or two, good or bad."""
    presets = ", ".join(sorted({f"`{row.preset}`" for row in overviews}))
    shares = [row.share for row in overviews if row.share is not None]
    if not shares:
        return f"Preset {presets}: Haland was not measured from test sentences."
    reached = sum(share >= AIM for share in shares)
    earned = f"{min(shares):.1%}"
    if len(shares) > 1:
        earned += f" to {max(shares):.1%}"
    return (
        f"Preset {presets}: from sentences it was not trained on, with partners never met, Haland "
        f"earns {earned} of the Oracle; it reaches the aim of {AIM:.0%} in {reached} of "
        f"{len(shares)} environments."
    )


def _table(overviews: Sequence[Overview], columns: Sequence[_Column]) -> str:
    rows = [[show(row) for _, show, _ in columns] for row in overviews]
    words = ("environment", "preset", "machine", "date")
    alignment = "".join("l" if name in words else "r" for name, *_ in columns)
    return table([name for name, *_ in columns], rows, alignment)


def _meanings(columns: Sequence[_Column]) -> str:
    return "\n".join(f"- *{name}*: {meaning}" for name, _, meaning in columns if meaning)


def _with_lowest(value: float | None, lowest: float | None) -> str:
    return "–" if value is None else f"{value:.2f} ({number(lowest, 2)})"


def _success(shares: tuple[float, float] | None) -> str:
    """Haland's share of games that succeed, and the Oracle's."""
    return "–" if shares is None else f"{shares[1]:.2f} ({shares[0]:.2f})"


def _commands(overviews: Sequence[Overview], options: str) -> list[str]:
    """The commands that make the runs, compare other methods in them, and record them."""
    made, recorded = [], []
    for preset, seed in dict.fromkeys((row.preset, row.seed) for row in overviews):
        names = [r.environment for r in overviews if (r.preset, r.seed) == (preset, seed)]
        asked = ALL if set(names) == set(envs.names(styled_only=True)) else ",".join(names)
        with_seed = f" --seed {seed}" if seed else ""
        made.append(f"uv run python -m experiments.run --env {asked} --preset {preset}{with_seed}")
        recorded.append(f"runs/*-{preset}-{seed}")
    compared = [command for row in overviews for command in _comparisons(row)]
    record = f"uv run python -m experiments.record {' '.join(recorded)}{options}"
    return [*made, *compared, record]


def _added(overviews: Sequence[Overview]) -> str:
    """How the methods were measured that are not the project's own; empty where there are none."""
    names = list(dict.fromkeys(name for row in overviews for name in row.added))
    if not names:
        return ""
    return (
        f"Added from files of their own, by `python -m experiments.compare RUN --methods --add "
        f"FILE`: {', '.join(names)}."
    )


def _comparisons(row: Overview) -> list[str]:
    """The commands that measured other methods in a run."""
    run = default_path(row.environment, row.preset, row.seed)
    return [
        f"uv run python -m experiments.compare {run.as_posix()}{options} "
        f"--methods {' '.join(names)}"
        for options, names in row.compared.items()
    ]
