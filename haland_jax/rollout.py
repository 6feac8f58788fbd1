"""Playing a pair of policies: returns, events, observations and states of whole games."""

from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment, Pair
from haland_jax import networks
from haland_jax.networks import Policy


class Games(PyTreeNode):
    """Outcomes of games that were played in parallel.

    Attributes:
        returns: team reward of each game, undiscounted, float32 [G].
        lengths: steps of each game, int32 [G].
        events: events by game and player, summed over the game, float32 [G, agent, event].
    """

    returns: jax.Array
    lengths: jax.Array
    events: jax.Array


class Recording(PyTreeNode):
    """A game step by step; entries after its end are repetitions, marked by `alive`.

    Attributes:
        states: environment states before each step, leading axis [T].
        observations: `Pair` of observations before each step, [T, O].
        actions: `Pair` of actions, [T].
        rewards: team reward, float32 [T].
        alive: whether the game was still on, bool [T].
    """

    states: Any
    observations: Pair
    actions: Pair
    rewards: jax.Array
    alive: jax.Array


def play(
    env: Environment,
    key: jax.Array,
    ego: Policy,
    partner: Policy,
    style: Any,
    *,
    num_games: int,
    greedy: bool = False,
) -> Games:
    """Plays whole games of one pair from the usual start.

    Args:
        env: the environment.
        key: consumed.
        ego: parameters of the ego's actor.
        partner: parameters of the partner's actor.
        style: the partner's style.
        num_games: games G, played in parallel.
        greedy: play the most probable action; argmax play of pairs can deadlock, so the
            default samples.
    """
    reset_key, play_key = jax.random.split(key)
    reset_keys = jax.random.split(reset_key, num_games)
    states, timesteps = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, style)
    num_events = len(env.event_names)
    games = Games(
        returns=jnp.zeros(num_games),
        lengths=jnp.zeros(num_games, jnp.int32),
        events=jnp.zeros((num_games, 2, num_events)),
    )

    def one_step(carry, step_key):
        states, observations, alive, games = carry
        act_key, env_key = jax.random.split(step_key)
        actions = choose_actions(act_key, ego, partner, observations, greedy=greedy)
        env_keys = jax.random.split(env_key, num_games)
        states, timesteps = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            env_keys, states, actions, style
        )
        games = Games(
            returns=games.returns + timesteps.reward * alive,
            lengths=games.lengths + alive,
            events=games.events + timesteps.events * alive[:, None, None],
        )
        return (states, timesteps.observation, alive & ~timesteps.done, games), None

    carry = (states, timesteps.observation, jnp.ones(num_games, bool), games)
    carry, _ = jax.lax.scan(one_step, carry, jax.random.split(play_key, env.max_steps))
    return carry[-1]


def record(
    env: Environment,
    key: jax.Array,
    ego: Policy,
    partner: Policy,
    style: Any,
    *,
    greedy: bool = False,
    random_share: float = 0.0,
) -> Recording:
    """Plays one game of a pair and keeps every step; arguments as in `play`.

    With chance `random_share` the game goes on from a random moment (`training_reset`).
    """
    reset_key, play_key = jax.random.split(key)
    if random_share:
        state, timestep = env.training_reset(reset_key, style, random_share)
    else:
        state, timestep = env.reset(reset_key, style)

    def one_step(carry, step_key):
        state, observation, alive = carry
        act_key, env_key = jax.random.split(step_key)
        actions = choose_actions(act_key, ego, partner, observation, greedy=greedy)
        following, timestep = env.step(env_key, state, actions, style)
        reward = timestep.reward * alive
        kept = Recording(state, observation, actions, reward, alive)
        return (following, timestep.observation, alive & ~timestep.done), kept

    carry = (state, timestep.observation, jnp.ones((), bool))
    return jax.lax.scan(one_step, carry, jax.random.split(play_key, env.max_steps))[1]


def choose_actions(
    key: jax.Array, ego: Policy, partner: Policy, observations: Pair, *, greedy: bool = False
) -> Pair:
    """Draws both players' actions for observations with any leading axes; consumes `key`."""
    distributions = Pair(
        networks.act(ego, observations.ego), networks.act(partner, observations.partner)
    )
    if greedy:
        return Pair(*(networks.mode(distribution) for distribution in distributions))
    keys = jax.random.split(key)
    return Pair(*(networks.sample(k, d) for k, d in zip(keys, distributions, strict=True)))
