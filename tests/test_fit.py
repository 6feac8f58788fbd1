"""The minibatch loop: resumption, schedule, clipping, averages, loud failure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization

from haland_jax.fit import (
    FitConfig,
    NonFiniteLoss,
    check_finite,
    init_fit,
    learning_rate_schedule,
    make_fit_chunk,
)

CONFIG = FitConfig(
    learning_rate=0.05,
    steps=12,
    warmup_steps=3,
    final_learning_rate_fraction=0.1,
    ema_decay=0.9,
    weight_decay=0.01,
)


def sample_rows(key, data):
    inputs, targets = data
    rows = jax.random.randint(key, (8,), 0, inputs.shape[0])
    return inputs[rows], targets[rows]


def noisy_regression_loss(params, key, batch):
    inputs, targets = batch
    noise = 0.1 * jax.random.normal(key, targets.shape)
    error = inputs @ params["weight"] + params["bias"] - targets - noise
    return jnp.mean(error**2), {"largest_error": jnp.max(jnp.abs(error))}


def regression():
    inputs = np.random.default_rng(0).normal(size=(64, 3)).astype(np.float32)
    data = (jnp.asarray(inputs), jnp.asarray(inputs @ np.array([1.0, -2.0, 0.5]) + 0.3))
    return data, {"weight": jnp.zeros(3), "bias": jnp.zeros(())}


def assert_identical(left, right):
    left, right = (serialization.to_state_dict(state) for state in (left, right))
    jax.tree.map(np.testing.assert_array_equal, left, right)


def test_two_chunks_equal_one_of_twice_the_length():
    data, params = regression()
    half = make_fit_chunk(noisy_regression_loss, sample_rows, CONFIG, 6)
    whole = make_fit_chunk(noisy_regression_loss, sample_rows, CONFIG, 12)
    state, first = half(init_fit(jax.random.key(1), params, CONFIG), data)
    state, second = half(state, data)
    expected, metrics = whole(init_fit(jax.random.key(1), params, CONFIG), data)
    assert_identical(state, expected)
    assert set(metrics) == {"loss", "gradient_norm", "largest_error"}
    for name in metrics:
        np.testing.assert_array_equal(np.concatenate([first[name], second[name]]), metrics[name])


def test_a_restored_state_continues_as_if_never_interrupted():
    data, params = regression()
    chunk = make_fit_chunk(noisy_regression_loss, sample_rows, CONFIG, 6)
    state, _ = chunk(init_fit(jax.random.key(1), params, CONFIG), data)
    saved = serialization.to_bytes(state)
    uninterrupted, _ = chunk(state, data)
    blank = init_fit(jax.random.key(99), jax.tree.map(jnp.ones_like, params), CONFIG)
    resumed, _ = chunk(serialization.from_bytes(blank, saved), data)
    assert jax.dtypes.issubdtype(resumed.key.dtype, jax.dtypes.prng_key)
    assert_identical(resumed, uninterrupted)


def test_steps_past_the_end_are_not_taken_and_inputs_survive():
    data, params = regression()
    chunk = make_fit_chunk(noisy_regression_loss, sample_rows, CONFIG, 12)
    key = jax.random.key(1)
    state, _ = chunk(init_fit(key, params, CONFIG), data)
    before = serialization.to_bytes(state)
    after, _ = chunk(state, data)
    assert int(after.step) == 12
    assert serialization.to_bytes(after) == before
    # Donation destroys the state alone, neither the caller's parameters nor its key.
    assert float(params["bias"]) == 0.0
    assert jax.random.key_data(key).shape == (2,)


def test_first_adamw_step_and_average_by_hand():
    config = FitConfig(learning_rate=0.1, steps=4, ema_decay=0.9, weight_decay=0.5, clip_norm=1.0)
    chunk = make_fit_chunk(
        lambda params, key, batch: (jnp.sum(params * batch), {}), lambda key, data: data, config, 1
    )
    start, gradient = np.array([1.0, 2.0], np.float32), np.array([3.0, -4.0], np.float32)
    state, metrics = chunk(init_fit(jax.random.key(0), jnp.asarray(start), config), gradient)
    # Adam's bias-corrected first step is lr * sign(gradient); weight decay adds lr * 0.5 * param.
    expected = start - 0.1 * (np.sign(gradient) + 0.5 * start)
    np.testing.assert_allclose(state.params, expected, rtol=1e-5)
    # At step 0 the decay is min(0.9, 1 / 10).
    np.testing.assert_allclose(state.ema, 0.1 * start + 0.9 * expected, rtol=1e-5)
    np.testing.assert_allclose(metrics["gradient_norm"], [5.0], rtol=1e-6)


def test_no_average_keeps_the_parameters_themselves():
    data, params = regression()
    config = FitConfig(learning_rate=0.05, steps=6)
    chunk = make_fit_chunk(noisy_regression_loss, sample_rows, config, 6)
    state, _ = chunk(init_fit(jax.random.key(1), params, config), data)
    jax.tree.map(np.testing.assert_array_equal, state.ema, state.params)
    assert np.all(np.asarray(state.params["weight"]) != 0)


def test_large_gradients_are_clipped_to_the_configured_norm():
    config = FitConfig(learning_rate=0.1, steps=2, clip_norm=0.5)
    chunk = make_fit_chunk(
        lambda params, key, batch: (jnp.sum(params * batch), {}), lambda key, data: data, config, 1
    )
    state, _ = chunk(init_fit(jax.random.key(0), jnp.zeros(2), config), jnp.array([3.0, -4.0]))
    moments = [leaf for leaf in jax.tree.leaves(state.optimizer_state) if leaf.shape == (2,)]
    # Adam's first moment after one step is 0.1 of the clipped gradient, 0.5 * (0.6, -0.8).
    np.testing.assert_allclose(moments[0], [0.03, -0.04], rtol=1e-5)


def test_schedule_warms_up_and_decays_as_a_cosine():
    schedule = learning_rate_schedule(
        FitConfig(learning_rate=2.0, steps=12, warmup_steps=2, final_learning_rate_fraction=0.1)
    )
    steps = np.array([0, 1, 2, 7, 12])
    cosine = 0.5 * (1 + np.cos(np.pi * (steps[2:] - 2) / 10))
    expected = np.concatenate([[0.0, 1.0], 2.0 * (0.9 * cosine + 0.1)])
    np.testing.assert_allclose([float(schedule(step)) for step in steps], expected, rtol=1e-6)


def test_the_fit_solves_a_regression():
    data, params = regression()
    config = FitConfig(learning_rate=0.1, steps=300, ema_decay=0.9)
    chunk = make_fit_chunk(noisy_regression_loss, sample_rows, config, 100)
    state = init_fit(jax.random.key(2), params, config)
    for _ in range(3):
        state, _ = chunk(state, data)
    np.testing.assert_allclose(state.ema["weight"], [1.0, -2.0, 0.5], atol=0.05)


@pytest.mark.parametrize("chunk_steps", [0, 5, 24])
def test_chunk_has_to_divide_the_fit(chunk_steps):
    with pytest.raises(ValueError, match="chunk_steps"):
        make_fit_chunk(noisy_regression_loss, sample_rows, CONFIG, chunk_steps)


@pytest.mark.parametrize(
    ("name", "value"),
    [("learning_rate", 0.0), ("steps", 0), ("warmup_steps", 10), ("ema_decay", 1.0)],
)
def test_configuration_is_checked(name, value):
    with pytest.raises(ValueError, match=name):
        FitConfig(**{"learning_rate": 0.1, "steps": 10, name: value})


def test_reserved_metric_names_are_refused():
    chunk = make_fit_chunk(
        lambda params, key, batch: (jnp.sum(params), {"loss": jnp.zeros(())}),
        lambda key, data: data,
        CONFIG,
        12,
    )
    with pytest.raises(ValueError, match="loss"):
        chunk(init_fit(jax.random.key(0), jnp.zeros(2), CONFIG), jnp.zeros(2))


def test_non_finite_metrics_stop_the_run():
    finite = {"loss": np.array([1.0, 2.0, 3.0]), "gradient_norm": np.ones(3)}
    check_finite("diffusion", 100, finite)
    broken = {"gradient_norm": np.array([1.0, 1.0, np.nan]), "loss": np.array([1.0, np.inf, 1.0])}
    with pytest.raises(NonFiniteLoss, match="diffusion: loss is not finite at step 101") as caught:
        check_finite("diffusion", 100, broken)
    assert (caught.value.stage, caught.value.step) == ("diffusion", 101)
    assert isinstance(caught.value, ArithmeticError)
