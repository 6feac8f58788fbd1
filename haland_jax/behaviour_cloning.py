"""Behaviour cloning: policies that do what recorded players did (human proxies, App. H).

A policy is fitted to pairs of observation and action by maximum likelihood (Pomerleau, 1991). Many
are fitted at once in one program, each to recordings of its own.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from haland_jax import fit, networks
from haland_jax.fit import FitConfig
from haland_jax.networks import MLPActor, Policy
from haland_jax.population import over_population


class Demonstrations(PyTreeNode):
    """What players saw and did.

    Attributes:
        observation: float32 [..., N, O].
        action: int32 [..., N].
        weight: how often each pair counts, 0 or more, float32 [..., N].
    """

    observation: jax.Array
    action: jax.Array
    weight: jax.Array


@dataclasses.dataclass(frozen=True)
class CloningConfig:
    """How policies are cloned.

    Attributes:
        fit: optimiser and length.
        batch_size: pairs of a step.
        hidden: widths of the policy's layers.
    """

    fit: FitConfig = dataclasses.field(
        default_factory=lambda: FitConfig(
            learning_rate=2e-3, steps=2000, warmup_steps=50, weight_decay=1e-3
        )
    )
    batch_size: int = 256
    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self):
        if self.batch_size < 1:
            raise ValueError(f"batch_size is {self.batch_size}; expected at least 1")


def clone(
    key: jax.Array, demonstrations: Demonstrations, num_actions: int, config: CloningConfig
) -> tuple[Policy, dict[str, np.ndarray]]:
    """Fits a policy to each set of demonstrations.

    Args:
        key: consumed.
        demonstrations: leading axis [policy].
        num_actions: A.
        config: settings.

    Returns:
        Actors, leading axis [policy]; and "loss", the mean negative log-likelihood of the fit's
        last tenth in nats, and "accuracy", the share of pairs whose action is the most probable
        one, each [policy].

    Raises:
        ValueError: a set has nothing that counts.
        NonFiniteLoss: a fit diverged.
    """
    if not (np.asarray(demonstrations.weight).sum(axis=-1) > 0).all():
        raise ValueError("a policy has no demonstrations; expected at least one for each")
    actor = MLPActor(num_actions, hidden=config.hidden)

    def log_prob(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        logits: Any = networks.act(params, observation)
        chosen = jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], axis=-1)
        return chosen[..., 0]

    def loss(params: Any, key: jax.Array, batch: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
        del key
        return -log_prob(params, *batch).mean(), {}

    def sample(key: jax.Array, data: Demonstrations) -> tuple[jax.Array, jax.Array]:
        chance = data.weight / data.weight.sum()
        rows = jax.random.choice(key, chance.shape[0], (config.batch_size,), p=chance)
        return data.observation[rows], data.action[rows]

    learn = fit.make_fit_chunk(loss, sample, config.fit, config.fit.steps)

    def one(key: jax.Array, data: Demonstrations) -> tuple[Policy, dict[str, jax.Array]]:
        init_key, fit_key = jax.random.split(key)
        params = actor.init(init_key, data.observation[0])
        state, metrics = learn(fit.init_fit(fit_key, params, config.fit), data)
        logits: Any = networks.act(state.params, data.observation)
        right = jnp.argmax(logits, axis=-1) == data.action
        last = metrics["loss"][-max(1, config.fit.steps // 10) :]
        found = {
            "loss": last.mean(),
            "accuracy": (right * data.weight).sum() / data.weight.sum(),
        }
        return state.params, found

    keys = jax.random.split(key, demonstrations.weight.shape[0])
    policies, found = over_population(one)(keys, demonstrations)
    measured = {name: np.asarray(values) for name, values in found.items()}
    fit.check_finite("behaviour cloning", 0, {"loss": measured["loss"]})
    return policies, measured
