"""The graph hypernetwork: what it reads off a policy, and what it writes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import networks
from haland_jax.hypernetwork import (
    GraphHypernetwork,
    Head,
    HypernetworkConfig,
    Layer,
    PolicyArchitecture,
    Sweeps,
)


def _policy(kind="categorical", observation_dim=20, hidden=(16, 12), action_dim=5):
    actor = networks.MLPActor(action_dim, hidden=hidden, kind=kind)
    return actor.init(jax.random.key(0), jnp.zeros(observation_dim))


def _decoder(policy, **config):
    architecture = PolicyArchitecture.from_params(policy)
    decoder = GraphHypernetwork(architecture, HypernetworkConfig(**config))
    return decoder, jax.jit(decoder.init)(jax.random.key(1), jnp.zeros(7))


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
def test_architecture_is_read_from_a_policy_and_from_an_archive(kind):
    policy = _policy(kind)
    architecture = PolicyArchitecture.from_params(policy)
    assert architecture.layers == (
        Layer("dense_0", 20, 16),
        Layer("dense_1", 16, 12),
        Layer("dense_2", 12, 5),
    )
    assert (architecture.kind, architecture.action_dim) == (kind, 5)
    assert len(architecture.nodes) == (8 if kind == "gaussian" else 7)
    archive = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), policy)
    assert PolicyArchitecture.from_params(archive) == architecture


def test_architecture_refuses_what_is_not_an_actor():
    policy = _policy()
    with pytest.raises(ValueError, match="expected dense_0"):
        PolicyArchitecture.from_params({"params": {**policy["params"], "lstm": {}}})
    broken = {"params": {**policy["params"], "dense_1": policy["params"]["dense_2"]}}
    with pytest.raises(ValueError, match="must form a chain"):
        PolicyArchitecture.from_params(broken)
    with pytest.raises(ValueError, match="hidden >= 1"):
        HypernetworkConfig(hidden=0)


@pytest.mark.parametrize("kind", ["categorical", "gaussian"])
@pytest.mark.parametrize("head_hidden", [0, 24])
def test_decoded_policy_has_the_structure_of_the_original(kind, head_hidden):
    policy = _policy(kind)
    decoder, params = _decoder(policy, hidden=16, head_hidden=head_hidden)
    decoded = decoder.apply(params, jnp.ones(7))
    assert jax.tree.structure(decoded) == jax.tree.structure(policy)
    assert jax.tree.map(jnp.shape, decoded) == jax.tree.map(jnp.shape, policy)


def test_initial_kernels_have_scale_sqrt_two_over_fan_in_and_keep_activations_alive():
    policy = _policy(observation_dim=100, hidden=(64, 64), action_dim=6)
    decoder, params = _decoder(policy)
    latents = jax.random.normal(jax.random.key(2), (16, 7))
    decoded = jax.jit(jax.vmap(lambda latent: decoder.apply(params, latent)))(latents)
    for name, fan_in in (("dense_0", 100), ("dense_1", 64), ("dense_2", 64)):
        scale = np.std(decoded["params"][name]["kernel"]) / np.sqrt(2.0 / fan_in)
        assert 0.6 < scale < 1.7
    observation = jax.random.normal(jax.random.key(3), (16, 200, 100))
    logits = jax.jit(jax.vmap(networks.act))(decoded, observation)
    assert 0.3 < np.std(logits) < 3.0


def test_sweeps_carry_information_both_ways():
    sweeps = Sweeps(4)
    states = jax.random.normal(jax.random.key(0), (5, 4))
    params = sweeps.init(jax.random.key(1), states)
    jacobian = jax.jit(jax.jacobian(lambda nodes: sweeps.apply(params, nodes)))(states)
    # [node out, node in]: every final state depends on every initial one
    influence = np.abs(jacobian).max(axis=(1, 3))
    assert influence.min() > 1e-6


def test_head_gives_a_small_node_the_corner_of_the_full_matrix():
    head = Head((6, 4), head_hidden=8)
    state = jax.random.normal(jax.random.key(0), (3,))
    params = head.init(jax.random.key(1), state, (6, 4))
    full = head.apply(params, state, (6, 4))
    np.testing.assert_allclose(head.apply(params, state, (2, 3)), full[:2, :3], rtol=1e-6)


def test_base_weights_are_added_for_every_latent():
    decoder, params = _decoder(_policy(), hidden=8, head_hidden=8)
    latents = jax.random.normal(jax.random.key(2), (2, 7))
    decode = jax.jit(decoder.apply)
    before = [decode(params, latent)["params"]["dense_1"] for latent in latents]
    params["params"]["base_dense_1_kernel"] += 0.5
    after = [decode(params, latent)["params"]["dense_1"] for latent in latents]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(new["kernel"], old["kernel"] + 0.5, atol=1e-6)
        np.testing.assert_array_equal(new["bias"], old["bias"])
    without, bare = _decoder(_policy(), base_weights=False)
    assert not any(name.startswith("base") for name in bare["params"])
    assert not np.allclose(*[without.apply(bare, z)["params"]["dense_0"]["bias"] for z in latents])
