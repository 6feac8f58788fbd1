"""Policies, critics, and the two families of action distribution.

A policy is the parameter pytree of an `MLPActor`. What an actor returns is a *distribution*: the
logits of a categorical (an array) or a `Gaussian` (mean and log-std). `sample`, `log_prob`,
`entropy`, `kl` and `mode` accept either, so that the code around them does not branch.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

Policy = Any
"""`{"params": {"dense_0": {"kernel", "bias"}, "dense_1": ..., ["log_std": [A]]}}`."""

LOG_TWO_PI = 1.8378770664093453


class DistributionKind(StrEnum):
    """The family of an actor's action distribution."""

    CATEGORICAL = "categorical"
    GAUSSIAN = "gaussian"


class Gaussian(NamedTuple):
    """Independent normals over the action's dimensions. `mean` [..., A], `log_std` [..., A]."""

    mean: Array
    log_std: Array


Distribution = Array | Gaussian
"""Logits [..., A] of a categorical, or a `Gaussian`."""


def _dense(features: int, gain: float, name: str) -> nn.Dense:
    initialiser = nn.initializers.orthogonal(gain)
    return nn.Dense(features, kernel_init=initialiser, name=name)


class MLPActor(nn.Module):
    """Tanh network from an observation [..., O] to an action distribution over A.

    Layers are named dense_0, dense_1, ...; orthogonal kernels with gain sqrt(2) in the hidden
    layers and 0.01 in the last (an almost uniform start), zero biases. A Gaussian actor keeps a
    state-independent `log_std` [A] beside its layers, with which `Gaussian` is returned; a
    categorical one returns logits [..., A]. Sizes are those of method stage 1 (obs-64-64-A).
    """

    action_dim: int
    hidden: Sequence[int] = (64, 64)
    kind: str = DistributionKind.CATEGORICAL
    initial_log_std: float = 0.0

    @nn.compact
    def __call__(self, observation: Array) -> Distribution:
        kind = DistributionKind(self.kind)
        x = observation
        for index, width in enumerate(self.hidden):
            x = jnp.tanh(_dense(width, 2.0**0.5, f"dense_{index}")(x))
        x = _dense(self.action_dim, 0.01, f"dense_{len(self.hidden)}")(x)
        if kind == DistributionKind.CATEGORICAL:
            return x
        constant = nn.initializers.constant(self.initial_log_std)
        log_std = self.param("log_std", constant, (self.action_dim,))
        return Gaussian(mean=x, log_std=jnp.broadcast_to(log_std, x.shape))


class MLPCritic(nn.Module):
    """Tanh network from an observation [..., O] to a value [...]; last layer's gain 1."""

    hidden: Sequence[int] = (64, 64)

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x = observation
        for index, width in enumerate(self.hidden):
            x = jnp.tanh(_dense(width, 2.0**0.5, f"dense_{index}")(x))
        return _dense(1, 1.0, f"dense_{len(self.hidden)}")(x)[..., 0]


def layer_names(policy: Policy) -> tuple[str, ...]:
    """The names dense_0, dense_1, ... of a policy's layers, first to last."""
    names = [name for name in policy["params"] if name.startswith("dense_")]
    return tuple(sorted(names, key=lambda name: int(name.removeprefix("dense_"))))


def distribution_kind(policy: Policy) -> DistributionKind:
    """Gaussian if the policy carries a `log_std`, else categorical."""
    gaussian = "log_std" in policy["params"]
    return DistributionKind.GAUSSIAN if gaussian else DistributionKind.CATEGORICAL


def actor_of(policy: Policy) -> MLPActor:
    """The `MLPActor` whose parameters `policy` (of any leading axes) is, read from its shapes."""
    names = layer_names(policy)
    widths = [policy["params"][name]["bias"].shape[-1] for name in names]
    return MLPActor(widths[-1], tuple(widths[:-1]), distribution_kind(policy))


def act(policy: Policy, observation: Array) -> Distribution:
    """The action distribution of one policy for `observation` [..., O]."""
    return actor_of(policy).apply(policy, observation)  # pyright: ignore[reportReturnType]


