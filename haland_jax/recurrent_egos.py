"""Universal egos with a memory (App. C.3): General, Instructed and Adaptive Ego.

They differ in what they are told besides what they see: nothing, the partner's style, or what
the partner did last. Their networks are the same; what an ego is not told is zero.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment
from haland_jax import recurrent
from haland_jax.learner import INITIAL_LOG_STD
from haland_jax.networks import DistributionKind
from haland_jax.normalisation import Normaliser
from haland_jax.recurrent import Memory, RecurrentActor, RecurrentCritic
from haland_jax.rollout import Agent

GENERAL, INSTRUCTED, ADAPTIVE = "General Ego", "Instructed Ego", "Adaptive Ego"
VARIANTS = (GENERAL, INSTRUCTED, ADAPTIVE)


class Tells(PyTreeNode):
    """What an ego is told; 1 or 0, float32 [] each.

    Attributes:
        label: the one-hot of the partner's style.
        action: the partner's last action.
    """

    label: jax.Array
    action: jax.Array

    def __call__(self, label: jax.Array, action: jax.Array) -> jax.Array:
        """What it is told: label [..., style] and action [..., A] side by side."""
        return jnp.concatenate([self.label * label, self.action * action], axis=-1)


def tells_of(seeds: int) -> Tells:
    """What every member is told, in the order of `VARIANTS`, leading axis [variant * seed]."""
    told = jnp.repeat(jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), seeds, axis=0)
    return Tells(label=told[:, 0], action=told[:, 1])


def networks_of(env: Environment) -> tuple[RecurrentActor, RecurrentCritic]:
    """The actor and the critic of an environment's universal ego."""
    kind = DistributionKind.GAUSSIAN if env.continuous else DistributionKind.CATEGORICAL
    return RecurrentActor(env.num_actions.ego, kind, INITIAL_LOG_STD), RecurrentCritic()


class UniversalEgo(Agent):
    """A trained universal ego in games with partners of one style.

    Attributes:
        actor: parameters, which read raw observations.
        tells: what it is told.
        label: the one-hot of the partner's style, [style].
    """

    actor: Any
    tells: Tells
    label: jax.Array

    def begin(self, num_games: int) -> tuple[Memory, jax.Array]:
        """Returns no memory, and that the games begin."""
        return recurrent.no_memory(num_games), jnp.ones(num_games, bool)

    def act(
        self, memory: tuple[Memory, jax.Array], observation: jax.Array, partner_action: jax.Array
    ) -> tuple[Any, tuple[Memory, jax.Array]]:
        """Plays one step; see `Agent`."""
        kept, began = memory
        labels = jnp.broadcast_to(self.label, (len(observation), *self.label.shape))
        now = (observation, self.tells(labels, partner_action), began)
        acting, kept = _apply(self.actor, *(part[None] for part in now), kept)
        acting = jax.tree.map(lambda leaf: leaf[0], acting)
        return acting, (kept, jnp.zeros_like(began))


def _apply(actor: Any, *sequence: Any) -> Any:
    return recurrent.actor_of(actor).apply(actor, *sequence)


def raw_actor(actor: Any, normaliser: Normaliser | None) -> Any:
    """The actor that reads raw observations: its first layer takes the normalisation up."""
    if normaliser is None:
        return actor
    mean, std = normaliser.mean, normaliser.std
    params = actor["params"]
    layer = params["body"]["memory_input"]
    seen = layer["kernel"][: mean.shape[0]] / std[:, None]
    folded = {
        "kernel": jnp.concatenate([seen, layer["kernel"][mean.shape[0] :]]),
        "bias": layer["bias"] - mean @ seen,
    }
    body = {**params["body"], "memory_input": folded}
    return {**actor, "params": {**params, "body": body}}
