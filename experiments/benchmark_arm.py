"""The assistive arm's part of the benchmark: MJX beside C MuJoCo, and the table."""

# MuJoCo's compiled classes have no types for a checker.
# pyright: reportAttributeAccessIssue=false

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

import envs
from envs.base import Pair
from haland_jax.population import over_population

ENVIRONMENT = "assistive/jaco"
BAR, CORES = 50_000, 2
"""Control steps per second expected of the environment, and the cores that this is said of."""
OURS, PHYSICS, PEER = "ours, whole environment", "ours, physics alone", "C MuJoCo, mujoco.rollout"


def measure_arm(batch: int, steps: int, repeats: int, cores: int) -> dict[str, Any]:
    """Control steps per second with random actions, each contender on all cores.

    Args:
        batch: games at once.
        steps: steps of each game in one repeat.
        repeats: repeats; the fastest counts.
        cores: threads of C MuJoCo.

    Returns:
        By contender: `steps_per_second`; for ours also `ratio` to C MuJoCo, and for the whole
        environment on two cores `bar` and `met`.
    """
    programs = {
        OURS: _environment(batch, steps),
        PHYSICS: _physics(batch, steps),
        PEER: _c_physics(batch, steps, cores),
    }
    best = dict.fromkeys(programs, float("inf"))
    for _ in range(repeats + 1):  # the first one compiles
        for name, program in programs.items():
            begin = time.perf_counter()
            program()
            best[name] = min(best[name], time.perf_counter() - begin)
    found: dict[str, Any] = {
        name: {"steps_per_second": batch * steps / seconds} for name, seconds in best.items()
    }
    for name in (OURS, PHYSICS):
        speed = found[name]["steps_per_second"]
        found[name]["ratio"] = speed / found[PEER]["steps_per_second"]
    if cores == CORES:
        met = found[OURS]["steps_per_second"] >= BAR
        found[OURS] |= {"bar": BAR, "met": met}
    return found


def arm_table(found: dict[str, Any]) -> Table:
    """The speeds for the terminal."""
    table = Table(
        title=f"Assistive arm, random actions, {found['batch']} games at once",
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    table.add_column("engine")
    for column in ("control steps/s", "x C MuJoCo", "bar", ""):
        table.add_column(column, justify="right")
    for name, row in found["engines"].items():
        judged = ()
        if "bar" in row:
            judged = (f">= {row['bar']:,}", "[green]met[/]" if row["met"] else "[red]missed[/]")
        ratio = f"{row['ratio']:.2f}" if "ratio" in row else ""
        table.add_row(name, f"{row['steps_per_second']:,.0f}", ratio, *judged)
    return table


def _environment(batch: int, steps: int) -> Callable[[], Any]:
    """Games of all styles, with observations, rewards and events."""
    env = envs.make(ENVIRONMENT)

    def play(key: jax.Array, style: Any) -> jax.Array:
        reset_key, act_key = jax.random.split(key)
        state, _ = env.reset(reset_key, style)

        def one_step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            ego, partner = jax.random.split(key)
            actions = Pair(
                *(
                    jax.random.uniform(k, (size,), minval=-1.0, maxval=1.0)
                    for k, size in zip((ego, partner), env.num_actions, strict=True)
                )
            )
            state, timestep = env.step(key, state, actions, style)
            seen = sum(jnp.sum(one) for one in timestep.observation)
            return state, timestep.reward + 1e-6 * (seen + jnp.sum(timestep.events))

        return jax.lax.scan(one_step, state, jax.random.split(act_key, steps))[1].sum()

    program = over_population(play, compiler_options=env.compiler_options)
    keys = jax.random.split(jax.random.key(0), batch)
    styles = jax.tree.map(lambda leaf: leaf[np.arange(batch) % len(env.style_names)], env.styles)
    return lambda: jax.block_until_ready(program(keys, styles))


def _physics(batch: int, steps: int) -> Callable[[], Any]:
    """The bodies alone, moved by random velocities."""
    from envs.assistive import control, model, physics

    env = envs.make(ENVIRONMENT)
    ranges = jnp.asarray(model.joint_ranges())

    def play(key: jax.Array) -> jax.Array:
        def one_step(body: Any, key: jax.Array) -> tuple[Any, None]:
            actions = jax.random.uniform(key, (len(model.JOINTS),), minval=-1.0, maxval=1.0)
            return physics.step(body, control.velocities(body, actions, ranges)), None

        start = physics.at_rest(jnp.asarray(model.HOME), jnp.zeros(3))
        return jax.lax.scan(one_step, start, jax.random.split(key, steps))[0].angles

    program = over_population(play, compiler_options=env.compiler_options)
    keys = jax.random.split(jax.random.key(1), batch)
    return lambda: jax.block_until_ready(program(keys))


def _c_physics(batch: int, steps: int, cores: int) -> Callable[[], Any]:
    """The same model in C, one game after the other on every core."""
    import mujoco
    from mujoco import rollout

    from envs.assistive import control, model

    known = model.mujoco_model()
    data = mujoco.MjData(known)
    data.qpos[:] = model.HOME
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(known, full))
    mujoco.mj_getState(known, data, start, full)
    rng = np.random.default_rng(0)
    speeds = control.FULL_SPEED * rng.uniform(-1, 1, (batch, steps, known.nu))
    speeds = np.repeat(speeds, model.substeps(), axis=1)
    workers = [mujoco.MjData(known) for _ in range(cores)]
    pool = rollout.Rollout(nthread=cores)

    def play() -> None:
        pool.rollout(known, workers, np.tile(start, (batch, 1)), speeds)

    return play