def fold_normalisation(policy: Policy, mean: Array, std: Array) -> Policy:
    """The policy that reads raw observations as `policy` reads (observation - mean) / std.

    `mean` and `std` are [O] with std > 0. The first layer takes them up, so that a stored policy
    is self-contained (method stage 1).
    """
    first = policy["params"]["dense_0"]
    kernel = first["kernel"] / std[:, None]
    bias = first["bias"] - mean @ kernel
    folded = {**first, "kernel": kernel, "bias": bias}
    return {**policy, "params": {**policy["params"], "dense_0": folded}}


def unfold_normalisation(policy: Policy, mean: Array, std: Array) -> Policy:
    """The policy that reads (observation - mean) / std as `policy` reads raw observations."""
    return fold_normalisation(policy, -mean / std, 1.0 / std)


def sample(key: Array, distribution: Distribution) -> Array:
    """Draw an action: int32 [...] from logits [..., A], or float [..., A] from a `Gaussian`."""
    if isinstance(distribution, Gaussian):
        noise = jax.random.normal(key, distribution.mean.shape)
        return distribution.mean + jnp.exp(distribution.log_std) * noise
    return jax.random.categorical(key, distribution)


def tremble(distribution: Distribution, chance: float) -> Distribution:
    """The distribution that plays uniformly at random with a `chance` in [0, 1).

    Raises:
        TypeError: if the distribution is a `Gaussian`, which has no uniform action.
    """
    if isinstance(distribution, Gaussian):
        raise TypeError("tremble takes the logits of a categorical, got a Gaussian")
    uniform = 1.0 / distribution.shape[-1]
    return jnp.log((1.0 - chance) * jax.nn.softmax(distribution) + chance * uniform)


def mode(distribution: Distribution) -> Array:
    """The most probable action: argmax of the logits, or the mean."""
    if isinstance(distribution, Gaussian):
        return distribution.mean
    return jnp.argmax(distribution, axis=-1)


def log_prob(distribution: Distribution, action: Array) -> Array:
    """Log-probability (nats) of `action`: [...], summed over the dimensions of a `Gaussian`."""
    if isinstance(distribution, Gaussian):
        scaled = (action - distribution.mean) * jnp.exp(-distribution.log_std)
        terms = -0.5 * jnp.square(scaled) - distribution.log_std - 0.5 * LOG_TWO_PI
        return jnp.sum(terms, axis=-1)
    log_probabilities = jax.nn.log_softmax(distribution)
    return jnp.take_along_axis(log_probabilities, action[..., None], axis=-1)[..., 0]


def entropy(distribution: Distribution) -> Array:
    """Entropy in nats [...]; for a `Gaussian` the differential entropy, summed over dimensions."""
    if isinstance(distribution, Gaussian):
        return jnp.sum(distribution.log_std + 0.5 * (1.0 + LOG_TWO_PI), axis=-1)
    log_probabilities = jax.nn.log_softmax(distribution)
    return -jnp.sum(jnp.exp(log_probabilities) * log_probabilities, axis=-1)


def kl(p: Distribution, q: Distribution) -> Array:
    """KL(p || q) in nats [...], summed over actions (categorical) or dimensions (`Gaussian`).

    Raises:
        TypeError: if one is categorical and the other Gaussian.
    """
    if isinstance(p, Gaussian) and isinstance(q, Gaussian):
        ratio = jnp.exp(2.0 * (p.log_std - q.log_std))
        shift = jnp.square((p.mean - q.mean) * jnp.exp(-q.log_std))
        return jnp.sum(q.log_std - p.log_std + 0.5 * (ratio + shift - 1.0), axis=-1)
    if isinstance(p, Gaussian) or isinstance(q, Gaussian):
        raise TypeError(
            f"kl takes two distributions of one kind, got {type(p).__name__} and "
            f"{type(q).__name__}; decode with the architecture of the policy compared with"
        )
    log_p, log_q = jax.nn.log_softmax(p), jax.nn.log_softmax(q)
    return jnp.sum(jnp.exp(log_p) * (log_p - log_q), axis=-1)
