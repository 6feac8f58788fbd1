"""Latent diffusion of policies, conditioned on the task language (Eq. 2 and 5; App. E.2).

What is diffused is the standardised latent of the policy autoencoder, [D] = 64 numbers seen as a
4x4 grid of 4 channels. Written unbatched; callers `vmap`. Noise steps are numbered 1 to N as in the
paper, and an array's entry i - 1 belongs to step i. `samplers.py` draws from what is fitted here.
"""

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode
from jax import Array

from haland_jax.fit import FitConfig, LossFn, SampleFn
from haland_jax.noise_schedule import PAPER_STEPS, NoiseSchedule, noise_schedule
from haland_jax.task_language import BINS, jittered
from haland_jax.unet import Conditioner, UNet, UNetConfig, VectorConditioner


@dataclass(frozen=True)
class DiffusionConfig:
    """Latent diffusion; sizes from Tables 2 and 3, the rest left open by the paper.

    The default fit takes some 70 s of one CPU core. On 40 made-up latents in 8 styles, each 0.84
    standard deviations (rms over D) from its nearest neighbour, all of 128 samples came nearest
    to a latent of their own style, at 0.22 on average.

    Attributes:
        grid: height, width and channels that D factors into; 4x4x4 for Table 2's D = 64.
        unet: widths of Table 3's UNet.
        bins: V of Eq. 8 (App. D).
        token_features: width d of a token's embedding.
        vector_tokens: 0 for a task language as condition; otherwise it is any vector, such as a
            sentence's embedding, which becomes so many tokens (an ablation of Table 1).
        noise_steps: N. Other values than 1000 rescale β so that the last step is as noisy.
        ddim_steps: steps of the fast sampler, at most N.
        eta: noise of the fast sampler, 0 none, 1 as much as Eq. 1.
        clip: largest magnitude of the predicted standardised latent in DDIM; infinity clips none.
        frequency_jitter: half-width of the uniform noise on the frequencies in training.
        condition_dropout: share of training samples without a condition; needed for guidance.
        guidance: classifier-free guidance weight; 1 is plain conditional sampling.
        batch_size: samples of one step of the fit.
        largest_weight: bound of the weight min(1 / ᾱ_i, bound) of a noise step in the loss; 1 is
            Eq. 5 itself, a larger one pays more attention to the noisy steps, where a sample
            settles for a style.
        fit: optimiser and length of the fit.
    """

    grid: tuple[int, int, int] = (4, 4, 4)
    unet: UNetConfig = field(default_factory=UNetConfig)
    bins: int = BINS
    token_features: int = 32
    vector_tokens: int = 0
    noise_steps: int = PAPER_STEPS
    ddim_steps: int = 25
    eta: float = 0.0
    clip: float = float("inf")
    frequency_jitter: float = 0.03
    condition_dropout: float = 0.0
    guidance: float = 1.0
    batch_size: int = 64
    largest_weight: float = 1.0
    fit: FitConfig = field(
        default_factory=lambda: FitConfig(
            learning_rate=3e-3, steps=1600, warmup_steps=100, ema_decay=0.995
        )
    )

    predicts_clean: ClassVar[bool] = False
    """Whether the UNet gives the clean latent (`CleanDiffusionConfig`), and not a velocity."""

    def __post_init__(self):
        expected = {
            "bins": (self.bins >= 2, ">= 2"),
            "vector_tokens": (self.vector_tokens >= 0, ">= 0"),
            "noise_steps": (self.noise_steps >= 10, ">= 10"),
            "ddim_steps": (2 <= self.ddim_steps <= self.noise_steps, "in [2, noise_steps]"),
            "eta": (0 <= self.eta <= 1, "in [0, 1]"),
            "clip": (self.clip > 0, "> 0"),
            "frequency_jitter": (0 <= self.frequency_jitter <= 1, "in [0, 1]"),
            "condition_dropout": (0 <= self.condition_dropout < 1, "in [0, 1)"),
            "guidance": (
                self.guidance == 1 or self.condition_dropout > 0,
                "1 unless condition_dropout > 0 trains the unconditional branch",
            ),
            "batch_size": (self.batch_size >= 1, ">= 1"),
            "largest_weight": (self.largest_weight >= 1, ">= 1"),
        }
        for name, (valid, wanted) in expected.items():
            if not valid:
                raise ValueError(
                    f"DiffusionConfig.{name} is {getattr(self, name)}; it has to be {wanted}"
                )

    @property
    def latent_size(self) -> int:
        """D, numbers in one latent."""
        return int(np.prod(self.grid))


