"""Trains Haland, from partners to report, in one environment or in all of them.

    python -m experiments.run                                  the default kitchen, `quick`
    python -m experiments.run --env overcooked/crossway
    python -m experiments.run --preset smoke                   minutes, to see that all works
    python -m experiments.run --env all --preset overnight     every environment, one by one

A run that was interrupted goes on with the same command.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from envs.instructions import load_instructions
from experiments import devices, run_all
from experiments.configs import DEFAULT_ENVIRONMENT, PRESETS
from experiments.errors import UserError, as_user_error, choose, main_guard


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train Haland, from partners to report, in one environment or in all of them.

    An interrupted run goes on with the same command. Results are in the run folder:
    report.md, results.json, figures/.

    With several environments (all, or names with commas between) each gets its own run folder and
    its own process, one after the other. One that fails does not stop the others; the same command
    skips what is finished and continues the rest. A table compares them at the end; the exit
    status is 1 if one failed.
    """

    env: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_ENVIRONMENT
    """Environment, such as overcooked/center_pots, overcooked/crossway,
    overcooked/diverse_coordination or overcooked/diverse_orders; several with commas between;
    or all."""
    preset: Annotated[str, tyro.conf.arg(metavar="NAME")] = "quick"
    """Scale: smoke (two minutes, learns nothing), quick (a quarter of an hour on two cores, in
    other environments up to an hour), overnight (three training and three held-out seeds a style;
    an hour or so),
    paper (five and five; hours)."""
    seed: int = 0
    """Seed of all randomness; the same seed gives the same results."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder; runs/<environment>-<preset>-<seed> by default. With several environments:
    the folder that holds their run folders; runs by default."""


@main_guard
def main() -> int:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.run")
    environments = run_all.asked_environments(arguments.env)
    preset = choose("preset", arguments.preset, PRESETS)
    if arguments.seed < 0:
        raise UserError(f"seed is {arguments.seed}; expected 0 or more")
    if len(environments) > 1:
        plans = run_all.make_plans(environments, preset, arguments.seed, arguments.out)
        return run_all.run_all(plans)
    run_one(environments[0], preset, arguments.seed, arguments.out)
    return 0


def run_one(environment: str, preset: str, seed: int, out: Path | None) -> None:
    """Runs, or continues, one environment in this process, and shows what was found."""
    devices.prepare()
    from experiments.pipeline import run_pipeline
    from experiments.report import summary_table

    with as_user_error():
        config = PRESETS[preset](environment, seed)
    path = out or run_all.default_path(environment, preset, seed)
    results = run_pipeline(config, path)
    console = Console()
    console.print(summary_table(results))
    console.print(f"Report: {path / 'report.md'}", highlight=False)
    sentence = load_instructions(environment, results["styles"])[results["styles"][0]].test[0]
    console.print(
        f'Next: python -m experiments.generate "{sentence}" --run {path} --gif episode.gif',
        highlight=False,
    )


if __name__ == "__main__":
    main()
