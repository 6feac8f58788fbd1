"""Trains Haland in one environment, from partners to report.

    python -m experiments.run                                  the default kitchen, `quick`
    python -m experiments.run --env overcooked/crossway
    python -m experiments.run --preset smoke                   minutes, to see that all works

A run that was interrupted goes on with the same command.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

import envs
from experiments import devices
from experiments.configs import DEFAULT_ENVIRONMENT, PRESETS
from experiments.errors import UserError, as_user_error, choose, main_guard


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train Haland in one environment, from partners to report.

    An interrupted run goes on with the same command. Results are in the run folder:
    report.md, results.json, figures/.
    """

    env: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_ENVIRONMENT
    """Environment, such as overcooked/center_pots, overcooked/crossway,
    overcooked/diverse_coordination or overcooked/diverse_orders."""
    preset: Annotated[str, tyro.conf.arg(metavar="NAME")] = "quick"
    """Scale: smoke (two minutes, learns nothing), quick (a quarter of an hour on two cores),
    overnight (three training and three held-out seeds a style; three quarters of an hour),
    paper (five and five; hours)."""
    seed: int = 0
    """Seed of all randomness; the same seed gives the same results."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder; runs/<environment>-<preset>-<seed> by default."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.run")
    environment = choose("environment", arguments.env, envs.names(styled_only=True))
    preset = choose("preset", arguments.preset, PRESETS)
    if arguments.seed < 0:
        raise UserError(f"seed is {arguments.seed}; expected 0 or more")
    devices.prepare()
    from experiments.pipeline import run_pipeline
    from experiments.report import summary_table

    with as_user_error():
        config = PRESETS[preset](environment, arguments.seed)
    name = f"{environment.replace('/', '-')}-{preset}-{arguments.seed}"
    path = arguments.out or Path("runs") / name
    results = run_pipeline(config, path)
    console = Console()
    console.print(summary_table(results))
    console.print(f"Report: {path / 'report.md'}", highlight=False)
    console.print(
        f'Next: python -m experiments.generate {path} "I stay on the left …" --gif episode.gif',
        highlight=False,
    )


if __name__ == "__main__":
    main()