class CleanDiffusionConfig(DiffusionConfig):
    """A diffusion whose UNet gives the clean latent itself.

    For latents of more numbers than can pass through the UNet at once. Noise, and so a velocity,
    fills all of them; the clean latents of a few policies lie in few directions.
    """

    predicts_clean: ClassVar[bool] = True

    @classmethod
    def like(cls, config: DiffusionConfig) -> "CleanDiffusionConfig":
        """A configuration with the same settings."""
        return cls(**{one.name: getattr(config, one.name) for one in fields(config)})


class LatentArchive(PyTreeNode):
    """What the diffusion is fitted on, one row a policy.

    Attributes:
        z_mean, z_log_variance: [P, D], the autoencoder's posterior.
        v_hat: [P, U], the task language of each policy's style, in [0, 1]; with
            `DiffusionConfig.vector_tokens` any vector.
    """

    z_mean: Array
    z_log_variance: Array
    v_hat: Array


class LatentStatistics(PyTreeNode):
    """Mean and standard deviation of every latent dimension over the archive, each [D]."""

    mean: Array
    std: Array

    def standardise(self, z: Array) -> Array:
        return (z - self.mean) / self.std

    def restore(self, standardised: Array) -> Array:
        return standardised * self.std + self.mean


class DiffusionParams(PyTreeNode):
    """A fitted diffusion: the noise predictor's (averaged) parameters and the statistics."""

    network: Any
    statistics: LatentStatistics


def latent_statistics(archive: LatentArchive) -> LatentStatistics:
    """Statistics of z over the archive: the variance between policies plus that within each.

    Raises:
        ValueError: a dimension does not vary at all or is not finite.
    """
    mean = np.asarray(archive.z_mean, np.float64)
    within = np.exp(np.asarray(archive.z_log_variance, np.float64)).mean(axis=0)
    std = np.sqrt(mean.var(axis=0) + within)
    if not (np.isfinite(std) & (std > 0)).all():
        raise ValueError(
            "the archive's latents have a dimension that is constant or not finite; "
            "check the policy autoencoder's fit"
        )
    return LatentStatistics(
        mean=jnp.asarray(mean.mean(axis=0), jnp.float32), std=jnp.asarray(std, jnp.float32)
    )


class NoisePredictor(nn.Module):
    """ε_θ(z_i, i, τ_θ(L_T)) of Eq. 5, on flat latents.

    ε_θ = √ᾱ_i UNet + √(1 - ᾱ_i) z_i, the velocity form of Salimans & Ho (2022). If the UNet were to
    give ε itself, its error would enter the clean latent divided by √ᾱ_i, by 158 times at i = N,
    and a short fit would not sample anything usable. With `CleanDiffusionConfig` the UNet gives the
    clean latent, and ε_θ = (z_i - √ᾱ_i UNet) / √(1 - ᾱ_i).
    """

    config: DiffusionConfig

    def setup(self):
        tokens, features = self.config.vector_tokens, self.config.token_features
        self.conditioner = (
            VectorConditioner(tokens, features)
            if tokens
            else Conditioner(self.config.bins, features)
        )
        self.unet = UNet(self.config.unet)

    def __call__(self, noisy: Array, step: Array, v_hat: Array, dropped: Array) -> Array:
        """Noise [D] predicted in `noisy` [D] at noise step `step` [] of N, for `v_hat` [U].

        `dropped` [] bool: replace the condition by the unconditional tokens.
        """
        return self.predict(noisy, step, self.tokens(v_hat, dropped))

    def tokens(self, v_hat: Array, dropped: Array) -> Array:
        return self.conditioner(v_hat, dropped)

    def predict(self, noisy: Array, step: Array, tokens: Array) -> Array:
        # The step's embedding is made for N = 1000.
        scaled = step * (PAPER_STEPS / self.config.noise_steps)
        output = self.unet(noisy.reshape(self.config.grid), scaled, tokens).reshape(-1)
        alpha_bar = noise_schedule(self.config.noise_steps).alpha_bar[step - 1]
        if self.config.predicts_clean:
            return (noisy - jnp.sqrt(alpha_bar) * output) / jnp.sqrt(1 - alpha_bar)
        return jnp.sqrt(alpha_bar) * output + jnp.sqrt(1 - alpha_bar) * noisy


