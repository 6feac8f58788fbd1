"""What people thought of agents, and earned with them (Fig. 7b and 7c).

    python -m experiments.people study --out figures
    python -m experiments.people rounds.jsonl

From a study's folder, the URL of its database, or rounds.jsonl from its administration page: the
return by kind of agent with intervals over participants, and for each two kinds by how much the
first was rated higher than the second by the same people.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, NamedTuple

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from experiments.errors import UserError, main_guard
from experiments.figures.style import STYLE, draw_cell_borders, fills_of, new_figure, save
from experiments.intervals import Estimate, mean_estimate
from experiments.study.rounds import Recorded, read_rounds
from experiments.summary import HEADLINE, ORACLE, UNIVERSAL

NAMES = {"haland": "Haland", "oracle": "Oracle", "universal": "Universal ego"}
"""How figures call the kinds of agents."""
METHODS = {"haland": HEADLINE, "oracle": ORACLE, "universal": UNIVERSAL}
"""Which methods of other figures they are; they have the same colours."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw what people earned with agents, and how they rated them."""

    recordings: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER|URL|FILE")]
    """A study's folder, its database's URL, or rounds.jsonl."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("figures")
    """Where the figures go."""
    env: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Whose rounds, if the recordings are of several environments."""


class Opinion(NamedTuple):
    """What was found of one kind of agent.

    Attributes:
        rounds: how many were played to their end.
        people: how many participants played them.
        score: mean over participants of their mean score, with its 95% interval.
        rating: the same of their ratings; None where nobody rated.
    """

    rounds: int
    people: int
    score: Estimate
    rating: Estimate | None


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.people")
    rounds = of_one_environment(read_rounds(arguments.recordings), arguments.env)
    found, preferred = opinions(rounds), preferences(rounds)
    arguments.out.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        files = [
            save(returns_with_people(found), arguments.out, "figure_7b"),
            save(preference_matrix(*preferred), arguments.out, "figure_7c"),
        ]
    console = Console()
    console.print(table_of(rounds[0].environment, found))
    for file in files:
        console.print(f"written: {file}", soft_wrap=True)


def of_one_environment(rounds: list[Recorded], environment: str | None) -> list[Recorded]:
    """Those rounds that are of one environment.

    Raises:
        UserError: which one is meant is not clear, or nothing of it was played.
    """
    known = sorted({one.environment for one in rounds})
    if environment is None and len(known) == 1:
        environment = known[0]
    if environment is None or environment not in known:
        raise UserError(f"there are rounds of {', '.join(known)}; name one with --env")
    return [one for one in rounds if one.environment == environment]


def conditions_of(rounds: list[Recorded]) -> list[str]:
    """The kinds of agents that were played with, ours in their usual order."""
    found = {one.condition for one in rounds}
    return [name for name in NAMES if name in found] + sorted(found - set(NAMES))


def opinions(rounds: list[Recorded]) -> dict[str, Opinion]:
    """What was found of each kind of agent; every participant counts once for it."""
    found = {}
    for condition in conditions_of(rounds):
        mine = [one for one in rounds if one.condition == condition]
        scores = _by_person((one.participant, one.score) for one in mine)
        ratings = _by_person((o.participant, o.rating) for o in mine if o.rating is not None)
        found[condition] = Opinion(
            rounds=len(mine),
            people=len(scores),
            score=mean_estimate(np.array([list(scores.values())])),
            rating=mean_estimate(np.array([list(ratings.values())])) if ratings else None,
        )
    return found


def preferences(rounds: list[Recorded]) -> tuple[list[str], np.ndarray]:
    """By how much each kind of agent was rated higher than each other one by the same people.

    Returns:
        The kinds, and the mean over participants who rated both of the difference of their mean
        ratings, [first, second]; NaN where nobody rated both.
    """
    conditions = conditions_of(rounds)
    rated = [
        _by_person(
            (one.participant, one.rating)
            for one in rounds
            if one.condition == condition and one.rating is not None
        )
        for condition in conditions
    ]
    found = np.full((len(conditions), len(conditions)), np.nan)
    for first, mine in enumerate(rated):
        for second, others in enumerate(rated):
            both = sorted(set(mine) & set(others))
            if both:
                found[first, second] = np.mean([mine[who] - others[who] for who in both])
    return conditions, found


def _by_person(values: Iterable[tuple[str, float]]) -> dict[str, float]:
    """The mean of each participant's values, from pairs of participant and value."""
    found: dict[str, list[float]] = {}
    for who, value in values:
        found.setdefault(who, []).append(float(value))
    return {who: float(np.mean(several)) for who, several in found.items()}


def returns_with_people(found: dict[str, Opinion]) -> Figure:
    """Fig. 7b: score by kind of agent, with 95% intervals over participants."""
    figure = new_figure(1.6 + 1.1 * len(found), 3.4)
    axes = figure.add_subplot()
    names = [NAMES.get(name, name) for name in found]
    fills = fills_of([METHODS.get(name, name) for name in found])
    for place, (name, opinion) in enumerate(found.items()):
        value, low, high = opinion.score
        colour, hatch = fills[METHODS.get(name, name)]
        axes.bar(
            place, value, 0.7, color=colour, hatch=hatch, edgecolor="black", linewidth=0.6,
            yerr=[[value - low], [high - value]], error_kw={"elinewidth": 1.0, "capsize": 3},
        )  # fmt: skip
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("score with people (mean, 95%)")
    axes.set_axisbelow(True)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    return figure


def preference_matrix(conditions: list[str], values: np.ndarray) -> Figure:
    """Fig. 7c: by how much the row's agent was rated higher than the column's."""
    names = [NAMES.get(name, name) for name in conditions]
    figure = new_figure(2.4 + 0.8 * len(names), 1.6 + 0.7 * len(names))
    axes = figure.add_subplot()
    colours = matplotlib.colormaps["PuOr"].with_extremes(bad="#eeeeee")
    image = axes.imshow(values, cmap=colours, vmin=-4, vmax=4)
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = "white" if abs(value) > 2.5 else "black"
            axes.text(column, row, f"{value:+.2f}", ha="center", va="center", color=dark)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_yticks(range(len(names)), names)
    draw_cell_borders(axes, *values.shape)
    bar = figure.colorbar(image, ax=axes, shrink=0.9, aspect=20, pad=0.03)
    bar.set_label("rated higher by")
    return figure


def table_of(environment: str, found: dict[str, Opinion]) -> Table:
    """What was found, for the terminal."""
    table = Table(title=f"{environment} with people")
    for column in ("agent", "people", "rounds", "score (95%)", "rating (95%)"):
        table.add_column(column, justify="left" if column == "agent" else "right")
    for name, opinion in found.items():
        low, high = opinion.score.low, opinion.score.high
        table.add_row(
            NAMES.get(name, name),
            str(opinion.people),
            str(opinion.rounds),
            f"{opinion.score.value:.1f} [{low:.1f}, {high:.1f}]",
            "–" if opinion.rating is None else str(opinion.rating),
        )
    return table


if __name__ == "__main__":
    main()
