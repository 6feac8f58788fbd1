"""Rewards of Spread: the team's, and the learning aid on the way to it.

The aid is a difference of potentials, gamma being 1: whatever the players do in between, a way
that ends where it began earns nothing, so there is nothing to farm.
"""

import dataclasses

import jax
import jax.numpy as jnp

from envs.lbf import dynamics
from envs.lbf.dynamics import State, Transition


@dataclasses.dataclass(frozen=True)
class ShapingWeights:
    """Weights of the shaping, in units of the team reward (the target pays 1).

    Attributes:
        approach: for each step nearer to the target; the farthest start is 8 steps away.
        meet: for both players standing beside the target.
        take: for taking it together.
        waste: for each other food that is taken, which only costs time.
    """

    approach: float = 0.03
    meet: float = 0.2
    take: float = 0.3
    waste: float = -0.05


def team_reward(transition: Transition, target: jax.Array) -> jax.Array:
    """Returns 1 when the target was taken, else 0, float32 [].

    Args:
        transition: the step.
        target: level that pays, int32 []; food k is the one of level k + 1.
    """
    return jnp.any(transition.taken & _is_target(transition.after, target)).astype(jnp.float32)


def potentials(state: State, target: jax.Array) -> dict[str, jax.Array]:
    """Returns the named quantities whose changes the shaping pays for, each float32 [player].

    Args:
        state: a moment.
        target: level that pays, int32 [].
    """
    is_target = _is_target(state, target)
    south, east = dynamics.offsets(state)
    steps = jnp.maximum(jnp.abs(south) + jnp.abs(east) - 1, 0)
    gone = state.food_level == 0
    reached = jnp.any(gone & is_target)
    together = jnp.all(jnp.any((steps == 0) & is_target, axis=1))
    amounts = {
        "approach": -jnp.sum(jnp.where(is_target, steps, 0), axis=1),
        "meet": together * jnp.ones(2),
        "take": reached * jnp.ones(2),
        "waste": jnp.sum(gone & ~is_target) * jnp.ones(2),
    }
    return {name: jnp.asarray(amount, jnp.float32) for name, amount in amounts.items()}


def shaping_terms(
    transition: Transition, target: jax.Array, weights: ShapingWeights
) -> dict[str, jax.Array]:
    """Returns each player's shaped reward by term, each float32 [player]; add them up.

    Args:
        transition: the step.
        target: level that pays, int32 [].
        weights: worth of each term.
    """
    before, after = (potentials(state, target) for state in (transition.before, transition.after))
    return {name: getattr(weights, name) * (after[name] - before[name]) for name in after}


def _is_target(state: State, target: jax.Array) -> jax.Array:
    return jnp.arange(1, len(state.food_level) + 1) == target
