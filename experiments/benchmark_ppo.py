"""The training's part of the benchmark: pairs of players that learn together, and the table."""

import dataclasses
import time
from typing import Any

import jax
import numpy as np
from rich.table import Table

import envs
from experiments.configs import PRESETS
from haland_jax import partners
from haland_jax.population import share_out

BAR = 80_000
"""Environment steps per second expected of the training on two cores."""
BARS = {"assistive/jaco": 25_000}
"""The same where the environment itself is slower."""


def measure_ppo(environment: str, updates: int, repeats: int, config: Any = None) -> dict[str, Any]:
    """Steps per second of training pairs, and seconds to compile.

    Args:
        environment: name in the registry.
        updates: updates of every pair in one repeat.
        repeats: repeats; the fastest counts.
        config: `PartnersConfig`; four seeds a style with the settings of the preset `quick` by
            default.
    """
    env = envs.make(environment)
    if config is None:
        quick = PRESETS["quick"](environment, 0).partners
        config = dataclasses.replace(quick, train_seeds=3, held_out_seeds=1, spare_seeds=0)
    state = share_out(partners.init_pairs(env, config.joint, config.num_seeds, jax.random.key(0)))
    styles = share_out(partners.repeat_styles(env, config.num_seeds))
    train = partners.compile_training(env, config.joint, updates)
    pairs = len(env.style_names) * config.num_seeds
    seconds = []
    for _ in range(repeats + 1):  # the first one compiles
        begin = time.perf_counter()
        state, metrics = jax.block_until_ready(train(state, styles))
        seconds.append(time.perf_counter() - begin)
    best = min(seconds)
    if not np.isfinite(metrics["loss"]).all():
        raise FloatingPointError("the training's loss is not finite")
    bar = BARS.get(environment, BAR)
    speed = pairs * updates * config.joint.steps_per_update / best
    return {
        "environment": environment,
        "pairs": pairs,
        "steps_per_second": speed,
        "compile_seconds": seconds[0] - best,
        "bar": bar,
        "met": speed >= bar,
    }


def ppo_table(found: dict[str, Any]) -> Table:
    """The training's speed for the terminal."""
    table = Table(
        title=f"PPO, both players learning, {found['pairs']} pairs, {found['environment']}",
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    for column in ("steps/s", "bar", "", "compilation"):
        table.add_column(column, justify="right")
    table.add_row(
        f"{found['steps_per_second']:,.0f}",
        f">= {found['bar']:,}",
        "[green]met[/]" if found["met"] else "[red]missed[/]",
        f"{found['compile_seconds']:.1f} s",
    )
    return table
