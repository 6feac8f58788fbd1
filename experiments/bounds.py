"""What each environment and style can pay at most.

    python -m experiments.bounds
    python -m experiments.bounds --env overcooked/crossway
    python -m experiments.bounds --json bounds.json

The bound holds for any two players, whatever they know (docs/environments.md).
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

import envs
from experiments import devices
from experiments.errors import UserError, choose, main_guard

EVERYTHING = "all"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Bound the return of environments by style."""

    env: str = EVERYTHING
    """An environment, or `all` that have partner styles."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the numbers as JSON too."""


def table_of(found: dict[str, dict[str, float]]) -> Table:
    """The bounds as a table for the terminal."""
    table = Table(title="Upper bounds of the return")
    table.add_column("environment")
    table.add_column("style")
    table.add_column("upper bound", justify="right")
    for name, styles in found.items():
        for style, bound in styles.items():
            table.add_row(name, style, f"{bound:g}")
        table.add_section()
    return table


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.bounds")
    devices.prepare()
    known = envs.names(styled_only=True)
    if arguments.env != EVERYTHING:
        choose("env", arguments.env, (EVERYTHING, *envs.names()))
    if arguments.json is not None and not arguments.json.absolute().parent.is_dir():
        raise UserError(f"the folder of {arguments.json} does not exist; make it first")
    chosen = known if arguments.env == EVERYTHING else (arguments.env,)
    found = {name: envs.make(name).upper_bounds() for name in chosen}
    Console().print(table_of(found))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
