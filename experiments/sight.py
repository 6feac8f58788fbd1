"""Measures what knowing the style is worth to an ego that sees the partner only nearby.

    python -m experiments.sight runs/overcooked-center_pots-overnight-0
    python -m experiments.sight runs/lbf-spread-overnight-0 --cells 2 1 0

Where a partner's style can be seen from afar, being told it is worth little. Here the kitchen
stays as it is and so do the run's partners; only the ego's view of the partner ends at some
distance. One ego for all styles is trained anew with each view, told the style and not. The
numbers are added to the run's results.json and report.md; an interrupted command goes on when
it is called again.
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from rich.console import Console
from rich.table import Table

import envs
from experiments import devices
from experiments.errors import UserError, main_guard
from experiments.progress import RunProgress, StageProgress
from experiments.run_folder import RunFolder
from experiments.summary import COMPARISONS, PARTNER_SIGHT, mean, sight_shares


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what knowing the style is worth to an ego that sees the partner only nearby."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run, whose partners are played with."""
    cells: tuple[int, ...] = (2, 1)
    """Rows and columns up to which the ego sees the partner; several are measured one by one."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.sight")
    wrong = [cells for cells in arguments.cells if cells < 0]
    if wrong or not arguments.cells:
        raise UserError(f"cells is {wrong[0] if wrong else 'empty'}; expected numbers from 0 up")
    devices.prepare()
    results = measure(arguments.run, arguments.cells)
    Console().print(table_of(results))


def measure(path: Path, cells: tuple[int, ...]) -> dict[str, Any]:
    """Measures each view that was not measured before, and writes results and report anew.

    Args:
        path: folder of a finished run.
        cells: how far the ego sees the partner, one view after the other.

    Returns:
        The new content of the run's results.json.

    Raises:
        UserError: there is no finished run at `path`, or another process writes it.
    """
    from experiments import report
    from experiments.finished_run import open_run
    from experiments.stages import Run

    RunFolder.read(path, ("report",))
    config = open_run(path).config
    names = [_stage(sight) for sight in cells]
    with RunFolder.write(path, config) as folder, RunProgress(names, folder) as progress:
        run = Run(config, folder)
        for sight, name in zip(cells, names, strict=True):
            if folder.stage_done(name):
                progress.skip(name)
                continue
            start = time.monotonic()
            with progress.stage(name, config.universal.training.num_updates) as task:
                measured = _measure_one(run, sight, task)
            folder.finish_stage(name, {**measured, "seconds": time.monotonic() - start})
        results = folder.read_json("results.json")
        before = [old for old in results.get(PARTNER_SIGHT, []) if old["cells"] not in cells]
        new = [folder.stage_metrics(name) for name in names]
        results[PARTNER_SIGHT] = sorted([*before, *new], key=lambda one: -one["cells"])
        folder.write_json("results.json", results)
        report.write_report(results, path)
    return results


def table_of(results: dict[str, Any]) -> Table:
    """The shares of the Oracle as a table for the terminal."""
    table = Table(title=f"{results['environment']}: one ego for all styles, share of the Oracle")
    table.add_column("sees the partner")
    for method in COMPARISONS:
        table.add_column(method, justify="right")
    for seen, shares in sight_shares(results).items():
        table.add_row(seen, *(f"{mean(shares[method]):.3f}" for method in COMPARISONS))
    return table


def _stage(sight: int) -> str:
    return f"sight_{sight}"


def _measure_one(run: Any, sight: int, task: StageProgress) -> dict[str, Any]:
    """Trains the egos with one view and plays them with the held-out partners."""
    from experiments.judge import Judge, by_style, over_egos
    from experiments.stages import load_population, load_universal_in, train_universal_in

    config = run.config
    env = envs.make(config.environment, max_steps=config.max_steps, partner_sight=sight)
    trained = train_universal_in(run, env, _stage(sight), task)
    judge = Judge(env, config.evaluation.games, config.evaluation.batch)
    held_out = load_population(run).held_out_partners
    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 2000 + sight))
    methods = {}
    egos = load_universal_in(run, env, _stage(sight))
    for method, key, players in zip(COMPARISONS, keys, egos.values(), strict=True):
        scores = over_egos(judge.with_held_out(key, players.actor, held_out))
        methods[method] = by_style(scores, env.style_names)
    return {"cells": sight, "steps": trained["steps"], "methods": methods}


if __name__ == "__main__":
    main()
