"""Cloned policies do what was shown to them, as often as it was shown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import networks
from haland_jax.behaviour_cloning import CloningConfig, Demonstrations, clone
from haland_jax.fit import FitConfig

CONFIG = CloningConfig(FitConfig(learning_rate=5e-3, steps=400, warmup_steps=10), batch_size=64)


def shown(rule, seed, count=300):
    """Two numbers are seen; `rule` says what is done."""
    rng = np.random.default_rng(seed)
    seen = rng.normal(size=(count, 2)).astype(np.float32)
    return Demonstrations(seen, rule(seen, rng).astype(np.int32), np.ones(count, np.float32))


def stacked(*found):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


def test_each_policy_learns_its_own_demonstrations():
    def sign(seen, rng):
        return (seen[:, 0] > 0) * 1

    def other(seen, rng):
        return (seen[:, 1] > 0) * 2

    policies, found = clone(jax.random.key(0), stacked(shown(sign, 0), shown(other, 1)), 3, CONFIG)
    assert (found["accuracy"] > 0.95).all()
    assert (found["loss"] < 0.2).all()
    for index, rule in enumerate((sign, other)):
        fresh = shown(rule, 7)
        policy = jax.tree.map(lambda leaf, i=index: leaf[i], policies)
        did = np.argmax(networks.act(policy, fresh.observation), axis=-1)
        assert (did == fresh.action).mean() > 0.93


def test_chances_are_learnt_and_weights_count():
    """One action of four in the first half; the second half says otherwise, and does not count."""

    def sometimes(seen, rng):
        return rng.random(len(seen)) < 0.25

    first, second = shown(sometimes, 0, 2000), shown(lambda seen, rng: 1 + 0 * seen[:, 0], 1, 2000)
    both = jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)
    both = both.replace(weight=np.repeat(np.float32([1, 0]), 2000))
    policies, _ = clone(jax.random.key(0), stacked(both), 2, CONFIG)
    policy = jax.tree.map(lambda leaf: leaf[0], policies)
    chance = jax.nn.softmax(networks.act(policy, jnp.asarray(first.observation)))[:, 1].mean()
    assert chance == pytest.approx(0.25, abs=0.06)


def test_a_policy_without_demonstrations_is_refused():
    nothing = shown(lambda seen, rng: 0 * seen[:, 0], 0).replace(weight=np.zeros(300, np.float32))
    with pytest.raises(ValueError, match="a policy has no demonstrations"):
        clone(jax.random.key(0), stacked(nothing), 2, CONFIG)
    with pytest.raises(ValueError, match="batch_size is 0"):
        CloningConfig(batch_size=0)
