"""The noise predictor's parts: τ_θ, and Table 3's UNet on a small grid of latent numbers.

Table 3 names the submodules and leaves their sizes open. Its decoder's "Upsample" needs a coarser
grid, so the second of the encoder's two convolutions has stride 2: a latent of 64 numbers is a grid
of 4x4 cells with 4 channels, worked on at 2x2. "Positional Embedding" is taken as the sinusoidal
embedding of the noise step, given to every residual block, together with a learnt embedding of the
cell, since the place of a number in the latent means something here, unlike that of a pixel.

Everything is written unbatched, [height, width, channels]; callers `vmap`.
"""

from dataclasses import dataclass

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from haland_jax.task_language import neighbouring_tokens


@dataclass(frozen=True)
class UNetConfig:
    """Widths of the UNet; Table 3 gives none, these were chosen for two CPU cores.

    Attributes:
        channels: width on the full grid.
        inner_channels: width on the coarse grid, where all residual and attention blocks work.
        groups: groups of each GroupNorm; has to divide both widths.
        heads: attention heads; has to divide `inner_channels`.
        step_features: width of the noise step's embedding; even.
    """

    channels: int = 64
    inner_channels: int = 64
    groups: int = 8
    heads: int = 4
    step_features: int = 128

    def __post_init__(self):
        for name in ("channels", "inner_channels"):
            if getattr(self, name) % self.groups:
                raise ValueError(
                    f"UNetConfig.{name} is {getattr(self, name)}; it has to be a multiple of "
                    f"groups = {self.groups}"
                )
        if self.inner_channels % self.heads:
            raise ValueError(
                f"UNetConfig.inner_channels is {self.inner_channels}; it has to be a multiple of "
                f"heads = {self.heads}"
            )
        if self.step_features % 2:
            raise ValueError(
                f"UNetConfig.step_features is {self.step_features}; it has to be even: a sine and "
                "a cosine for each frequency"
            )


def sinusoidal_embedding(step: Array, features: int, longest_period: float = 10_000.0) -> Array:
    """Sines, then cosines, of `step` at geometrically spaced frequencies (Vaswani et al., 2017).

    Args:
        step: [], noise step; may be fractional.
        features: even width of the result.
        longest_period: the slowest frequency is about 1 / longest_period radians a step.

    Returns:
        [features], in [-1, 1].
    """
    half = features // 2
    frequencies = jnp.exp(-jnp.log(longest_period) * jnp.arange(half) / half)
    angles = step * frequencies
    return jnp.concatenate([jnp.sin(angles), jnp.cos(angles)])


class Convolution(nn.Module):
    """3x3 convolution with zero padding, [H, W, C] -> [H / stride, W / stride, features].

    Written as one matrix product over the nine shifted grids: on grids this small XLA's own
    convolution, and still more its gradient, is several times slower on a CPU.
    `kernel` is [9 * C, features], rows ordered as (row, column, channel).
    """

    features: int
    stride: int = 1
    zero: bool = False

    @nn.compact
    def __call__(self, grid: Array) -> Array:
        height, width, _ = grid.shape
        padded = jnp.pad(grid, ((1, 1), (1, 1), (0, 0)))
        shifted = [
            padded[row : row + height : self.stride, column : column + width : self.stride]
            for row in range(3)
            for column in range(3)
        ]
        initialiser = nn.initializers.zeros if self.zero else nn.initializers.lecun_normal()
        return nn.Dense(self.features, kernel_init=initialiser, name="taps")(
            jnp.concatenate(shifted, axis=-1)
        )


