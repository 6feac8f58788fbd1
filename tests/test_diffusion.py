"""Latent diffusion: Eq. 1, 2 and 5 and DDIM against NumPy, the conditioner, and a tiny fit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization

from haland_jax.diffusion import (
    CleanDiffusionConfig,
    Conditioner,
    DiffusionConfig,
    DiffusionParams,
    LatentArchive,
    NoisePredictor,
    add_noise,
    init_network,
    latent_statistics,
    make_diffusion_loss,
    make_sample_fn,
    noise_schedule,
)
from haland_jax.fit import FitConfig, init_fit, make_fit_chunk
from haland_jax.samplers import (
    ddim_noise_steps,
    ddim_step,
    ddpm_step,
    sample,
    sample_ddim,
    sample_ddpm,
)
from haland_jax.unet import UNetConfig

TINY = DiffusionConfig(
    unet=UNetConfig(channels=16, inner_channels=32, groups=4, heads=2, step_features=16),
    token_features=8,
    ddim_steps=10,
    batch_size=32,
    fit=FitConfig(learning_rate=3e-3, steps=300, warmup_steps=20, ema_decay=0.98),
)


def numpy_schedule(beta):
    return beta, 1 - beta, np.cumprod(1 - beta)


def two_clusters():
    """Two styles of two policies each, far apart, and the frequencies of three events."""
    random = np.random.default_rng(0)
    centre = np.repeat(random.normal(size=(2, 64)), 2, axis=0)
    archive = LatentArchive(
        z_mean=jnp.asarray(5.0 + 3.0 * (centre + 0.3 * random.normal(size=(4, 64))), jnp.float32),
        z_log_variance=jnp.full((4, 64), 2 * np.log(0.05), jnp.float32),
        v_hat=jnp.array([[1.0, 0.0, 0.5], [1.0, 0.0, 0.5], [0.2, 1.0, 0.0], [0.2, 1.0, 0.0]]),
    )
    return archive


@pytest.fixture(scope="module")
def tiny_network():
    """Parameters with a last layer that is not zero, so that the output depends on its input."""
    params = jax.jit(init_network, static_argnums=(1, 2))(jax.random.key(0), TINY, 3)
    random = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: leaf + 0.05 * random.normal(size=leaf.shape), params)


def test_schedule_of_the_paper_s_length_is_linear():
    schedule = noise_schedule(1000)
    beta, alpha, alpha_bar = numpy_schedule(np.linspace(1e-4, 0.02, 1000))
    np.testing.assert_allclose(schedule.beta, beta, rtol=1e-6)
    np.testing.assert_allclose(schedule.alpha, alpha, rtol=1e-6)
    np.testing.assert_allclose(schedule.alpha_bar, alpha_bar, rtol=1e-4)
    np.testing.assert_allclose(schedule.alpha_bar[-1], 4.04e-5, rtol=1e-2)


@pytest.mark.parametrize("noise_steps", [10, 100, 250, 2000])
def test_a_schedule_of_another_length_ends_as_noisy(noise_steps):
    schedule = noise_schedule(noise_steps)
    beta = np.asarray(schedule.beta, np.float64)
    assert beta.shape == (noise_steps,)
    assert beta.min() > 0
    assert beta.max() < 1
    np.testing.assert_allclose(beta / beta[0], np.linspace(1, 200, noise_steps), rtol=1e-5)
    np.testing.assert_allclose(np.prod(1 - beta), noise_schedule(1000).alpha_bar[-1], rtol=2e-3)


def test_noising_by_equation_2():
    schedule = noise_schedule(1000)
    _, _, alpha_bar = numpy_schedule(np.linspace(1e-4, 0.02, 1000))
    z, noise = np.random.default_rng(1).normal(size=(2, 64))
    for step in (1, 500, 1000):
        level = alpha_bar[step - 1]
        expected = np.sqrt(level) * z + np.sqrt(1 - level) * noise
        result = add_noise(schedule, jnp.asarray(z), jnp.array(step), jnp.asarray(noise))
        np.testing.assert_allclose(result, expected, atol=1e-5)


def test_step_of_equation_1():
    schedule = noise_schedule(1000)
    beta, alpha, alpha_bar = numpy_schedule(np.linspace(1e-4, 0.02, 1000))
    noisy, predicted, noise = np.random.default_rng(2).normal(size=(3, 64)).astype(np.float32)
    for step in (1, 2, 700, 1000):
        b, a, level = beta[step - 1], alpha[step - 1], alpha_bar[step - 1]
        expected = (noisy - (1 - a) / np.sqrt(1 - level) * predicted) / np.sqrt(a)
        expected = expected + (np.sqrt(b) * noise if step > 1 else 0)
        result = ddpm_step(schedule, noisy, jnp.array(step), predicted, noise)
        np.testing.assert_allclose(result, expected, atol=2e-5)


@pytest.mark.parametrize("eta", [0.0, 0.7])
@pytest.mark.parametrize("clip", [float("inf"), 0.8])
def test_ddim_step_by_hand(eta, clip):
    noisy, predicted, noise = np.random.default_rng(3).normal(size=(3, 64))
    level, following = 0.3, 0.6
    clean = np.clip((noisy - np.sqrt(0.7) * predicted) / np.sqrt(0.3), -clip, clip)
    epsilon = (noisy - np.sqrt(0.3) * clean) / np.sqrt(0.7)
    sigma = eta * np.sqrt(0.4 / 0.7 * (1 - 0.3 / 0.6))
    expected = np.sqrt(0.6) * clean + np.sqrt(0.4 - sigma**2) * epsilon + sigma * noise
    result = ddim_step(
        jnp.asarray(noisy), jnp.array(level), jnp.array(following), predicted, noise, eta, clip
    )
    np.testing.assert_allclose(result, expected, atol=1e-5)


def test_ddim_visits_evenly_from_the_noisiest_step_to_the_first():
    steps = ddim_noise_steps(dataclasses.replace(TINY, ddim_steps=4))
    np.testing.assert_array_equal(steps, [1000, 667, 334, 1])


@pytest.mark.parametrize("sampler", [sample_ddpm, sample_ddim])
@pytest.mark.parametrize("noise_steps", [1000, 100])
def test_a_perfect_predictor_of_one_point_brings_every_sample_to_it(sampler, noise_steps):
    config = dataclasses.replace(TINY, noise_steps=noise_steps)
    alpha_bar = noise_schedule(noise_steps).alpha_bar
    point = jnp.asarray(np.random.default_rng(4).normal(size=64), jnp.float32)

    def noise_fn(noisy, step):
        level = alpha_bar[step - 1]
        return (noisy - jnp.sqrt(level) * point) / jnp.sqrt(1 - level)

    keys = jax.random.split(jax.random.key(0), 3)
    samples = jax.jit(jax.vmap(lambda key: sampler(key, noise_fn, config)))(keys)
    np.testing.assert_allclose(samples, np.tile(point, (3, 1)), atol=2e-3)


def test_ddpm_reproduces_a_gaussian_and_not_its_mean_alone():
    """For z ~ N(1, 0.5²) the best noise prediction is linear; the samples keep the spread."""
    config = dataclasses.replace(TINY, noise_steps=200)
    alpha_bar = noise_schedule(200).alpha_bar

    def noise_fn(noisy, step):
        level = alpha_bar[step - 1]
        variance = level * 0.25 + 1 - level
        return jnp.sqrt(1 - level) * (noisy - jnp.sqrt(level)) / variance

    keys = jax.random.split(jax.random.key(1), 100)
    samples = np.asarray(
        jax.jit(jax.vmap(lambda key: sample_ddpm(key, noise_fn, config)))(keys)
    )  # 6400 independent numbers
    np.testing.assert_allclose(samples.mean(), 1.0, atol=0.03)
    np.testing.assert_allclose(samples.std(), 0.5, atol=0.03)


def test_conditioner_interpolates_between_bin_centres():
    conditioner = Conditioner(bins=10, features=4)
    v_hat = jnp.array([0.05, 0.35, 0.95])
    params = conditioner.init(jax.random.key(0), v_hat, jnp.array(False))
    table = np.asarray(params["params"]["embedding"])
    assert table.shape == (30, 4)
    tokens = conditioner.apply(params, v_hat, jnp.array(False))
    np.testing.assert_allclose(tokens, table[[0, 13, 29]], atol=1e-5)
    between = conditioner.apply(params, jnp.array([0.08, 0.42, 1.0]), jnp.array(False))
    np.testing.assert_allclose(between[0], 0.7 * table[0] + 0.3 * table[1], atol=1e-5)
    np.testing.assert_allclose(between[1], 0.3 * table[13] + 0.7 * table[14], atol=1e-5)
    np.testing.assert_allclose(between[2], table[29], atol=1e-5)
    nothing = np.asarray(params["params"]["unconditional"])
    np.testing.assert_array_equal(
        conditioner.apply(params, v_hat, jnp.array(True)), np.tile(nothing, (3, 1))
    )


def test_the_prediction_depends_on_condition_step_and_dropping(tiny_network):
    predict = jax.jit(NoisePredictor(TINY).apply)
    z, v_hat = jnp.ones(64), jnp.array([0.2, 0.5, 0.9])
    before = predict(tiny_network, z, jnp.array(300), v_hat, jnp.array(False))
    for arguments in (
        (z, jnp.array(300), v_hat.at[1].set(0.8), jnp.array(False)),
        (z, jnp.array(310), v_hat, jnp.array(False)),
        (z, jnp.array(300), v_hat, jnp.array(True)),
    ):
        assert float(jnp.abs(predict(tiny_network, *arguments) - before).max()) > 1e-4


def test_loss_is_the_mean_squared_noise_error():
    """Fresh networks predict √(1 - ᾱ) z_i, which leaves √ᾱ (√ᾱ ε - √(1 - ᾱ) z) of the noise."""
    params = jax.jit(init_network, static_argnums=(1, 2))(jax.random.key(0), TINY, 3)
    zero = (jnp.zeros((32, 64)), jnp.zeros((32, 3)))
    config = dataclasses.replace(TINY, largest_weight=1.0)
    loss, _ = jax.jit(make_diffusion_loss(config))(params, jax.random.key(1), zero)
    # At z = 0 that is ᾱ ε, whose mean square over uniform steps is the mean of ᾱ².
    expected = np.square(np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))).mean()
    np.testing.assert_allclose(loss, expected, rtol=0.1)


def test_noisy_steps_weigh_more_up_to_the_bound():
    params = jax.jit(init_network, static_argnums=(1, 2))(jax.random.key(0), TINY, 3)
    zero = (jnp.zeros((32, 64)), jnp.zeros((32, 3)))
    config = dataclasses.replace(TINY, largest_weight=4.0)
    loss, metrics = jax.jit(make_diffusion_loss(config))(params, jax.random.key(1), zero)
    alpha_bar = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
    expected = (np.minimum(1 / alpha_bar, 4.0) * np.square(alpha_bar)).mean()
    np.testing.assert_allclose(loss, expected, rtol=0.1)
    np.testing.assert_allclose(metrics["noise_error"], np.square(alpha_bar).mean(), rtol=0.1)


def test_statistics_and_batches():
    archive = two_clusters()
    statistics = latent_statistics(archive)
    z = np.asarray(archive.z_mean)
    np.testing.assert_allclose(statistics.mean, z.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics.std, np.sqrt(z.var(axis=0) + 0.05**2), rtol=1e-4)
    np.testing.assert_allclose(statistics.restore(statistics.standardise(z)), z, rtol=1e-4)
    config = dataclasses.replace(TINY, batch_size=400)
    batch_z, v_hat = make_sample_fn(config, statistics)(jax.random.key(0), archive)
    error = np.asarray(statistics.restore(batch_z))[:, None] - z[None]
    nearest = np.abs(error).mean(axis=-1).argmin(axis=-1)
    assert set(nearest) == {0, 1, 2, 3}
    np.testing.assert_allclose(error[np.arange(400), nearest].std(), 0.05, rtol=0.05)
    moved = np.abs(np.asarray(v_hat) - np.asarray(archive.v_hat)[nearest])
    assert 0.025 < moved.max() <= 0.03 + 1e-6


def test_a_constant_latent_dimension_is_refused():
    archive = two_clusters()
    archive = archive.replace(
        z_mean=archive.z_mean.at[:, 3].set(1.0),
        z_log_variance=archive.z_log_variance.at[:, 3].set(-jnp.inf),
    )
    with pytest.raises(ValueError, match="constant"):
        latent_statistics(archive)


def test_a_tiny_fit_recovers_two_clusters():
    archive = two_clusters()
    statistics = latent_statistics(archive)
    params = jax.jit(init_network, static_argnums=(1, 2))(jax.random.key(0), TINY, 3)
    chunk = make_fit_chunk(
        make_diffusion_loss(TINY), make_sample_fn(TINY, statistics), TINY.fit, 100
    )
    state = init_fit(jax.random.key(1), params, TINY.fit)
    for _ in range(3):
        state, metrics = chunk(state, archive)
    assert np.isfinite(metrics["loss"]).all()
    fitted = DiffusionParams(network=state.ema, statistics=statistics)
    generate = jax.jit(jax.vmap(sample, (0, None, 0, None)), static_argnums=3)
    v_hat = jnp.repeat(archive.v_hat[jnp.array([0, 2])], 8, axis=0) + 0.04
    samples = np.asarray(generate(jax.random.split(jax.random.key(2), 16), fitted, v_hat, TINY))
    error = (samples[:, None] - np.asarray(archive.z_mean)) / np.asarray(statistics.std)
    distance = np.sqrt(np.square(error).mean(axis=-1))
    np.testing.assert_array_equal(distance.argmin(axis=-1) // 2, np.repeat([0, 1], 8))
    assert distance.min(axis=-1).mean() < 0.5
    restored = serialization.from_bytes(
        jax.tree.map(jnp.zeros_like, fitted), serialization.to_bytes(fitted)
    )
    np.testing.assert_array_equal(restored.statistics.std, statistics.std)


def test_guidance_moves_the_sample(tiny_network):
    archive = two_clusters()
    fitted = DiffusionParams(network=tiny_network, statistics=latent_statistics(archive))
    key, v_hat = jax.random.key(3), archive.v_hat[0]
    generate = jax.jit(sample, static_argnums=3)
    plain = generate(key, fitted, v_hat, TINY)
    strong = dataclasses.replace(TINY, condition_dropout=0.1, guidance=2.0)
    assert float(jnp.abs(generate(key, fitted, v_hat, strong) - plain).max()) > 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"guidance": 2.0},
        {"ddim_steps": 2000},
        {"noise_steps": 5},
        {"eta": 1.5},
        {"condition_dropout": 1.0},
        {"clip": 0.0},
    ],
)
def test_configuration_is_checked(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        DiffusionConfig(**changes)


def test_an_unknown_sampler_is_refused(tiny_network):
    fitted = DiffusionParams(tiny_network, latent_statistics(two_clusters()))
    with pytest.raises(ValueError, match="sampler"):
        sample(jax.random.key(0), fitted, jnp.zeros(3), TINY, "euler")


def test_any_vector_can_be_the_condition():
    config = dataclasses.replace(TINY, vector_tokens=3)
    archive = two_clusters().replace(
        v_hat=jnp.array([[-4.0, 2.0], [-4.0, 2.0], [7.0, 0.0]] * 2)[:4]
    )
    _, drawn = make_sample_fn(config, latent_statistics(archive))(jax.random.key(0), archive)
    assert {tuple(row) for row in np.asarray(drawn).tolist()} <= {(-4.0, 2.0), (7.0, 0.0)}
    params = init_network(jax.random.key(0), config, 2)
    network = NoisePredictor(config)
    tokens = network.apply(params, archive.v_hat[0], jnp.array(False), method="tokens")
    assert tokens.shape == (3, config.token_features)
    nothing = network.apply(params, archive.v_hat[0], jnp.array(True), method="tokens")
    np.testing.assert_array_equal(nothing[0], nothing[2])
    z = sample(jax.random.key(1), DiffusionParams(params, latent_statistics(archive)),
               archive.v_hat[0], config)  # fmt: skip
    assert z.shape == (64,)


def test_a_clean_diffusion_of_more_numbers_than_can_pass_through_the_unet():
    """640 numbers through 16 cells of 16 channels: noise cannot pass, four policies can."""
    fit = dataclasses.replace(TINY.fit, steps=150)
    tiny = dataclasses.replace(TINY, grid=(4, 4, 40), batch_size=16, fit=fit)
    config = CleanDiffusionConfig.like(tiny)
    clusters = two_clusters()
    mixing = jax.random.normal(jax.random.key(0), (64, config.latent_size)) / 8
    archive = clusters.replace(
        z_mean=clusters.z_mean @ mixing,
        z_log_variance=jnp.full((4, config.latent_size), -14.0),
    )
    statistics = latent_statistics(archive)
    chunk = make_fit_chunk(
        make_diffusion_loss(config),
        make_sample_fn(config, statistics),
        config.fit,
        config.fit.steps,
    )
    network = init_network(jax.random.key(1), config, 3)
    state, _ = chunk(init_fit(jax.random.key(2), network, config.fit), archive)
    params = DiffusionParams(state.ema, statistics)
    draw = jax.jit(jax.vmap(lambda key: sample(key, params, archive.v_hat[0], config)))
    drawn = draw(jax.random.split(jax.random.key(3), 4))
    stored = statistics.standardise(archive.z_mean)
    apart = jnp.square(statistics.standardise(drawn)[:, None] - stored)
    distance = np.asarray(jnp.sqrt(jnp.mean(apart, axis=-1)))
    assert (distance.argmin(axis=1) < 2).all(), "of the style that was asked for"
    assert distance.min(axis=1).max() < 0.3


def test_the_loss_of_a_clean_diffusion_is_the_error_of_the_clean_latent():
    """A fresh UNet gives zero, which is off by the latent itself, at every noise step."""
    config = CleanDiffusionConfig.like(TINY)
    params = init_network(jax.random.key(0), config, 3)
    batch = (jnp.full((32, 64), 3.0), jnp.zeros((32, 3)))
    loss, _ = jax.jit(make_diffusion_loss(config))(params, jax.random.key(1), batch)
    assert float(loss) == pytest.approx(9.0, rel=1e-2)
