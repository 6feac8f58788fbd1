"""The conditional GAN of Table 1: its loss by hand, and a fit that tells styles apart."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import cgan
from haland_jax.cgan import CGAN, CGANConfig, LabelledLatents
from haland_jax.diffusion import LatentArchive, latent_statistics
from haland_jax.fit import FitConfig, init_fit, make_fit_chunk
from haland_jax.unet import UNetConfig

SMALL = CGANConfig(
    hidden=(64, 64),
    batch_size=32,
    fit=FitConfig(learning_rate=2e-3, steps=1500, warmup_steps=20, ema_decay=0.98),
)
UNET = dataclasses.replace(
    SMALL,
    generator="unet",
    unet=UNetConfig(channels=16, inner_channels=32, groups=4, heads=2, step_features=16),
)


@pytest.fixture(scope="module")
def latents():
    """Three styles of two policies each."""
    random = np.random.default_rng(0)
    centre = np.repeat(random.normal(size=(3, 64)), 2, axis=0)
    return LabelledLatents(
        z_mean=jnp.asarray(2.0 + centre + 0.3 * random.normal(size=(6, 64)), jnp.float32),
        z_log_variance=jnp.full((6, 64), 2 * np.log(0.05), jnp.float32),
        label=jnp.repeat(jnp.eye(3), 2, axis=0),
    )


def statistics_of(latents):
    return latent_statistics(
        LatentArchive(latents.z_mean, latents.z_log_variance, jnp.asarray(latents.label))
    )


@pytest.mark.parametrize("config", [SMALL, UNET], ids=["mlp", "unet"])
def test_the_loss_is_that_of_both_players_by_hand(config):
    params = cgan.init_cgan(jax.random.key(0), config, 3)
    random = np.random.default_rng(0)  # the UNet's last layer starts at zero
    params = jax.tree.map(lambda leaf: leaf + 0.05 * random.normal(size=leaf.shape), params)
    z, label = jax.random.normal(jax.random.key(1), (4, 64)), jnp.eye(3)[jnp.array([0, 2, 1, 0])]
    key = jax.random.key(2)
    network = CGAN(config)

    generate = jax.jit(lambda n, one: network.apply(params, n, one, method="generate"))

    def odds(latent, one):
        return network.apply(params, latent, one, method="judge")

    noise = [cgan.noise_of(k, config) for k in jax.random.split(key, 4)]
    fakes = [generate(n, one) for n, one in zip(noise, label, strict=True)]
    real = np.array([odds(latent, one) for latent, one in zip(z, label, strict=True)])
    fake = np.array([odds(latent, one) for latent, one in zip(fakes, label, strict=True)])
    slopes = np.array([jax.grad(odds)(latent, one) for latent, one in zip(z, label, strict=True)])
    found, metrics = jax.jit(cgan.make_cgan_loss(config))(params, key, (z, label))
    discriminator = np.mean(np.log1p(np.exp(-real)) + np.log1p(np.exp(fake)))
    generator = np.mean(np.log1p(np.exp(-fake)))
    penalty = np.mean((slopes**2).sum(axis=1))
    np.testing.assert_allclose(metrics["discriminator"], discriminator, rtol=1e-4)
    np.testing.assert_allclose(metrics["generator"], generator, rtol=1e-4)
    np.testing.assert_allclose(metrics["penalty"], penalty, rtol=1e-4)
    expected = discriminator + config.penalty * penalty + generator
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_each_player_learns_from_its_own_part():
    """The generator climbs the judge's odds; the judge never moves to be fooled."""
    params = cgan.init_cgan(jax.random.key(0), SMALL, 3)
    batch = jax.random.normal(jax.random.key(1), (8, 64)), jnp.eye(3)[jnp.zeros(8, int)]
    loss = cgan.make_cgan_loss(SMALL)

    def part(name):
        return jax.jit(jax.grad(lambda p: loss(p, jax.random.key(2), batch)[1][name]))(params)[
            "params"
        ]

    for name, learner in (("discriminator", "discriminator"), ("generator", "mlp")):
        moved = {
            who: max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient))
            for who, gradient in part(name).items()
        }
        assert {who for who, most in moved.items() if most > 0} == {learner}


def test_what_is_generated_has_the_style_of_its_label(latents):
    statistics = statistics_of(latents)
    state = init_fit(jax.random.key(1), cgan.init_cgan(jax.random.key(0), SMALL, 3), SMALL.fit)
    fit = make_fit_chunk(
        cgan.make_cgan_loss(SMALL), cgan.make_sample_fn(SMALL, statistics), SMALL.fit, 1500
    )
    state, _ = fit(state, latents)

    def draw(key, label):
        return cgan.sample(key, state.ema, statistics, label, SMALL)

    keys = jax.random.split(jax.random.key(3), (3, 16))
    drawn = np.asarray(jax.vmap(jax.vmap(draw, (0, None)))(keys, jnp.eye(3)))
    apart = ((drawn[:, :, None] - np.asarray(latents.z_mean)) ** 2).mean(axis=-1)
    assert (apart.argmin(axis=-1) // 2 == np.arange(3)[:, None]).mean() > 0.9


def test_samples_are_drawn_from_the_posterior_with_their_label(latents):
    z, label = cgan.make_sample_fn(SMALL, statistics_of(latents))(jax.random.key(0), latents)
    assert (z.shape, label.shape) == ((32, 64), (32, 3))
    known = statistics_of(latents).standardise(latents.z_mean)
    nearest = ((z[:, None] - known) ** 2).mean(axis=-1).argmin(axis=1)
    np.testing.assert_array_equal(latents.label[nearest], label)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"generator": "vae"}, "generator is vae; expected one of mlp, unet"),
        ({"noise_size": 0}, "noise_size is 0; expected >= 1"),
        ({"penalty": -1.0}, r"penalty is -1\.0; expected >= 0"),
        ({"batch_size": 0}, "batch_size is 0; expected >= 1"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **change)