def init_network(key: Array, config: DiffusionConfig, num_events: int) -> Any:
    """Initial parameters of the noise predictor for a task language of U = `num_events`."""
    return jax.jit(NoisePredictor(config).init)(
        key,
        jnp.zeros(config.latent_size),
        jnp.ones((), jnp.int32),
        jnp.zeros(num_events),
        jnp.array(False),
    )


def add_noise(schedule: NoiseSchedule, z: Array, step: Array, noise: Array) -> Array:
    """Eq. 2: √ᾱ_i z + √(1 - ᾱ_i) ε. (Eq. 5 prints α_i where ᾱ_i is meant.)

    Args:
        z, noise: [D].
        step: int [], from 1 to N.
    """
    alpha_bar = schedule.alpha_bar[step - 1]
    return jnp.sqrt(alpha_bar) * z + jnp.sqrt(1 - alpha_bar) * noise


def make_sample_fn(config: DiffusionConfig, statistics: LatentStatistics) -> SampleFn:
    """sample_fn(key, archive) -> (z [B, D] standardised, v_hat [B, U] jittered) for `fit`.

    Policies are drawn uniformly with replacement, z from each one's posterior.
    """

    def sample_fn(key: Array, archive: LatentArchive) -> tuple[Array, Array]:
        row_key, posterior_key, jitter_key = jax.random.split(key, 3)
        rows = jax.random.randint(row_key, (config.batch_size,), 0, archive.z_mean.shape[0])
        noise = jax.random.normal(posterior_key, (config.batch_size, config.latent_size))
        z = archive.z_mean[rows] + jnp.exp(0.5 * archive.z_log_variance[rows]) * noise
        condition = archive.v_hat[rows]
        if not config.vector_tokens:
            condition = jittered(jitter_key, condition, config.frequency_jitter)
        return statistics.standardise(z), condition

    return sample_fn


def make_diffusion_loss(config: DiffusionConfig) -> LossFn:
    """Eq. 5 as a loss_fn for `fit`: squared error of the noise, mean over B and over D.

    The noise step is uniform over 1 .. N. The paper sums; the mean differs by a constant factor.
    With `CleanDiffusionConfig` a noise step weighs (1 - ᾱ_i) / ᾱ_i, which makes that the squared
    error of the clean latent.
    """
    network, schedule = NoisePredictor(config), noise_schedule(config.noise_steps)

    def loss_fn(params: Any, key: Array, batch: tuple[Array, Array]):
        z, v_hat = batch  # [B, D], [B, U]
        step_key, noise_key, drop_key = jax.random.split(key, 3)
        # One uniform draw in each of B equal parts of 1 .. N: still uniform, with less variance.
        fraction = (jnp.arange(z.shape[0]) + jax.random.uniform(step_key, z.shape[:1])) / z.shape[0]
        step = 1 + jnp.minimum(fraction * config.noise_steps, config.noise_steps - 1).astype(int)
        noise = jax.random.normal(noise_key, z.shape)
        dropped = jax.random.bernoulli(drop_key, config.condition_dropout, z.shape[:1])
        noisy = jax.vmap(add_noise, (None, 0, 0, 0))(schedule, z, step, noise)
        predicted = jax.vmap(network.apply, (None, 0, 0, 0, 0))(params, noisy, step, v_hat, dropped)
        error = jnp.mean(jnp.square(jnp.asarray(predicted) - noise), axis=-1)  # [B]
        alpha_bar = schedule.alpha_bar[step - 1]
        if config.predicts_clean:
            weight = (1 - alpha_bar) / alpha_bar
        else:
            weight = jnp.minimum(1 / alpha_bar, config.largest_weight)
        return jnp.mean(weight * error), {"noise_error": jnp.mean(error)}

    return loss_fn
