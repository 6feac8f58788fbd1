"""What learns: networks, optimiser and statistics of a player, and the state of its training."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax.struct import PyTreeNode

from envs.base import Environment, Pair
from haland_jax import normalisation
from haland_jax.networks import DistributionKind, MLPActor, MLPCritic, Policy
from haland_jax.normalisation import Normaliser
from haland_jax.ppo_loss import PPOConfig

INITIAL_LOG_STD = -0.5
"""Of continuous actions, which lie between -1 and 1."""


class Learner(PyTreeNode):
    """A player that learns.

    Attributes:
        actor: parameters that read normalised observations.
        critic: likewise.
        optimizer_state: of both.
        normaliser: statistics of what it has seen; None where observations are read as they are.
    """

    actor: Policy
    critic: Any
    optimizer_state: Any
    normaliser: Normaliser | None = None


class TrainState(PyTreeNode):
    """Everything that training one pair needs to go on.

    Attributes:
        update: updates done, int32 [].
        key: never consumed; folded with `update`.
        ego: the ego's learner.
        partner: the partner's learner, or frozen actors with leading axis [partner].
        env_states: states of the games, leading axis [env].
        observations: `Pair` of [env, O].
        guides: frozen actors that the ego is drawn to (`PPOConfig.guidance`), leading axis [guide];
            each guides an equal share of the games, in order. None: nobody does.
    """

    update: jax.Array
    key: jax.Array
    ego: Learner
    partner: Learner | Policy
    env_states: Any
    observations: Pair
    guides: Policy | None = None


class StylesByGame(PyTreeNode):
    """Styles that share the games of one ego, in equal parts and in this order.

    The frozen partners of such games are in the order of their styles, equally many of each.

    Attributes:
        styles: leading axis [style].
    """

    styles: Any


def make_networks(env: Environment) -> tuple[Pair, MLPCritic]:
    """Returns the actors of both players and the critic that either uses."""
    kind = DistributionKind.GAUSSIAN if env.continuous else DistributionKind.CATEGORICAL
    actors = (MLPActor(n, kind=kind, initial_log_std=INITIAL_LOG_STD) for n in env.num_actions)
    return Pair(*actors), MLPCritic()


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam on clipped gradients; the learning rate is applied by the caller."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )


def init_learner(
    key: jax.Array, actor: MLPActor, critic: MLPCritic, size: int, config: PPOConfig
) -> Learner:
    """Returns a fresh learner for observations of a size; consumes `key`."""
    actor_key, critic_key = jax.random.split(key)
    observation = jnp.zeros(size)
    return learner_from(
        actor.init(actor_key, observation),
        critic.init(critic_key, observation),
        config,
        normalisation.fresh(size) if config.normalise else None,
    )


def learner_from(
    actor: Policy, critic: Any, config: PPOConfig, normaliser: Normaliser | None = None
) -> Learner:
    """Returns a learner that starts from networks that read raw observations."""
    actor, critic = (normalisation.unfold(normaliser, network) for network in (actor, critic))
    return Learner(actor, critic, make_optimizer(config).init((actor, critic)), normaliser)
