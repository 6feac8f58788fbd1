"""The training part of the benchmark: pairs of players that both learn, egos with a memory."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from rich.table import Table

import envs
from experiments.configs import PRESETS
from experiments.methods.universal import recurrent_config
from experiments.training import in_turns
from haland_jax import partners, recurrent_ppo
from haland_jax.population import share_out, turns
from haland_jax.ppo_loss import PPOConfig
from haland_jax.recurrent_egos import VARIANTS

BAR = 80_000
"""Environment steps per second expected of the training on two cores."""
BARS = {"assistive/jaco": 25_000}
"""The same where the environment itself is slower."""
RECURRENT_BAR = 10_000
"""The same of egos with a memory."""
PAIRS_OF_A_STYLE = 4


def measure_ppo(
    environment: str,
    updates: int,
    repeats: int,
    config: PPOConfig | None = None,
    seeds: int = PAIRS_OF_A_STYLE,
) -> dict[str, Any]:
    """Steps per second of training pairs, and seconds to compile.

    Args:
        environment: name in the registry.
        updates: updates of every pair in one repeat.
        repeats: repeats; the fastest counts.
        config: how pairs learn; as in the preset `quick` by default.
        seeds: pairs of each style.
    """
    env = envs.make(environment)
    config = config or PRESETS["quick"](environment, 0).partners.joint
    state = share_out(partners.init_pairs(env, config, seeds, jax.random.key(0)))
    styles = share_out(partners.repeat_styles(env, seeds))
    train = partners.compile_training(env, config, updates)
    pairs = len(env.style_names) * seeds
    steps = pairs * updates * config.steps_per_update
    what = f"both players learning, {pairs} pairs"
    found = _measure(lambda state: train(state, styles), state, steps, repeats)
    return _described(environment, what, found, BARS.get(environment, BAR))


def measure_recurrent(
    environment: str, updates: int, repeats: int, config: Any = None
) -> dict[str, Any]:
    """As `measure_ppo`, of the universal egos with a memory: all three in one program.

    Their partners have learnt nothing, which changes nothing of the speed.

    Args:
        environment: name in the registry.
        updates: updates of every ego in one repeat.
        repeats: repeats; the fastest counts.
        config: `RunConfig`; the preset `overnight` by default.
    """
    env = envs.make(environment)
    config = PRESETS["overnight"](environment, 0) if config is None else config
    training = recurrent_config(config, config.universal.training.total_steps)
    count = config.partners.known_seeds
    pairs = partners.init_pairs(env, config.partners.joint, count, jax.random.key(0))
    others = partners.unflatten(partners.trained_players(pairs).partner.actor, len(env.style_names))
    state = recurrent_ppo.init_recurrent(env, training, jax.random.key(1), others, 1)
    train = recurrent_ppo.compile_recurrent(env, training, updates)
    groups = turns(len(VARIANTS), len(jax.devices()))
    steps = sum(map(len, groups)) * updates * training.steps_per_update
    what = f"{', '.join(VARIANTS)}, {training.num_envs} games each"
    found = _measure(lambda state: in_turns(train, groups, state, ()), state, steps, repeats)
    return _described(environment, what, found, RECURRENT_BAR)


def _measure(
    train: Callable[[Any], tuple[Any, dict[str, Any]]], state: Any, steps: int, repeats: int
) -> dict[str, float]:
    """Speed of a chunk of `steps` steps that donates its state, and seconds to compile."""
    seconds = []
    for _ in range(repeats + 1):  # the first one compiles
        begin = time.perf_counter()
        state, metrics = jax.block_until_ready(train(state))
        seconds.append(time.perf_counter() - begin)
    if not np.isfinite(metrics["loss"]).all():
        raise FloatingPointError("the training's loss is not finite")
    best = min(seconds)
    return {"steps_per_second": steps / best, "compile_seconds": seconds[0] - best}


def _described(environment: str, what: str, found: dict[str, float], bar: int) -> dict[str, Any]:
    met = found["steps_per_second"] >= bar
    return {"environment": environment, "what": what, **found, "bar": bar, "met": met}


def ppo_table(found: dict[str, Any]) -> Table:
    """The training's speed for the terminal."""
    table = Table(
        title=f"PPO, {found['what']}, {found['environment']}",
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
