"""Eq. 4 against NumPy, the encoder's eye for neurons, and a small overfit."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import fit, networks, policy_vae
from haland_jax.hypernetwork import HypernetworkConfig, PolicyArchitecture
from haland_jax.policy_vae import PolicyBatch, PolicyVAE, PolicyVAEConfig

SMALL = PolicyVAEConfig(
    latent_dim=8,
    encoder_hidden=16,
    states_per_policy=64,
    hypernetwork=HypernetworkConfig(hidden=16, head_hidden=16),
)


def _policies(count, kind="categorical", gain=1.0):
    """Policies of a shared initialisation, then moved apart: leading axis [count]."""
    actor = networks.MLPActor(4, hidden=(16, 16), kind=kind)
    shared = actor.init(jax.random.key(0), jnp.zeros(8))

    def vary(key):
        own = actor.init(key, jnp.zeros(8))
        policy = jax.tree.map(lambda a, b: 0.7 * a + 0.7 * b, shared, own)
        policy["params"]["dense_2"]["kernel"] = jax.random.normal(key, (16, 4)) * gain
        for index, layer in enumerate(policy["params"].values()):
            if isinstance(layer, dict):
                bias_key = jax.random.fold_in(key, index)
                layer["bias"] = 0.1 * jax.random.normal(bias_key, layer["bias"].shape)
        if kind == "gaussian":
            policy["params"]["log_std"] = -0.5 + 0.1 * jax.random.normal(key, (4,))
        return policy

    return jax.jit(jax.vmap(vary))(jax.random.split(jax.random.key(1), count))


def _vae(policies, **changes):
    config = dataclasses.replace(SMALL, **changes)
    vae = PolicyVAE(PolicyArchitecture.from_params(policies), config)
    first = jax.tree.map(lambda leaf: leaf[0], policies)
    return vae, jax.jit(vae.init)(jax.random.key(2), first)


def _logits(policy, states):
    x = np.asarray(states, np.float64)
    for index in range(3):
        layer = policy["params"][f"dense_{index}"]
        x = x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        x = np.tanh(x) if index < 2 else x
    return x


def _divergence(kind, policy, decoded, states):
    """KL(original || decoded), mean over states, in NumPy."""
    p, q = _logits(policy, states), _logits(decoded, states)
    if kind == "categorical":
        p = np.exp(p) / np.exp(p).sum(-1, keepdims=True)
        q = np.exp(q) / np.exp(q).sum(-1, keepdims=True)
        return np.mean(np.sum(p * np.log(p / q), axis=-1))
    s, t = (np.exp(np.asarray(each["params"]["log_std"])) for each in (policy, decoded))
    return np.mean(np.sum(np.log(t / s) + (s**2 + (p - q) ** 2) / (2 * t**2) - 0.5, axis=-1))


def test_posterior_kl_by_hand():
    posterior = policy_vae.Posterior(jnp.array([1.0, 2.0]), jnp.array([0.0, np.log(4.0)]))
    # 1/2 (1 + 1 - 0 - 1) + 1/2 (4 + 4 - log 4 - 1)
    expected = 0.5 + 0.5 * (7.0 - np.log(4.0))
    np.testing.assert_allclose(policy_vae.posterior_kl(posterior), expected, rtol=1e-6)


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
def test_loss_is_equation_4(kind):
    policies = _policies(2, kind)
    # a posterior so narrow that its noise is below the tolerance
    vae, params = _vae(policies, kl_coefficient=1e-3, latent_noise=0.0, initial_posterior_std=1e-7)
    states = jax.random.normal(jax.random.key(3), (2, 5, 8))
    batch = PolicyBatch(policies, states, jnp.array([1.0, 3.0]))
    loss, metrics = jax.jit(policy_vae.make_loss_fn(vae))(params, jax.random.key(4), batch)

    by_policy, prior = [], []
    for index in range(2):
        policy = jax.tree.map(lambda leaf, index=index: leaf[index], policies)
        mean, log_variance = jax.jit(partial(vae.apply, method="encode"))(params, policy)
        decoded = jax.jit(partial(vae.apply, method="decode"))(params, mean)
        by_policy.append(_divergence(kind, policy, decoded, states[index]))
        prior.append(0.5 * np.sum(mean**2 + np.exp(log_variance) - log_variance - 1.0))
    expected = (by_policy[0] + 3.0 * by_policy[1]) / 4.0
    assert expected > 0.01
    np.testing.assert_allclose(metrics["reconstruction"], expected, rtol=1e-4)
    np.testing.assert_allclose(metrics["worst_policy"], max(by_policy), rtol=1e-4)
    np.testing.assert_allclose(loss, expected + 1e-3 * np.mean(prior), rtol=1e-4)


def test_perturbation_is_relative_to_each_dimension():
    latents = jnp.array([[0.0, 100.0], [2.0, 500.0]])  # deviations 1 and 200
    keys = jax.random.split(jax.random.key(0), 4000)
    noisy = jax.vmap(lambda key: policy_vae.perturb(key, latents, 0.1))(keys)
    np.testing.assert_allclose(
        (np.mean(noisy, axis=0) - latents) / np.array([1.0, 200.0]), 0.0, atol=0.01
    )
    np.testing.assert_allclose(np.std(noisy, axis=0), [[0.1, 20.0]] * 2, rtol=0.05)


def test_conv1d_is_a_convolution_of_width_three():
    x = np.random.default_rng(0).normal(size=(5, 2))
    module = policy_vae.Conv1D(3)
    params = module.init(jax.random.key(0), x)
    window = np.asarray(params["params"]["window"]["kernel"]).reshape(3, 2, 3)
    padded = np.concatenate([np.zeros((1, 2)), x, np.zeros((1, 2))])
    expected = [sum(padded[row + tap] @ window[tap] for tap in range(3)) for row in range(5)]
    np.testing.assert_allclose(module.apply(params, x), expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
def test_encoder_distinguishes_policies_and_neurons(kind):
    policies = _policies(3, kind)
    vae, params = _vae(policies)
    posterior = policy_vae.encode(vae, params, policies)
    assert posterior.mean.shape == posterior.log_variance.shape == (3, 8)
    spread = np.std(posterior.mean, axis=0)
    assert spread.mean() > 0.05 * np.std(posterior.mean)

    policy = jax.tree.map(lambda leaf: leaf[0], policies)
    exchanged = jax.tree.map(lambda leaf: leaf, policy)
    first = policy["params"]["dense_0"]
    # far from both ends and from each other, so that no window of the convolution sees the swap
    order = np.arange(16)
    order[[4, 11]] = [11, 4]
    exchanged["params"]["dense_0"] = {**first, "kernel": first["kernel"][:, order]}
    difference = vae.apply(params, exchanged, method="encode").mean - posterior.mean[0]
    assert np.abs(difference).max() > 1e-3


def test_samples_come_from_their_own_policy():
    count, drawn = 6, 4
    config = dataclasses.replace(SMALL, policies_per_step=drawn)
    number = jnp.arange(count, dtype=float)
    data = {
        "policies": {"number": number},
        "states": jnp.broadcast_to(number[:, None, None], (count, 10, 2)),
        "weights": 10.0 * number,
    }
    batch = policy_vae.make_sample_fn(config)(jax.random.key(0), data)
    chosen = np.asarray(batch.policies["number"])
    assert len(set(chosen)) == drawn
    np.testing.assert_array_equal(batch.weights, 10.0 * chosen)
    np.testing.assert_array_equal(batch.states, np.tile(chosen[:, None, None], (1, 64, 2)))
    whole = policy_vae.make_sample_fn(SMALL)(jax.random.key(0), {**data, "weights": number + 1})
    np.testing.assert_array_equal(whole.policies["number"], number)


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
def test_every_parameter_gets_a_finite_gradient(kind):
    policies = _policies(3, kind)
    vae, params = _vae(policies)
    states = jax.random.normal(jax.random.key(3), (3, 5, 8))
    batch = PolicyBatch(policies, states, jnp.ones(3))
    loss_fn = policy_vae.make_loss_fn(vae)
    gradient = jax.jit(jax.grad(lambda p: loss_fn(p, jax.random.key(4), batch)[0]))(params)
    for path, leaf in jax.tree.leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
        assert np.abs(leaf).max() > 0, jax.tree_util.keystr(path)


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
def test_three_policies_are_reconstructed_also_from_perturbed_latents(kind):
    # the means of a Gaussian are compared in units of its deviation, here about 0.6
    policies = _policies(3, kind, gain=0.7 if kind == "categorical" else 0.15)
    vae, params = _vae(policies)
    train, held_out = jax.random.normal(jax.random.key(3), (2, 3, 2000, 8))
    fit_config = fit.FitConfig(learning_rate=1e-2, steps=900, warmup_steps=20)
    sample_fn = policy_vae.make_sample_fn(vae.config)
    chunk = fit.make_fit_chunk(policy_vae.make_loss_fn(vae), sample_fn, fit_config, 900)
    state = fit.init_fit(jax.random.key(4), params, fit_config)
    state, _ = chunk(state, {"policies": policies, "states": train})

    @jax.jit
    def divergence(key, perturbation):
        decoded = policy_vae.reconstruct(vae, state.params, key, policies, perturbation)
        return policy_vae.policy_kl(policies, decoded, held_out)

    # the policies differ by far more than is allowed between each and its reconstruction
    others = jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), policies)
    assert policy_vae.policy_kl(policies, others, held_out).min() > 0.5
    assert divergence(jax.random.key(5), 0.0).max() < 0.02
    for key in jax.random.split(jax.random.key(6), 5):
        assert divergence(key, 0.1).max() < 0.02


def _in_units(policies, mean, std):
    """The policies that do with mean + std * x what the given ones do with x."""
    return jax.vmap(networks.fold_normalisation, in_axes=(0, None, None))(policies, mean, std)


def test_the_units_of_observations_do_not_matter_to_a_normalised_vae():
    policies = _policies(3)
    vae, params = _vae(policies, normalised=True)
    states = jax.random.normal(jax.random.key(3), (3, 500, 8))
    mean, std = jnp.linspace(-1.0, 2.0, 8), 10.0 ** jnp.linspace(-1.2, 1.0, 8)
    in_units = _in_units(policies, mean, std)
    first = policy_vae.with_statistics(params, states)
    second = policy_vae.with_statistics(params, mean + std * states)

    posteriors = (
        policy_vae.encode(vae, first, policies),
        policy_vae.encode(vae, second, in_units),
    )
    np.testing.assert_allclose(*(each.mean for each in posteriors), rtol=1e-3, atol=1e-4)
    decoded = (
        policy_vae.decode(vae, first, posteriors[0].mean),
        policy_vae.decode(vae, second, posteriors[0].mean),
    )
    np.testing.assert_allclose(
        jax.vmap(networks.act)(decoded[0], states),
        jax.vmap(networks.act)(decoded[1], mean + std * states),
        rtol=1e-3,
        atol=1e-4,
    )
    # without statistics nothing is done to a policy, and a plain VAE has none
    plain, plain_params = _vae(policies)
    np.testing.assert_array_equal(
        policy_vae.encode(vae, params, policies).mean,
        policy_vae.encode(plain, plain_params, policies).mean,
    )
    assert policy_vae.with_statistics(plain_params, states) is plain_params


@pytest.mark.parametrize("normalised", [True, False])
def test_policies_are_unfolded_as_the_vae_sees_them_and_folded_back(normalised):
    policies = _policies(3)
    vae, params = _vae(policies, normalised=normalised)
    states = 1.0 + 0.1 * jax.random.normal(jax.random.key(1), (3, 50, 8))
    params = policy_vae.with_statistics(params, states)
    policy = jax.tree.map(lambda leaf: leaf[0], policies)
    seen = vae.apply(params, policy, method="unfold")
    folded = vae.apply(params, seen, method="fold")
    chex.assert_trees_all_close(folded, policy, atol=1e-4)
    kernel, raw = (one["params"]["dense_0"]["kernel"] for one in (seen, policy))
    expected = raw * states.std(axis=(0, 1))[:, None] if normalised else raw
    np.testing.assert_allclose(kernel, expected, rtol=1e-4)


def test_a_normalised_vae_learns_where_a_plain_one_cannot():
    """Places about a metre away that vary by a centimetre, as the arm's players see them."""
    mean, std = jnp.ones(8), jnp.full(8, 0.02)
    policies = _in_units(_policies(3), mean, std)
    states = mean + std * jax.random.normal(jax.random.key(3), (3, 2000, 8))
    found = {}
    for normalised in (True, False):
        vae, params = _vae(policies, normalised=normalised)
        params = policy_vae.with_statistics(params, states)
        first = policy_vae.posterior_kl(policy_vae.encode(vae, params, policies)).mean()
        fit_config = fit.FitConfig(learning_rate=1e-2, steps=300, warmup_steps=20)
        sample_fn = policy_vae.make_sample_fn(vae.config)
        chunk = fit.make_fit_chunk(policy_vae.make_loss_fn(vae), sample_fn, fit_config, 300)
        state = fit.init_fit(jax.random.key(4), params, fit_config)
        state, _ = chunk(state, {"policies": policies, "states": states})
        if normalised:
            fitted = state.params[policy_vae.STATISTICS]
            np.testing.assert_array_equal(fitted["std"], params[policy_vae.STATISTICS]["std"])
            np.testing.assert_array_equal(fitted["mean"], params[policy_vae.STATISTICS]["mean"])
        decoded = policy_vae.reconstruct(vae, state.params, jax.random.key(5), policies)
        found[normalised] = (
            float(first),
            float(policy_vae.policy_kl(policies, decoded, states).max()),
        )
    assert found[True][1] < 0.1
    assert found[False][0] > 100 * found[True][0], "the plain posterior is not far off at first"
    assert found[False][1] > 3 * found[True][1]


def test_configuration_is_checked():
    with pytest.raises(ValueError, match=r"latent_dim is 0; expected > 0"):
        PolicyVAEConfig(latent_dim=0)
    with pytest.raises(ValueError, match=r"latent_noise is -1; expected >= 0"):
        PolicyVAEConfig(latent_noise=-1)
