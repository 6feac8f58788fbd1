"""A conditional GAN of policies' latents: what Table 1 puts in place of the diffusion.

A generator makes a latent from noise and a style's label, a discriminator judges latents that it is
told the label of (Mirza & Osindero, 2014). Both learn at once, from one loss in which each sees the
other as constant. Written unbatched like `diffusion`; callers `vmap`.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode
from jax import Array

from haland_jax.diffusion import LatentStatistics
from haland_jax.fit import FitConfig, LossFn, SampleFn
from haland_jax.unet import UNet, UNetConfig

GENERATORS = ("mlp", "unet")


@dataclass(frozen=True)
class CGANConfig:
    """A conditional GAN; the paper names the two generators and leaves the rest open.

    Attributes:
        generator: `mlp`, or `unet`, the noise predictor of the diffusion on a grid of noise.
        grid: height, width and channels that D factors into.
        unet: widths of that UNet.
        noise_size: numbers of noise that the `mlp` gets.
        hidden: widths of the discriminator, and of the `mlp`.
        penalty: weight of the squared gradient of the discriminator at real latents (R1, Mescheder
            et al., 2018). On 24 made-up latents in 8 styles, 0.1 made the `unet` give a quarter of
            its latents another style, and the `mlp` two in three of a style's latents at most.
        batch_size: latents of one step of the fit.
        fit: optimiser and length of the fit; the generator that is kept is the averaged one.
    """

    generator: Literal["mlp", "unet"] = "mlp"
    grid: tuple[int, int, int] = (4, 4, 4)
    unet: UNetConfig = field(default_factory=UNetConfig)
    noise_size: int = 16
    hidden: tuple[int, ...] = (256, 256)
    penalty: float = 1.0
    batch_size: int = 64
    fit: FitConfig = field(
        default_factory=lambda: FitConfig(
            learning_rate=1e-3, steps=4000, warmup_steps=100, ema_decay=0.99
        )
    )

    def __post_init__(self):
        expected = {
            "generator": (self.generator in GENERATORS, f"one of {', '.join(GENERATORS)}"),
            "noise_size": (self.noise_size >= 1, ">= 1"),
            "penalty": (self.penalty >= 0, ">= 0"),
            "batch_size": (self.batch_size >= 1, ">= 1"),
        }
        for name, (valid, wanted) in expected.items():
            if not valid:
                raise ValueError(f"CGANConfig.{name} is {getattr(self, name)}; expected {wanted}")

    @property
    def latent_size(self) -> int:
        """D, numbers in one latent."""
        height, width, channels = self.grid
        return height * width * channels


class LabelledLatents(PyTreeNode):
    """What the GAN is fitted on, one row a policy.

    Attributes:
        z_mean, z_log_variance: [P, D], the autoencoder's posterior.
        label: one-hot of each policy's style, [P, style].
    """

    z_mean: Array
    z_log_variance: Array
    label: Array


class Dense(nn.Module):
    """A multi-layer perceptron, [I] -> [size]."""

    hidden: tuple[int, ...]
    size: int

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        for index, width in enumerate(self.hidden):
            inputs = nn.leaky_relu(nn.Dense(width, name=f"dense_{index}")(inputs), 0.2)
        return nn.Dense(self.size, name="out")(inputs)


class CGAN(nn.Module):
    """Generator and discriminator on flat standardised latents."""

    config: CGANConfig

    def setup(self):
        config = self.config
        self.discriminator = Dense(config.hidden, 1)
        if config.generator == "unet":
            self.label_token = nn.Dense(config.unet.step_features)
            self.unet = UNet(config.unet)
        else:
            self.mlp = Dense(config.hidden, config.latent_size)

    def __call__(self, noise: Array, label: Array) -> Array:
        """The judgement [] of what is generated; for initialisation."""
        return self.judge(self.generate(noise, label), label)

    def generate(self, noise: Array, label: Array) -> Array:
        """A latent [D] from noise [`noise_of`] and a one-hot label [style]."""
        if self.config.generator == "mlp":
            return self.mlp(jnp.concatenate([noise, label]))
        tokens = self.label_token(label)[None]
        return self.unet(noise.reshape(self.config.grid), jnp.zeros(()), tokens).reshape(-1)

    def judge(self, z: Array, label: Array) -> Array:
        """How real a latent [D] looks among those of its label [style]; log odds []."""
        return self.discriminator(jnp.concatenate([z, label]))[0]


def noise_of(key: Array, config: CGANConfig) -> Array:
    """Noise for one latent; consumes `key`."""
    size = config.noise_size if config.generator == "mlp" else config.latent_size
    return jax.random.normal(key, (size,))


def init_cgan(key: Array, config: CGANConfig, num_styles: int) -> Any:
    """Initial parameters of both networks."""
    noise_key, init_key = jax.random.split(key)
    return CGAN(config).init(init_key, noise_of(noise_key, config), jnp.zeros(num_styles))


def make_sample_fn(config: CGANConfig, statistics: LatentStatistics) -> SampleFn:
    """sample_fn(key, archive) -> (z [B, D] standardised, label [B, style]) for `fit`."""

    def sample_fn(key: Array, archive: LabelledLatents) -> tuple[Array, Array]:
        row_key, posterior_key = jax.random.split(key)
        rows = jax.random.randint(row_key, (config.batch_size,), 0, archive.z_mean.shape[0])
        noise = jax.random.normal(posterior_key, (config.batch_size, config.latent_size))
        z = archive.z_mean[rows] + jnp.exp(0.5 * archive.z_log_variance[rows]) * noise
        return statistics.standardise(z), archive.label[rows]

    return sample_fn


def make_cgan_loss(config: CGANConfig) -> LossFn:
    """The non-saturating loss of both players (Goodfellow et al., 2014) as one for `fit`.

    The discriminator's part sees the generator as constant and the other way round, so that one
    gradient step moves both.
    """
    network = CGAN(config)

    def judge(params: Any, z: Array, label: Array) -> Array:
        found: Any = network.apply(params, z, label, method="judge")
        return found

    def loss_fn(params: Any, key: Array, batch: tuple[Array, Array]):
        z, label = batch  # [B, D], [B, style]
        constant = jax.lax.stop_gradient(params)
        noise = jax.vmap(lambda k: noise_of(k, config))(jax.random.split(key, z.shape[0]))
        fake: Any = jax.vmap(lambda n, one: network.apply(params, n, one, method="generate"))(
            noise, label
        )
        real_odds = jax.vmap(judge, (None, 0, 0))(params, z, label)
        fake_odds = jax.vmap(judge, (None, 0, 0))(params, jax.lax.stop_gradient(fake), label)
        slope = jax.vmap(jax.grad(judge, argnums=1), (None, 0, 0))(params, z, label)
        penalty = jnp.mean(jnp.sum(jnp.square(slope), axis=-1))
        discriminator = jnp.mean(nn.softplus(-real_odds) + nn.softplus(fake_odds))
        fooled = jax.vmap(judge, (None, 0, 0))(constant, fake, label)
        generator = jnp.mean(nn.softplus(-fooled))
        metrics = {"discriminator": discriminator, "generator": generator, "penalty": penalty}
        return discriminator + config.penalty * penalty + generator, metrics

    return loss_fn


def sample(
    key: Array, params: Any, statistics: LatentStatistics, label: Array, config: CGANConfig
) -> Array:
    """Generates a policy's latent z [D], on the autoencoder's scale, for a label [style]."""
    z: Any = CGAN(config).apply(params, noise_of(key, config), label, method="generate")
    return statistics.restore(z)
