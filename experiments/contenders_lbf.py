"""The level-based foraging that the benchmark plays: ours and Jumanji's, in the same loop.

Both spawn random fields of 15 x 15 cells with two players and eight foods, and restart with a
new one.
"""

import importlib
import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from envs.lbf import dynamics, features, observation
from envs.lbf.dynamics import Rules
from envs.lbf.spawn import Spawning, random_field
from experiments.contenders import Contender, random_actions, restart

PEER = "Jumanji"
PEER_PLAIN = "Jumanji, our restart"
ENCODINGS = {
    "flat": ("vector", observation.flat),
    "features": ("vector", features.features),
    "grid": ("grid", observation.grid),
}
"""Our observations: the kind of the peer's that each is compared with, and its function."""
RULES = Rules(rows=15, columns=15, max_steps=100)
SPAWNING = Spawning(num_players=2, num_foods=8, max_player_level=2)


def _restarted(
    draw: Callable[[jax.Array], Any], key: jax.Array, following: Any, done: jax.Array
) -> Any:
    """Puts freshly drawn games in the place of finished ones; draws none while all go on."""
    return jax.lax.cond(
        jnp.any(done),
        lambda now: restart(jax.vmap(draw)(jax.random.split(key, len(done))), now, done),
        lambda now: now,
        following,
    )


def our_fields(encoding: str) -> Contender:
    """Our engine with one of its observations."""
    _, observe = ENCODINGS[encoding]

    def draw(key: jax.Array) -> Any:
        state = random_field(key, RULES, SPAWNING)
        return state, observe(RULES, state)

    def play(state: Any, actions: jax.Array) -> Any:
        transition = dynamics.step(RULES, state, actions)
        after = transition.after
        done = dynamics.nothing_left(after) | dynamics.time_is_up(RULES, after)
        return (after, observe(RULES, after)), transition.reward, done

    def advance(carried: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        action_key, draw_key = jax.random.split(key)
        actions = jnp.stack(random_actions(action_key, len(carried[0].time)), axis=1)
        following, reward, done = jax.vmap(play)(carried[0], actions)
        return _restarted(draw, draw_key, following, done), reward[:, 0]

    return Contender(f"ours, {encoding}", _many(draw), advance)


def peer_fields(kind: str, *, own_reset: bool) -> Contender:
    """Jumanji's LevelBasedForaging, with its own automatic reset or with our restart.

    Only the players' views are kept of its observation, so that the compiler may leave out its
    mask of possible actions, which ours does not have.

    Args:
        kind: `vector` or `grid`.
        own_reset: its `AutoResetWrapper`, which under `vmap` draws a field on every step.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        routing = importlib.import_module("jumanji.environments.routing.lbf")
        generators = importlib.import_module("jumanji.environments.routing.lbf.generator")
        wrappers = importlib.import_module("jumanji.wrappers")
    generator = generators.RandomGenerator(
        grid_size=RULES.rows,
        fov=RULES.reach,
        num_agents=SPAWNING.num_players,
        num_food=SPAWNING.num_foods,
        max_agent_level=SPAWNING.max_player_level,
        force_coop=SPAWNING.force_coop,
    )
    env = routing.LevelBasedForaging(
        generator=generator, time_limit=RULES.max_steps, grid_observation=kind == "grid"
    )
    if own_reset:
        env = wrappers.AutoResetWrapper(env)

    def draw(key: jax.Array) -> Any:
        state, timestep = env.reset(key)
        return state, timestep.observation.agents_view

    def play(state: Any, actions: jax.Array) -> Any:
        state, timestep = env.step(state, actions)
        return (state, timestep.observation.agents_view), timestep.reward, timestep.last()

    def advance(carried: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        action_key, draw_key = jax.random.split(key)
        actions = jnp.stack(random_actions(action_key, len(carried[0].step_count)), axis=1)
        following, reward, done = jax.vmap(play)(carried[0], actions)
        if not own_reset:
            following = _restarted(draw, draw_key, following, done)
        return following, reward[:, 0]

    return Contender(PEER if own_reset else PEER_PLAIN, _many(draw), advance)


def _many(draw: Callable[[jax.Array], Any]) -> Callable[[jax.Array, int], Any]:
    return lambda key, batch: jax.vmap(draw)(jax.random.split(key, batch))


def has_peer() -> bool:
    """Whether Jumanji is installed."""
    return importlib.util.find_spec("jumanji") is not None
