"""What happened in Spread: foods taken by level and by place, steps near each place."""

import jax
import jax.numpy as jnp
import numpy as np

from envs.lbf.dynamics import Transition


def event_names(num_foods: int, place_names: tuple[str, ...]) -> tuple[str, ...]:
    """Names one player's events: by level, by place, and steps in the cells that touch a place."""
    return (
        *(f"take_food_{level}" for level in range(1, num_foods + 1)),
        *(f"take_food@{place}" for place in place_names),
        *(f"stand@{place}" for place in place_names),
    )


def count_events(places: np.ndarray, transition: Transition) -> jax.Array:
    """Returns how often each event happened in this step, float32 [player, event].

    A food counts for all players that loaded it. A cell that touches a place by a side or a
    corner is near it, whether its food is still there or not.

    Args:
        places: where foods lie at the start, int [place, 2]; food k is the one of level k + 1.
        transition: the step.
    """
    took = transition.loading & transition.taken
    after = transition.after
    lies_at = jnp.all(after.food_place[:, None] == places, axis=-1)
    took_at = jnp.any(took[:, :, None] & lies_at, axis=1)
    near = jnp.max(jnp.abs(after.place[:, None] - places), axis=-1) <= 1
    return jnp.concatenate([took, took_at, near], axis=1).astype(jnp.float32)
