"""BERT's encoder in Linen: embeddings, post-norm transformer layers, pooler.

Source: Devlin et al. (2019), "BERT: Pre-training of Deep Bidirectional Transformers". The outputs
equal those of the reference implementation (`tests/test_bert_reference.py`). Weights and
tokenizers come from `haland_jax.bert_weights`; nothing here is meant to start from random weights.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "gelu": partial(nn.gelu, approximate=False),
    "gelu_new": partial(nn.gelu, approximate=True),
    "relu": nn.relu,
}

Pooling = Literal["mean", "pooler"]


@dataclass(frozen=True)
class BertArchitecture:
    """Sizes of a BERT checkpoint, as its `config.json` states them.

    Raises:
        ValueError: if a size is not positive, the heads do not divide the width, or the
            activation is unknown.
    """

    vocabulary: int
    width: int
    layers: int
    heads: int
    intermediate_width: int
    positions: int = 512
    segments: int = 2
    norm_epsilon: float = 1e-12
    activation: str = "gelu"

    def __post_init__(self) -> None:
        sizes = ("vocabulary", "width", "layers", "heads", "intermediate_width", "positions")
        for name in (*sizes, "segments"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, found {getattr(self, name)}")
        if self.width % self.heads:
            raise ValueError(f"heads ({self.heads}) must divide width ({self.width})")
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"activation must be one of {sorted(ACTIVATIONS)}, found {self.activation!r}"
            )


class BertOutput(NamedTuple):
    """What the encoder returns; positions outside the mask carry no meaning."""

    hidden: jax.Array  # [B, T, W] last hidden state
    pooled: jax.Array  # [B, W] tanh projection of the first token


class BertLayer(nn.Module):
    """Self-attention and a two-layer MLP, each added to its input and then normalised."""

    architecture: BertArchitecture
    dropout: float = 0.0

    @nn.compact
    def __call__(
        self, hidden: jax.Array, mask: jax.Array, *, deterministic: bool = True
    ) -> jax.Array:  # [B, T, W], [B, T] -> [B, T, W]
        sizes = self.architecture

        def normalise(name: str, inputs: jax.Array) -> jax.Array:
            return nn.LayerNorm(epsilon=sizes.norm_epsilon, name=name)(inputs)

        def drop(inputs: jax.Array) -> jax.Array:
            return nn.Dropout(self.dropout)(inputs, deterministic=deterministic)

        split = (sizes.heads, sizes.width // sizes.heads)
        query, key, value = (
            nn.Dense(sizes.width, name=name)(hidden).reshape(*hidden.shape[:-1], *split)
            for name in ("query", "key", "value")
        )
        scores = jnp.einsum("bqhd,bkhd->bhqk", query, key) / jnp.sqrt(split[1])
        scores = jnp.where(mask[:, None, None, :], scores, jnp.finfo(scores.dtype).min)
        weights = drop(nn.softmax(scores))  # [B, heads, T, T]
        context = jnp.einsum("bhqk,bkhd->bqhd", weights, value).reshape(hidden.shape)
        attended = drop(nn.Dense(sizes.width, name="attention_output")(context))
        hidden = normalise("attention_norm", hidden + attended)
        expanded = nn.Dense(sizes.intermediate_width, name="intermediate")(hidden)
        expanded = ACTIVATIONS[sizes.activation](expanded)
        return normalise(
            "output_norm", hidden + drop(nn.Dense(sizes.width, name="output")(expanded))
        )


class Bert(nn.Module):
    """The encoder; `embed`, `run_layers` and `pool` are its parts, for partial fine-tuning."""

    architecture: BertArchitecture
    dropout: float = 0.0

    def setup(self) -> None:
        sizes = self.architecture
        self.word_embeddings = nn.Embed(sizes.vocabulary, sizes.width)
        self.position_embeddings = nn.Embed(sizes.positions, sizes.width)
        self.segment_embeddings = nn.Embed(sizes.segments, sizes.width)
        self.embeddings_norm = nn.LayerNorm(epsilon=sizes.norm_epsilon)
        self.layer = [BertLayer(sizes, self.dropout) for _ in range(sizes.layers)]
        self.pooler = nn.Dense(sizes.width)

    def __call__(
        self, token_ids: jax.Array, mask: jax.Array, *, deterministic: bool = True
    ) -> BertOutput:
        """Encode sentences of one segment.

        Args:
            token_ids: int32 [B, T], T at most `architecture.positions`.
            mask: bool [B, T], True where there is a token.
            deterministic: False applies dropout and needs a "dropout" key.
        """
        hidden = self.run_layers(self.embed(token_ids), mask, deterministic=deterministic)
        return BertOutput(hidden, self.pool(hidden))

    def embed(self, token_ids: jax.Array) -> jax.Array:
        """The input of the first layer, float32 [B, T, W], of token ids [B, T]."""
        length = token_ids.shape[-1]
        if length > self.architecture.positions:
            raise ValueError(
                f"token_ids has {length} positions, the encoder {self.architecture.positions}"
            )
        positions = self.position_embeddings(jnp.arange(length))  # [T, W]
        segment = self.segment_embeddings(jnp.zeros_like(token_ids))
        return self.embeddings_norm(self.word_embeddings(token_ids) + positions + segment)

    def run_layers(
        self,
        hidden: jax.Array,
        mask: jax.Array,
        *,
        start: int = 0,
        stop: int | None = None,
        deterministic: bool = True,
    ) -> jax.Array:
        """Apply layers `start` (included) to `stop` (excluded; default: all) to [B, T, W]."""
        for layer in self.layer[start:stop]:
            hidden = layer(hidden, mask, deterministic=deterministic)
        return hidden

    def pool(self, hidden: jax.Array) -> jax.Array:
        """BERT's own sentence vector, [B, W]: tanh of a projection of the first token."""
        return jnp.tanh(self.pooler(hidden[:, 0]))


def mean_pooled(hidden: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean over the unmasked positions T of hidden [B, T, W]: [B, W]; zero if there are none."""
    weights = mask[..., None].astype(hidden.dtype)
    return (hidden * weights).sum(-2) / jnp.maximum(weights.sum(-2), 1.0)
