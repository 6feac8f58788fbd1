"""Egos whose partners learn beside them: self-play, and fictitious co-play (Strouse et al., 2021).

One ego and one partner play the games of all styles. The partner is told the style, as every
partner is, and held to it by the environment; the ego is told nothing. In fictitious co-play such
partners, as they were at the start, in the middle and at the end of their learning, become the
frozen partners of another ego.
"""

import jax
import jax.numpy as jnp

from envs.base import Environment
from haland_jax import ppo
from haland_jax.learner import StylesByGame, TrainState, init_learner, make_networks
from haland_jax.networks import Policy
from haland_jax.population import over_population
from haland_jax.ppo import PPOConfig


def all_styles_for(env: Environment, members: int) -> StylesByGame:
    """Returns all styles for every member, leading axes [member, style]."""
    return StylesByGame(
        jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (members, *leaf.shape)), env.styles)
    )


def init_self_play(
    env: Environment, config: PPOConfig, key: jax.Array, num_pairs: int
) -> TrainState:
    """Starts pairs that learn with each other.

    Args:
        env: the environment.
        config: settings; `num_envs` is a multiple of the styles.
        key: consumed.
        num_pairs: pairs.

    Returns:
        Training states with leading axis [pair].

    Raises:
        ValueError: the styles cannot share the games in equal parts.
    """
    ppo.expect_equal_shares("self_play", config, len(env.style_names), "styles")
    actors, critic = make_networks(env)
    sizes = env.observation_sizes

    def start(key: jax.Array, styles: StylesByGame) -> TrainState:
        ego_key, partner_key, train_key = jax.random.split(key, 3)
        ego = init_learner(ego_key, actors.ego, critic, sizes.ego, config)
        partner = init_learner(partner_key, actors.partner, critic, sizes.partner, config)
        return ppo.init_train_state(env, config, train_key, ego, partner, styles)

    program = over_population(start, compiler_options=env.compiler_options)
    return program(jax.random.split(key, num_pairs), all_styles_for(env, num_pairs))


def init_co_play(
    env: Environment, config: PPOConfig, key: jax.Array, pool: Policy, num_egos: int
) -> TrainState:
    """Starts egos that learn with a pool of frozen partners, each of which plays every style.

    Args:
        env: the environment.
        config: settings; `num_envs` is a multiple of styles times partners.
        key: consumed.
        pool: actors, leading axis [partner].
        num_egos: egos.

    Returns:
        Training states with leading axis [ego].

    Raises:
        ValueError: styles and partners cannot share the games in equal parts.
    """
    styles = len(env.style_names)
    partners = jax.tree.map(lambda leaf: jnp.tile(leaf, (styles,) + (1,) * (leaf.ndim - 1)), pool)
    count = jax.tree.leaves(partners)[0].shape[0]
    ppo.expect_equal_shares("co_play", config, count, "partners times styles")
    actors, critic = make_networks(env)

    def start(partners: Policy, key: jax.Array, styles: StylesByGame) -> TrainState:
        ego_key, train_key = jax.random.split(key)
        ego = init_learner(ego_key, actors.ego, critic, env.observation_sizes.ego, config)
        return ppo.init_train_state(env, config, train_key, ego, partners, styles)

    program = over_population(start, shared=1, compiler_options=env.compiler_options)
    return program(partners, jax.random.split(key, num_egos), all_styles_for(env, num_egos))
