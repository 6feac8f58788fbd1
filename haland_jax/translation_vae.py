"""The VAE g of Eq. 6: from a sentence embedding to the task language (Table 4).

Axes: B sentences, W width of the embedding, D latent, U events.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn


class TranslationVAE(nn.Module):
    """g of Eq. 6: a sentence embedding to a Gaussian over e, and e to the frequencies."""

    num_events: int
    latent_dimension: int
    encoder_hidden: tuple[int, ...]
    decoder_hidden: tuple[int, ...]

    def setup(self) -> None:
        self.encoder = [nn.Dense(size) for size in self.encoder_hidden]
        self.posterior = nn.Dense(2 * self.latent_dimension)
        self.decoder = [nn.Dense(size) for size in self.decoder_hidden]
        self.frequencies = nn.Dense(self.num_events)

    def __call__(self, embedding: jax.Array) -> jax.Array:
        """The deterministic translation of [B, W]: the posterior mean decoded, [B, U]."""
        return self.decode(self.encode(embedding)[0])

    def encode(self, embedding: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and log-variance of e, each [B, D], from [B, W]."""
        hidden = embedding
        for layer in self.encoder:
            hidden = nn.relu(layer(hidden))
        mean, log_variance = jnp.split(self.posterior(hidden), 2, axis=-1)
        return mean, log_variance

    def decode(self, latent: jax.Array) -> jax.Array:
        """Normalised frequencies in [0, 1], [B, U], from e [B, D]."""
        hidden = latent
        for layer in self.decoder:
            hidden = nn.relu(layer(hidden))
        return nn.sigmoid(self.frequencies(hidden))


def translation_loss(
    translated: jax.Array,
    frequencies: jax.Array,
    mean: jax.Array,
    log_variance: jax.Array,
    kl_weight: float,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Eq. 6: squared error (sum over U) + weight x KL to N(0, I) (sum over D), mean over B.

    `translated` and `frequencies` are [B, U], the posterior's `mean` and `log_variance` [B, D];
    the paper's formula has `kl_weight` 1.
    """
    squared_error = jnp.square(translated - frequencies).sum(-1).mean()
    kl = 0.5 * (jnp.square(mean) + jnp.exp(log_variance) - 1.0 - log_variance).sum(-1).mean()
    return squared_error + kl_weight * kl, {"squared_error": squared_error, "kl": kl}
