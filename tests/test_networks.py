"""Actors, critics and action distributions against numbers worked out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import networks
from haland_jax.networks import Gaussian, MLPActor, MLPCritic


def _actor_and_policy(kind="categorical"):
    actor = MLPActor(3, hidden=(8, 5), kind=kind, initial_log_std=-0.5)
    return actor, actor.init(jax.random.key(0), jnp.zeros(10))


def _forward(policy, observation):
    """The tanh network in NumPy."""
    x, names = observation, ("dense_0", "dense_1", "dense_2")
    for name in names:
        layer = policy["params"][name]
        x = x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])
        x = x if name == names[-1] else np.tanh(x)
    return x


def test_policy_is_the_pytree_that_the_archive_stores():
    _, policy = _actor_and_policy()
    layers = {"dense_0": (10, 8), "dense_1": (8, 5), "dense_2": (5, 3)}
    expected = {name: {"kernel": shape, "bias": shape[1:]} for name, shape in layers.items()}
    assert jax.tree.map(jnp.shape, policy) == {"params": expected}
    _, gaussian = _actor_and_policy("gaussian")
    assert jax.tree.map(jnp.shape, gaussian) == {"params": {**expected, "log_std": (3,)}}


def test_actor_computes_the_tanh_network_for_any_leading_axes():
    actor, policy = _actor_and_policy()
    observation = np.random.default_rng(0).normal(size=(4, 7, 10))
    logits = actor.apply(policy, observation)
    np.testing.assert_allclose(logits, _forward(policy, observation), atol=1e-6)


def test_gaussian_actor_returns_its_state_independent_log_std():
    actor, policy = _actor_and_policy("gaussian")
    distribution = actor.apply(policy, np.ones((4, 10)))
    np.testing.assert_allclose(distribution.mean, _forward(policy, np.ones((4, 10))), atol=1e-6)
    np.testing.assert_allclose(distribution.log_std, np.full((4, 3), -0.5))


def test_initial_kernels_are_orthogonal_with_their_gains():
    _, policy = _actor_and_policy()
    for name, gain in (("dense_0", 2**0.5), ("dense_1", 2**0.5), ("dense_2", 0.01)):
        kernel = np.asarray(policy["params"][name]["kernel"])
        gram = kernel.T @ kernel
        np.testing.assert_allclose(gram, gain**2 * np.eye(len(gram)), atol=1e-5 * gain**2)


def test_critic_returns_one_value_for_each_observation():
    critic = MLPCritic(hidden=(8, 5))
    params = critic.init(jax.random.key(0), jnp.zeros(10))
    observation = np.random.default_rng(0).normal(size=(4, 7, 10))
    values = critic.apply(params, observation)
    np.testing.assert_allclose(values, _forward(params, observation)[..., 0], atol=1e-6)
    last = np.asarray(params["params"]["dense_2"]["kernel"])
    np.testing.assert_allclose(np.linalg.norm(last), 1.0, rtol=1e-5)


def test_architecture_is_read_back_from_a_policy():
    for kind in ("categorical", "gaussian"):
        actor, policy = _actor_and_policy(kind)
        observation = jnp.linspace(-1.0, 1.0, 10)
        expected, result = actor.apply(policy, observation), networks.act(policy, observation)
        assert jax.tree.all(jax.tree.map(np.array_equal, expected, result))
    many = {"params": {f"dense_{index}": {} for index in (10, 2, 0, 1, 11)}}
    assert networks.layer_names(many) == ("dense_0", "dense_1", "dense_2", "dense_10", "dense_11")


def test_fold_normalisation_makes_the_policy_self_contained():
    actor, policy = _actor_and_policy()
    rng = np.random.default_rng(1)
    mean, std = rng.normal(size=10), rng.uniform(0.5, 2.0, size=10)
    observation = rng.normal(size=(6, 10))
    folded = networks.fold_normalisation(policy, mean, std)
    expected = actor.apply(policy, (observation - mean) / std)
    np.testing.assert_allclose(actor.apply(folded, observation), expected, atol=1e-6)


def test_categorical_quantities():
    p, q = np.array([0.5, 0.25, 0.25]), np.array([0.25, 0.25, 0.5])
    # the constant must not matter: logits are not normalised
    log_p, log_q = jnp.log(p) + 3.0, jnp.log(q) - 1.0
    np.testing.assert_allclose(networks.log_prob(log_p, jnp.array(1)), np.log(0.25), rtol=1e-6)
    np.testing.assert_allclose(networks.entropy(log_p), 1.5 * np.log(2.0), rtol=1e-6)
    # 0.5 log 2 + 0 - 0.25 log 2
    np.testing.assert_allclose(networks.kl(log_p, log_q), 0.25 * np.log(2.0), rtol=1e-5)
    assert networks.mode(log_q) == 2


def test_gaussian_quantities():
    p = Gaussian(jnp.array([0.0, 0.0]), jnp.array([0.0, 0.0]))
    q = Gaussian(jnp.array([1.0, 0.0]), jnp.log(jnp.array([2.0, 1.0])))
    # log 2 + (1 + 1) / (2 * 4) - 1/2 in the first dimension, 0 in the second
    np.testing.assert_allclose(networks.kl(p, q), np.log(2.0) - 0.25, rtol=1e-6)
    # log 1/2 + (4 + 1) / 2 - 1/2
    np.testing.assert_allclose(networks.kl(q, p), 2.0 - np.log(2.0), rtol=1e-6)
    density = -0.5 * ((3.0 - 1.0) / 2.0) ** 2 - np.log(2.0) - 0.5 * 0.5**2 - np.log(2.0 * np.pi)
    np.testing.assert_allclose(networks.log_prob(q, jnp.array([3.0, 0.5])), density, rtol=1e-6)
    np.testing.assert_allclose(
        networks.entropy(q), np.log(2.0) + np.log(2.0 * np.pi * np.e), rtol=1e-6
    )
    np.testing.assert_array_equal(networks.mode(q), [1.0, 0.0])


def test_samples_follow_their_distribution():
    probabilities = np.array([0.6, 0.3, 0.1])
    logits = jnp.broadcast_to(jnp.log(probabilities), (20_000, 3))
    actions = networks.sample(jax.random.key(0), logits)
    assert actions.dtype == jnp.int32
    np.testing.assert_allclose(np.bincount(actions) / 20_000, probabilities, atol=0.015)
    gaussian = Gaussian(jnp.full((20_000, 1), 2.0), jnp.full((20_000, 1), np.log(0.5)))
    draws = networks.sample(jax.random.key(1), gaussian)
    np.testing.assert_allclose([draws.mean(), draws.std()], [2.0, 0.5], atol=0.015)


def test_kl_between_kinds_is_refused():
    gaussian = Gaussian(jnp.zeros(3), jnp.zeros(3))
    with pytest.raises(TypeError, match="two distributions of one kind"):
        networks.kl(gaussian, jnp.zeros(3))