class GridNorm(nn.Module):
    """GroupNorm of one [H, W, C] grid (Wu & He, 2018), with learnt scale and bias [C]."""

    groups: int
    epsilon: float = 1e-5

    @nn.compact
    def __call__(self, grid: Array) -> Array:
        channels = grid.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        grouped = grid.reshape(-1, self.groups, channels // self.groups)
        mean = grouped.mean(axis=(0, 2), keepdims=True)
        centred = grouped - mean
        variance = jnp.square(centred).mean(axis=(0, 2), keepdims=True)
        normal = centred * jax.lax.rsqrt(variance + self.epsilon)
        return normal.reshape(grid.shape) * scale + bias


class ResidualBlock(nn.Module):
    """GroupNorm, SiLU, convolution, twice, the step's embedding added between; plus a shortcut."""

    features: int
    groups: int

    @nn.compact
    def __call__(self, grid: Array, step_embedding: Array) -> Array:
        hidden = nn.silu(GridNorm(self.groups, name="norm_0")(grid))
        hidden = Convolution(self.features, name="convolution_0")(hidden)
        hidden = hidden + nn.Dense(self.features, name="step")(nn.silu(step_embedding))
        hidden = nn.silu(GridNorm(self.groups, name="norm_1")(hidden))
        hidden = Convolution(self.features, name="convolution_1")(hidden)
        if grid.shape[-1] != self.features:
            grid = nn.Dense(self.features, name="shortcut")(grid)
        return grid + hidden


class Attention(nn.Module):
    """Multi-head attention of queries [Q, C] on a context [K, d] -> [Q, C]."""

    heads: int

    @nn.compact
    def __call__(self, queries: Array, context: Array) -> Array:
        channels = queries.shape[-1]

        def project(inputs: Array, name: str) -> Array:
            projected = nn.Dense(channels, use_bias=False, name=name)(inputs)
            return projected.reshape(-1, self.heads, channels // self.heads)

        query, key, value = (
            project(queries, "query"),
            project(context, "key"),
            project(context, "value"),
        )
        scores = jnp.einsum("qhc,khc->hqk", query, key) / jnp.sqrt(channels // self.heads)
        mixed = jnp.einsum("hqk,khc->qhc", jax.nn.softmax(scores), value)
        return nn.Dense(channels, name="out")(mixed.reshape(-1, channels))


class SpatialTransformer(nn.Module):
    """Self-attention of the cells, cross-attention on the tokens, feed-forward; each residual.

    The attention block of latent diffusion (Rombach et al., 2022), which App. E.2 adopts.
    """

    groups: int
    heads: int

    @nn.compact
    def __call__(self, grid: Array, tokens: Array) -> Array:
        channels = grid.shape[-1]
        cells = GridNorm(self.groups, name="norm")(grid).reshape(-1, channels)
        cells = nn.Dense(channels, name="project_in")(cells)
        normal = nn.LayerNorm(name="norm_self")(cells)
        cells = cells + Attention(self.heads, name="self_attention")(normal, normal)
        normal = nn.LayerNorm(name="norm_cross")(cells)
        cells = cells + Attention(self.heads, name="cross_attention")(normal, tokens)
        normal = nn.LayerNorm(name="norm_feed_forward")(cells)
        hidden = nn.gelu(nn.Dense(2 * channels, name="feed_forward_0")(normal))
        cells = cells + nn.Dense(channels, name="feed_forward_1")(hidden)
        return grid + nn.Dense(channels, name="project_out")(cells).reshape(grid.shape)


class Conditioner(nn.Module):
    """τ_θ: frequencies [U] -> tokens [U, d], learnt embeddings of Eq. 8's ids.

    Each value takes the mean of its two neighbouring bins' embeddings, weighted by nearness, and
    the table starts as a random direction a dimension plus another times the bin's centre: with few
    styles most bins never occur, and such a bin should still mean something between its neighbours.
    The unconditional tokens of classifier-free guidance are one learnt embedding [d].
    """

    bins: int
    features: int

    @nn.compact
    def __call__(self, v_hat: Array, dropped: Array) -> Array:
        def initialise(key: Array, shape: tuple[int, ...]) -> Array:
            base_key, slope_key = jax.random.split(key)
            directions = (shape[0] // self.bins, 1, self.features)
            centres = (jnp.arange(self.bins)[:, None] + 0.5) / self.bins
            base = jax.random.normal(base_key, directions)
            slope = jax.random.normal(slope_key, directions)
            return (base + (2 * centres - 1) * slope).reshape(shape) / jnp.sqrt(2.0)

        table = self.param("embedding", initialise, (v_hat.shape[-1] * self.bins, self.features))
        nothing = self.param("unconditional", nn.initializers.normal(1.0), (self.features,))
        lower, upper, weight = neighbouring_tokens(v_hat, self.bins)
        tokens = (1 - weight)[:, None] * table[lower] + weight[:, None] * table[upper]
        return jnp.where(dropped, nothing, tokens)


class VectorConditioner(nn.Module):
    """Any vector [W] -> tokens [count, d], linearly, or the unconditional embedding [d]."""

    count: int
    features: int

    @nn.compact
    def __call__(self, vector: Array, dropped: Array) -> Array:
        tokens = nn.Dense(self.count * self.features, name="tokens")(vector)
        nothing = self.param("unconditional", nn.initializers.normal(1.0), (self.features,))
        return jnp.where(dropped, nothing, tokens.reshape(self.count, self.features))


class Upsample(nn.Module):
    """[H, W, C] -> [2 H, 2 W, features]: every cell makes four different ones (sub-pixel layer).

    Repeating a cell instead would give four neighbouring cells of the latent the same features.
    """

    features: int

    @nn.compact
    def __call__(self, grid: Array) -> Array:
        height, width, _ = grid.shape
        cells = nn.Dense(4 * self.features, name="cells")(grid)
        cells = cells.reshape(height, width, 2, 2, self.features).swapaxes(1, 2)
        return cells.reshape(2 * height, 2 * width, self.features)


class UNet(nn.Module):
    """ε_θ of Table 3: the noise in a noisy latent grid, given its step and the task language."""

    config: UNetConfig = UNetConfig()

    @nn.compact
    def __call__(self, grid: Array, step: Array, tokens: Array) -> Array:
        """Predict the noise.

        Args:
            grid: [H, W, C], noisy standardised latent; H and W even.
            step: [], noise step from 1 to N; its scale is that of `sinusoidal_embedding`.
            tokens: [U, d], task-language embeddings.

        Returns:
            [H, W, C]. Zero at initialisation.
        """
        height, width, latent_channels = grid.shape
        if height % 2 or width % 2:
            raise ValueError(f"UNet got a grid of {height}x{width}; both sides have to be even")
        config, inner = self.config, self.config.inner_channels
        embedding = nn.Dense(config.step_features, name="step_0")(
            sinusoidal_embedding(step, config.step_features)
        )
        embedding = nn.Dense(config.step_features, name="step_1")(nn.silu(embedding))
        # Beside cross-attention, the sum of the tokens (at unit scale) steers every residual block.
        pooled = tokens.sum(axis=0) / jnp.sqrt(tokens.shape[0])
        embedding = embedding + nn.Dense(config.step_features, name="pooled_tokens")(pooled)

        def residual(name: str, hidden: Array) -> Array:
            return ResidualBlock(inner, config.groups, name=name)(hidden, embedding)

        def attention(name: str, hidden: Array) -> Array:
            return SpatialTransformer(config.groups, config.heads, name=name)(hidden, tokens)

        cell_embedding = self.param(
            "cell", nn.initializers.normal(0.02), (height, width, config.channels)
        )
        fine = Convolution(config.channels, name="encoder_convolution_0")(grid) + cell_embedding
        coarse = Convolution(inner, stride=2, name="encoder_convolution_1")(nn.silu(fine))
        coarse = residual("encoder_residual", coarse)

        hidden = residual("bottleneck_residual_0", coarse)
        hidden = attention("bottleneck_attention", hidden)
        hidden = residual("bottleneck_residual_1", hidden)

        hidden = jnp.concatenate([hidden, coarse], axis=-1)
        hidden = residual("decoder_residual_0", hidden)
        hidden = residual("decoder_residual_1", hidden)
        hidden = attention("decoder_attention", hidden)
        hidden = Upsample(config.channels, name="upsample")(hidden)

        hidden = jnp.concatenate([hidden, fine], axis=-1)
        hidden = nn.silu(GridNorm(config.groups, name="out_norm")(hidden))
        return Convolution(latent_channels, zero=True, name="out_convolution")(hidden)
