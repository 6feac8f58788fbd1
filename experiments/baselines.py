"""Trains the paper's universal egos for a finished run's partners, and measures them beside it.

    python -m experiments.baselines runs/lbf-spread-quick-0
    python -m experiments.baselines runs/lbf-spread-quick-0 --steps 5_000_000 --seeds 3

General, Instructed and Adaptive Ego (App. C.3) have a memory and learn by PPO with the partners of
all styles together, the same partners that the run's best responses learnt with, for as many
environment steps each as all best responses together. They are judged with the held-out partners,
as every method. The numbers are added to the run's results.json and report.md; an interrupted
command goes on when it is called again.
"""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments import devices
from experiments.errors import UserError, as_user_error, main_guard
from experiments.progress import RunProgress, StageProgress
from experiments.run_folder import RunFolder
from experiments.summary import ORACLE, summarise
from experiments.worth import steps_in_words
from haland_jax.ppo_loss import PPOConfig

STAGE = "baselines"
CURVE_POINTS = 40
TOLD = ("told nothing", "told the style", "told the partner's last action")
"""What General, Instructed and Adaptive Ego know besides what they see."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train the paper's universal egos for a finished run's partners, and measure them."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run."""
    steps: int | None = None
    """Environment steps of each ego; as many as of all the run's best responses by default."""
    seeds: int = 2
    """Egos of each kind; six learn as fast as three on an even number of devices."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.baselines")
    for name in ("steps", "seeds"):
        value = getattr(arguments, name)
        if value is not None and value < 1:
            raise UserError(f"{name} is {value}; expected at least 1")
    devices.prepare()
    results = measure(arguments.run, arguments.steps, arguments.seeds)
    Console().print(table_of(results))


def training_config(universal: PPOConfig, steps: int) -> PPOConfig:
    """Settings of an ego with a memory, from those of the run's feed-forward universal egos.

    Longer minibatches and fewer passes: on a CPU a step of a memory costs a product of matrices
    whose size hardly depends on the games in it.

    Raises:
        ValueError: too few steps.
    """
    return dataclasses.replace(
        universal, total_steps=steps, epochs=2, num_minibatches=4, learning_rate=5e-4
    )


def measure(path: Path, steps: int | None, seeds: int) -> dict[str, Any]:
    """Trains the egos, and writes results and report anew.

    Args:
        path: folder of a finished run.
        steps: of each ego; None for those of all best responses.
        seeds: egos of each kind.

    Returns:
        The new content of the run's results.json.

    Raises:
        UserError: there is no finished run at `path`, another process writes it, or it has egos
            of other steps or seeds already.
    """
    from experiments import report
    from experiments.finished_run import open_run
    from experiments.stages import Run

    RunFolder.read(path, ("report",))
    config = open_run(path).config
    with RunFolder.write(path, config) as folder, RunProgress((STAGE,), folder) as progress:
        results = folder.read_json("results.json")
        with as_user_error():
            training = training_config(
                config.universal.training, steps or results["universal"]["best_response_steps"]
            )
        if folder.stage_done(STAGE):
            progress.skip(STAGE)
            _expect_same(folder.stage_metrics(STAGE), training, seeds)
        else:
            start = time.monotonic()
            with progress.stage(STAGE, training.num_updates) as task:
                found = _measure(Run(config, folder), training, seeds, task)
            folder.finish_stage(STAGE, {**found, "seconds": time.monotonic() - start})
        found = dict(folder.stage_metrics(STAGE))
        results["methods"] |= found.pop("methods")
        results[STAGE] = found
        results["descriptions"] = results.get("descriptions", {}) | _descriptions(found)
        folder.write_json("results.json", results)
        report.write_report(results, path)
    return results


def _descriptions(found: dict[str, Any]) -> dict[str, str]:
    """What each method is, in a few words for the report."""
    steps = steps_in_words(found["steps"])
    return {
        name: f"one ego with a memory for all styles, {told}, {steps} steps"
        for name, told in zip(found["curve_returns"], TOLD, strict=True)
    }


def _expect_same(found: dict[str, Any], training: PPOConfig, seeds: int) -> None:
    """Checks that finished egos are those that are asked for."""
    steps = training.num_updates * training.steps_per_update
    if (found["steps"], found["seeds"]) != (steps, seeds):
        raise UserError(
            f"the run has egos of {found['steps']:,} steps and {found['seeds']} seeds already, not "
            f"of {steps:,} and {seeds}; remove its folder '{STAGE}' to train others"
        )


def _measure(run: Any, training: PPOConfig, seeds: int, task: StageProgress) -> dict[str, Any]:
    """Trains the egos and plays them with the held-out partners."""
    from experiments.judge import Judge, by_style, over_egos
    from experiments.stages import load_population
    from experiments.training import Saver, train_in_pieces
    from haland_jax import checkpoint, partners, recurrent_ppo
    from haland_jax.recurrent_egos import VARIANTS

    env, population = run.env, load_population(run)
    teachers = partners.teachers(env, run.config.partners, population)
    root = jax.random.fold_in(jax.random.key(run.config.seed), 4000)
    train_key, play_key = jax.random.split(root)
    state, returns = train_in_pieces(
        training,
        recurrent_ppo.init_recurrent(env, training, train_key, teachers, seeds),
        lambda updates: recurrent_ppo.compile_recurrent(env, training, updates),
        Saver(run.path(STAGE, f"unfinished_{training.num_updates}_updates_{seeds}_seeds")),
        task.update,
        "universal egos with a memory",
    )
    judge = Judge(env, run.config.evaluation.games, run.config.evaluation.batch)
    keys = jax.random.split(play_key, len(VARIANTS))
    actors = recurrent_ppo.raw_actors(state)
    checkpoint.save(run.path(STAGE, "egos"), actors)
    egos = recurrent_ppo.egos_by_style(env, actors)
    methods = {}
    for key, (name, agents) in zip(keys, egos.items(), strict=True):
        scores = judge.with_held_out(key, agents, population.held_out_partners)
        methods[name] = by_style(over_egos(scores), env.style_names)
    points = np.linspace(0, len(returns), min(CURVE_POINTS, len(returns)) + 1).astype(int)
    smooth = np.array([returns[a:b].mean(axis=0) for a, b in itertools.pairwise(points)])
    curves = smooth.reshape(len(smooth), len(VARIANTS), seeds)
    return {
        "methods": methods,
        "steps": training.num_updates * training.steps_per_update,
        "seeds": seeds,
        "curve_steps": points[1:] * training.steps_per_update,
        "curve_returns": {name: curves[:, index].T for index, name in enumerate(VARIANTS)},
    }


def table_of(results: dict[str, Any]) -> Table:
    """The methods beside the Oracle for the terminal."""
    table = Table(title=f"{results['environment']}: with held-out partners")
    table.add_column("method")
    for column in ("return", "/ Oracle"):
        table.add_column(column, justify="right")
    for row in summarise(results):
        share = "" if row.method == ORACLE else f"{row.ratio:.3f}"
        table.add_row(row.method, f"{row.mean:.1f}", share)
    return table


if __name__ == "__main__":
    main()
