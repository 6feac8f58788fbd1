"""The UNet of Table 3: its pieces against NumPy and lax, its dependence on every input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax.unet import (
    Attention,
    Convolution,
    GridNorm,
    UNet,
    UNetConfig,
    Upsample,
    sinusoidal_embedding,
)

SMALL = UNetConfig(channels=8, inner_channels=16, groups=4, heads=2, step_features=8)


@pytest.fixture(scope="module")
def network():
    """A small UNet whose parameters, the zero-initialised last layer too, are random."""
    unet = UNet(SMALL)
    key, grid_key, token_key = jax.random.split(jax.random.key(0), 3)
    grid = jax.random.normal(grid_key, (4, 4, 4))
    tokens = jax.random.normal(token_key, (5, 6))
    params = jax.jit(unet.init)(key, grid, jnp.array(7.0), tokens)
    leaves, structure = jax.tree.flatten(params)
    random = np.random.default_rng(0)
    leaves = [
        jnp.asarray(leaf + 0.2 * random.normal(size=leaf.shape), jnp.float32) for leaf in leaves
    ]
    return jax.jit(unet.apply), jax.tree.unflatten(structure, leaves), params, grid, tokens


@pytest.mark.parametrize("stride", [1, 2])
def test_convolution_equals_the_definition(stride):
    random = np.random.default_rng(1)
    grid = random.normal(size=(4, 6, 3)).astype(np.float32)
    layer = Convolution(5, stride=stride)
    params = layer.init(jax.random.key(0), grid)
    kernel = np.asarray(params["params"]["taps"]["kernel"]).reshape(3, 3, 3, 5)
    padded = np.pad(grid, ((1, 1), (1, 1), (0, 0)))
    expected = np.zeros((4 // stride, 6 // stride, 5))
    for row in range(4 // stride):
        for column in range(6 // stride):
            top, left = row * stride, column * stride
            window = padded[top : top + 3, left : left + 3]
            expected[row, column] = np.tensordot(window, kernel, axes=3)
    np.testing.assert_allclose(layer.apply(params, grid), expected, atol=1e-5)


def test_group_norm_by_hand():
    grid = np.random.default_rng(2).normal(3.0, 2.0, size=(2, 2, 4)).astype(np.float32)
    layer = GridNorm(groups=2)
    params = layer.init(jax.random.key(0), grid)
    normal = np.asarray(layer.apply(params, grid))
    for group in (slice(0, 2), slice(2, 4)):
        values = grid[..., group]
        expected = (values - values.mean()) / np.sqrt(values.var() + 1e-5)
        np.testing.assert_allclose(normal[..., group], expected, atol=1e-5)


def test_attention_by_hand():
    random = np.random.default_rng(3)
    queries, context = random.normal(size=(3, 4)), random.normal(size=(5, 6))
    layer = Attention(heads=2)
    params = layer.init(jax.random.key(0), jnp.asarray(queries), jnp.asarray(context))
    kernels = {name: np.asarray(leaf["kernel"]) for name, leaf in params["params"].items()}
    query, key, value = (
        queries @ kernels["query"],
        context @ kernels["key"],
        context @ kernels["value"],
    )
    heads = []
    for head in (slice(0, 2), slice(2, 4)):
        scores = np.exp(query[:, head] @ key[:, head].T / np.sqrt(2))
        heads.append(scores / scores.sum(axis=1, keepdims=True) @ value[:, head])
    expected = np.concatenate(heads, axis=1) @ kernels["out"]
    result = layer.apply(params, jnp.asarray(queries), jnp.asarray(context))
    np.testing.assert_allclose(result, expected, atol=1e-5)


def test_upsampling_makes_four_different_cells_of_each():
    layer = Upsample(features=2)
    grid = np.random.default_rng(4).normal(size=(2, 3, 5)).astype(np.float32)
    params = layer.init(jax.random.key(0), grid)
    fine = np.asarray(layer.apply(params, grid))
    kernel = np.asarray(params["params"]["cells"]["kernel"]).reshape(5, 2, 2, 2)
    assert fine.shape == (4, 6, 2)
    for row, column in ((0, 0), (1, 4), (2, 3), (3, 5)):
        expected = grid[row // 2, column // 2] @ kernel[:, row % 2, column % 2]
        np.testing.assert_allclose(fine[row, column], expected, atol=1e-5)


def test_sinusoidal_embedding_by_hand():
    expected = [np.sin(3.0), np.sin(0.03), np.cos(3.0), np.cos(0.03)]
    np.testing.assert_allclose(sinusoidal_embedding(jnp.array(3.0), 4), expected, atol=1e-6)


def test_output_is_zero_at_initialisation_and_keeps_the_shape(network):
    apply, random_params, initial_params, grid, tokens = network
    np.testing.assert_array_equal(
        apply(initial_params, grid, jnp.array(7.0), tokens), np.zeros((4, 4, 4))
    )
    assert apply(random_params, grid, jnp.array(7.0), tokens).shape == (4, 4, 4)


def test_every_token_reaches_the_output_through_cross_attention(network):
    apply, params, _, grid, tokens = network
    before = apply(params, grid, jnp.array(7.0), tokens)
    for token in range(tokens.shape[0]):
        # The sum of the tokens stays, so that the pooled path carries nothing of the change.
        moved = tokens.at[token].add(1.0).at[token - 1].add(-1.0)
        after = apply(params, grid, jnp.array(7.0), moved)
        assert float(jnp.abs(after - before).max()) > 1e-4


def test_the_tokens_are_a_set(network):
    """Their identity is in their embedding; attention itself is blind to their order."""
    apply, params, _, grid, tokens = network
    before = apply(params, grid, jnp.array(7.0), tokens)
    np.testing.assert_allclose(apply(params, grid, jnp.array(7.0), tokens[::-1]), before, atol=1e-4)


def test_step_and_every_latent_number_reach_the_output(network):
    apply, params, _, grid, tokens = network
    before = apply(params, grid, jnp.array(7.0), tokens)
    later = apply(params, grid, jnp.array(300.0), tokens)
    assert float(jnp.abs(later - before).max()) > 1e-3
    moved = jnp.eye(64).reshape(64, 4, 4, 4) + grid
    outputs = jax.vmap(apply, (None, 0, None, None))(params, moved, jnp.array(7.0), tokens)
    assert float(jnp.abs(outputs - before).max(axis=(1, 2, 3)).min()) > 1e-3


def test_table_3_has_its_submodules(network):
    _, params, *_ = network
    assert set(params["params"]) == {
        *("encoder_convolution_0", "encoder_convolution_1", "encoder_residual"),
        *("step_0", "step_1", "pooled_tokens", "cell"),
        *("bottleneck_residual_0", "bottleneck_residual_1", "bottleneck_attention"),
        *("decoder_residual_0", "decoder_residual_1", "decoder_attention", "upsample"),
        *("out_norm", "out_convolution"),
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": 9}, "channels"),
        ({"inner_channels": 18}, "inner_channels"),
        ({"heads": 3}, "heads"),
        ({"step_features": 7}, "step_features"),
    ],
)
def test_widths_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        UNetConfig(**{"channels": 8, "inner_channels": 16, "groups": 4, "heads": 2, **changes})


def test_odd_grids_are_refused():
    with pytest.raises(ValueError, match="even"):
        UNet(SMALL).init(jax.random.key(0), jnp.zeros((3, 4, 4)), jnp.array(1.0), jnp.zeros((5, 6)))
