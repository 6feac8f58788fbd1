"""Measures what one player of the assistive arm can do while the other one stays still.

    python -m experiments.alone
    python -m experiments.alone --seeds 1 --steps 500_000

A task in which the robot alone, or the person alone, succeeds would say nothing about their
coordination. Each of them is trained as in the preset `overnight` for every style, once with the
other's actions counting for nothing, and of a style's seeds the best one counts. Both must succeed
in few games. An interrupted command goes on when it is called again.
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
from experiments.configs import PRESETS
from experiments.errors import UserError, as_user_error, main_guard
from experiments.machine import describe_machine
from experiments.progress import RunProgress, StageProgress
from experiments.run_folder import RunFolder
from haland_jax.ppo_loss import PPOConfig

ENVIRONMENT = "assistive/jaco"
BAR = 0.2
"""Share of the games in which the best player alone may succeed."""
STAGES = {"ego": "robot_alone", "partner": "person_alone"}
"""By the player that acts."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what one player of the assistive arm can do while the other one stays still."""

    seeds: int = 2
    """Players of each style; the best one counts."""
    steps: int = PRESETS["overnight"](ENVIRONMENT, 0).partners.joint.total_steps
    """Steps that each of them learns for; those of the preset by default."""
    games: int = 64
    """Games in which each is judged."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/assistive-jaco-alone")
    """Folder of this measurement; it holds results.json at the end."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What the measurement depends on; see `Arguments`."""

    seeds: int
    games: int
    training: PPOConfig


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.alone")
    for name in ("seeds", "steps", "games"):
        if getattr(arguments, name) < 1:
            raise UserError(f"{name} is {getattr(arguments, name)}; expected at least 1")
    devices.prepare()
    with as_user_error():
        training = dataclasses.replace(
            PRESETS["overnight"](ENVIRONMENT, 0).partners.joint, total_steps=arguments.steps
        )
    plan = Plan(arguments.seeds, arguments.games, training)
    Console().print(table_of(measure(arguments.out, plan)))


def measure(path: Path, plan: Plan) -> dict[str, Any]:
    """Trains and judges each player alone, and writes results.json.

    Args:
        path: folder of the measurement, continued if it was begun.
        plan: what to do.

    Returns:
        The content of results.json: by player and style the share of games that succeed, [seed].
    """
    with RunFolder.write(path, plan) as folder, RunProgress(STAGES.values(), folder) as progress:
        for player, stage in STAGES.items():
            if folder.stage_done(stage):
                progress.skip(stage)
                continue
            start = time.monotonic()
            with progress.stage(stage, plan.training.num_updates) as task:
                found = _measure_one(folder.stage_path(stage), player, plan, task)
            folder.finish_stage(stage, {**found, "seconds": time.monotonic() - start})
        results = {
            "machine": describe_machine(),
            **{stage: folder.stage_metrics(stage) for stage in STAGES.values()},
        }
        folder.write_json("results.json", results)
    return results


def _measure_one(path: Path, player: str, plan: Plan, task: StageProgress) -> dict[str, Any]:
    """Trains one player while the other stays still."""
    from experiments.judge import Judge
    from experiments.training import Saver, train_population
    from haland_jax import partners

    other = "partner" if player == "ego" else "ego"
    env: Any = envs.make(ENVIRONMENT, still=other)
    train_key, play_key = jax.random.split(jax.random.key(3000))
    styles = partners.repeat_styles(env, plan.seeds)
    (ego, partner), _ = train_population(
        env,
        plan.training,
        lambda: partners.init_pairs(env, plan.training, plan.seeds, train_key),
        styles,
        Saver(path / "unfinished"),
        task.update,
        STAGES[player],
    )
    judge = Judge(env, plan.games, batch=len(env.style_names) * plan.seeds)
    scores = judge.scores(play_key, ego.actor, partner.actor, styles)
    by_style = scores.map(lambda values: values.reshape(len(env.style_names), -1))
    return {
        name: dict(zip(env.style_names, values.tolist(), strict=True))
        for name, values in by_style._asdict().items()
    }


def table_of(results: dict[str, Any]) -> Table:
    """The best seeds' successes for the terminal."""
    table = Table(
        title=f"{ENVIRONMENT}: games that succeed while the other stays still, best seed",
        caption=", ".join(f"{name} {value}" for name, value in results["machine"].items()),
    )
    table.add_column("style")
    for stage in STAGES.values():
        table.add_column(stage.replace("_", " "), justify="right")
    best = {
        stage: {style: max(seeds) for style, seeds in results[stage]["successes"].items()}
        for stage in STAGES.values()
    }
    for style in next(iter(best.values())):
        table.add_row(style, *(f"{best[stage][style]:.2f}" for stage in STAGES.values()))
    table.add_section()
    highest = {stage: max(best[stage].values()) for stage in STAGES.values()}
    table.add_row(
        f"highest (bar: at most {BAR})",
        *(f"[{'green' if value <= BAR else 'red'}]{value:.2f}[/]" for value in highest.values()),
    )
    return table


if __name__ == "__main__":
    main()
