"""Partner styles of Spread: which food pays."""

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode


class Style(PyTreeNode):
    """A task; leading axis [style] when stacked.

    Attributes:
        target: level of the food that pays, int32 [].
        task: the same as a one-hot code, which ends the partner's observation, float32 [food].
    """

    target: jax.Array
    task: jax.Array


def style_names(num_foods: int) -> tuple[str, ...]:
    """Names of the styles, one for each food."""
    return tuple(f"level_{level}" for level in range(1, num_foods + 1))


def all_styles(num_foods: int) -> Style:
    """Returns all styles stacked, leading axis [style]."""
    return Style(target=jnp.arange(1, num_foods + 1, dtype=jnp.int32), task=jnp.eye(num_foods))
