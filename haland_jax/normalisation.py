"""Running statistics of what a player sees, for observations that differ in scale.

A learner reads (observation - mean) / std; what it has learnt is stored as a policy that reads
raw observations (`networks.fold_normalisation`), so that nobody else needs to know.
"""

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from haland_jax import networks

LEAST_STD = 0.05
"""Below it a number counts as constant, and is not blown up: what hardly varied in training may
vary with another partner, and would then move a policy far from all that it has learnt."""


class Normaliser(PyTreeNode):
    """Statistics of observations.

    Attributes:
        count: observations so far, float32 [].
        mean: float32 [O].
        variance: float32 [O].
    """

    count: jax.Array
    mean: jax.Array
    variance: jax.Array

    @property
    def std(self) -> jax.Array:
        """Standard deviation, at least `LEAST_STD`; 1 before anything was seen, float32 [O]."""
        seen = jnp.maximum(jnp.sqrt(self.variance), LEAST_STD)
        return jnp.where(self.count > 0, seen, 1.0)


def fresh(size: int) -> Normaliser:
    """Statistics of nothing, with which observations of a size stay as they are."""
    return Normaliser(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size))


def update(normaliser: Normaliser, observations: jax.Array) -> Normaliser:
    """Adds observations [..., O] (Chan et al., 1979, Eq. 2.1)."""
    rows = observations.reshape(-1, observations.shape[-1])
    count = normaliser.count + len(rows)
    mean, variance = jnp.mean(rows, axis=0), jnp.var(rows, axis=0)
    share = len(rows) / count
    apart = mean - normaliser.mean
    return Normaliser(
        count=count,
        mean=normaliser.mean + share * apart,
        variance=(1 - share) * normaliser.variance
        + share * variance
        + share * (1 - share) * jnp.square(apart),
    )


def normalise(normaliser: Normaliser | None, observations: jax.Array) -> jax.Array:
    """Observations [..., O] as a learner reads them; as they are without a normaliser."""
    if normaliser is None:
        return observations
    return (observations - normaliser.mean) / normaliser.std


def fold(normaliser: Normaliser | None, params: networks.Policy) -> networks.Policy:
    """The network that reads raw observations as `params` reads normalised ones."""
    if normaliser is None:
        return params
    return networks.fold_normalisation(params, normaliser.mean, normaliser.std)


def unfold(normaliser: Normaliser | None, params: networks.Policy) -> networks.Policy:
    """The network that reads normalised observations as `params` reads raw ones."""
    if normaliser is None:
        return params
    return networks.unfold_normalisation(params, normaliser.mean, normaliser.std)
