"""Draws the paper's figures from the results of runs, and nothing else.

    python -m experiments.figures runs/*-overnight-0 --out figures
    python -m experiments.figures docs/results/*/*/

Each as PNG and PDF: Fig. 3 (all methods in all environments), 4 (Adaptive Egos by seed), 5 and 12
(strips of games), 6a and 6b (sentences), 8 to 11 (events), Table 1, and how universal egos learnt.
Those whose numbers are missing are named with the command that makes them.
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from experiments.devices import usable_cores
from experiments.errors import UserError, main_guard
from experiments.figures import paper
from experiments.reading import read_runs
from experiments.standing import gain, improvement_in_words

MISSING = {
    **dict.fromkeys(("figure_5", "figure_12"), "make the run again with this version"),
    "figure_4": "python -m experiments.compare RUN --methods universal",
    "universal_learning": "python -m experiments.compare RUN --methods universal universal-mlp",
    "figure_6a": "python -m experiments.compare RUN --methods no-fine-tuning",
    "table_1": "python -m experiments.compare RUN --methods cgan-mlp cgan-unet no-translator "
    "no-vae",
}
"""The command that measures what a figure needs."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw the paper's figures from the results of runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folders with a results.json, one an environment."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("figures")
    """Where the figures go."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.figures")
    if not arguments.runs:
        raise UserError("name at least one run: a folder with a results.json")
    start = time.monotonic()
    runs = read_runs(arguments.runs)
    drawn = paper.draw_paper(runs, arguments.out, processes=usable_cores())
    console = Console()
    environments = f"{len(runs)} environment{'s' * (len(runs) != 1)}"
    table = Table(title=f"figures of {environments}, {time.monotonic() - start:.0f} s")
    for column in ("figure", "what", "files"):
        table.add_column(column, overflow="fold")
    for name, files in drawn.items():
        shown = "\n".join(file.name for file in files)
        missing = MISSING.get(name)
        hint = f"[yellow]missing; first: {missing}[/]" if missing else "[yellow]missing[/]"
        table.add_row(name.replace("_", " "), paper.FIGURES[name].title, shown or hint)
    console.print(table)
    if said := improvement_in_words(map(gain, runs)):
        console.print(said)


if __name__ == "__main__":
    main()
