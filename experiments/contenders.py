"""The games that the benchmark plays: ours and JaxMARL's Overcooked, in the same loop."""

import dataclasses
import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import envs
from envs.base import Pair

PEER = "JaxMARL"
PEER_PLAIN = "JaxMARL, our restart"


@dataclasses.dataclass(frozen=True)
class Contender:
    """A way to play games.

    Attributes:
        name: for the table.
        start: key, number of games -> what is carried from step to step: the games' states
            and the observations of both players, which therefore cannot be optimised away.
        advance: carried, key -> carried after a step of random actions, reward [batch].
    """

    name: str
    start: Callable[[jax.Array, int], Any]
    advance: Callable[[Any, jax.Array], tuple[Any, jax.Array]]


def random_actions(key: jax.Array, batch: int) -> Pair:
    """Uniform actions of both players from one draw, int32 [batch] each."""
    both = jax.random.randint(key, (batch,), 0, 36)
    return Pair(both // 6, both % 6)


def restart(first: Any, following: Any, done: jax.Array) -> Any:
    """Puts `first` in the place of finished games."""

    def put(start: jax.Array, now: jax.Array) -> jax.Array:
        return jnp.where(done.reshape(-1, *[1] * (now.ndim - 1)), start, now)

    return jax.tree.map(put, first, following)


def _restart_if_any(first: Any, following: Any, done: jax.Array) -> Any:
    """Like `restart`; touches nothing while all games go on."""
    return jax.lax.cond(
        jnp.any(done), lambda now: restart(first, now, done), lambda now: now, following
    )


def _repeated(first: Any, batch: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (batch, *jnp.shape(leaf))), first)


def our_games(kitchen: str, encoding: str) -> Contender:
    """Our Overcooked with one of its observations."""
    env = envs.make(f"overcooked/{kitchen}", encoding=encoding)
    style = env.style(env.style_names[0])
    unused = jax.random.key(0)  # the kitchen is deterministic
    state, timestep = env.reset(unused, style)
    first = (state, timestep.observation)

    def advance(carried: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        actions = random_actions(key, carried[0].time.shape[0])
        step = jax.vmap(lambda state, actions: env.step(unused, state, actions, style))
        state, timestep = step(carried[0], actions)
        following = (state, timestep.observation)
        return _restart_if_any(first, following, timestep.done), timestep.reward

    return Contender(f"ours, {encoding}", lambda key, batch: _repeated(first, batch), advance)


def peer_games(kitchen: str, *, own_reset: bool) -> Contender:
    """JaxMARL's Overcooked, with its own reset at every step or with our restart."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it recommends its version 2, which has other rules
        jaxmarl = importlib.import_module("jaxmarl")
        peer = importlib.import_module("jaxmarl.environments.overcooked")
        env = jaxmarl.make("overcooked", layout=peer.overcooked_layouts[kitchen])
    first = env.reset(jax.random.key(0))[::-1]

    def advance(carried: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        batch = carried[0].step.shape[0]
        action_key, step_key = jax.random.split(key)
        actions = dict(zip(env.agents, random_actions(action_key, batch), strict=True))
        keys = jax.random.split(step_key, batch)
        step = env.step if own_reset else env.step_env
        observation, state, reward, done, _ = jax.vmap(step)(keys, carried[0], actions)
        following = (state, observation)
        if not own_reset:
            following = _restart_if_any(first, following, done["__all__"])
        return following, reward["agent_0"]

    name = PEER if own_reset else PEER_PLAIN
    return Contender(name, lambda key, batch: _repeated(first, batch), advance)


def compile_games(
    contender: Contender, batch: int, steps: int, *, shared_out: bool
) -> Callable[[], Any]:
    """Compiles a scan over `steps` steps of `batch` games.

    Args:
        contender: whose games.
        batch: games over all devices.
        steps: steps of each game.
        shared_out: a share of the games on every device, instead of all games in one program.

    Returns:
        A function that plays, waits for the end and returns what was carried last and the
        sum of rewards.
    """
    chosen = jax.devices() if shared_out else jax.devices()[:1]
    share = batch // len(chosen)

    def play(keys: jax.Array) -> Any:
        start_key, step_key = jax.random.split(keys[0])
        carried = contender.start(start_key, share)
        carried, rewards = jax.lax.scan(
            contender.advance, carried, jax.random.split(step_key, steps)
        )
        return carried, jnp.sum(rewards)[None]

    spread = PartitionSpec("device")
    sharded = jax.shard_map(
        play,
        mesh=Mesh(np.array(chosen), ("device",)),
        in_specs=spread,
        out_specs=spread,
        check_vma=False,
    )
    keys = jax.random.split(jax.random.key(0), len(chosen))
    program = jax.jit(sharded).lower(keys).compile()
    return lambda: jax.block_until_ready(program(keys))


def fastest(programs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Lets the programs take turns, so that a disturbance meets all; returns best seconds."""
    best = dict.fromkeys(programs, float("inf"))
    for program in programs.values():
        program()
    for _ in range(repeats):
        for name, program in programs.items():
            begin = time.perf_counter()
            program()
            best[name] = min(best[name], time.perf_counter() - begin)
    return best


def has_peer() -> bool:
    """Whether JaxMARL is installed."""
    return importlib.util.find_spec("jaxmarl") is not None
