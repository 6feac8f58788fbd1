"""The translator: from a sentence to the task language (Eq. 6, 7, Table 4, App. E.3).

First the encoder and a linear classifier are fine-tuned to tell the styles apart (Eq. 7), several
times at once, and the parameters are averaged (Wortsman et al. 2022, "Model soups"). Then a VAE
regresses the style's normalised event frequencies from the sentence embedding (Eq. 6). Both are
fits for `haland_jax.fit`. The word embeddings and the lower layers of the encoder stay
as they were pre-trained, so what they return for the training sentences is computed only once.

Axes: F fine-tunings, B sentences, T word pieces, W width of the encoder, U events.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from haland_jax.bert import Bert, BertArchitecture, Pooling, mean_pooled
from haland_jax.bert_weights import Encoder
from haland_jax.fit import FitConfig, LossFn, SampleFn
from haland_jax.translation_vae import TranslationVAE, translation_loss

Params = Any

FINE_TUNING = FitConfig(learning_rate=1e-4, steps=600, warmup_steps=10)
TRANSLATION = FitConfig(learning_rate=1e-4, steps=300, warmup_steps=20)


@dataclass(frozen=True)
class TranslatorConfig:
    """Hyper-parameters of the translator; the sizes and the VAE's learning rate are Table 4's.

    Attributes:
        maximum_length: longest sentence, in word pieces with the two markers.
        pooling: sentence embedding, the mean over word pieces or BERT's pooler.
        trainable_layers: how many of the encoder's last layers are fine-tuned.
        dropout: dropout inside the fine-tuned layers, in [0, 1).
        word_piece_dropout: chance, in [0, 1), that a word piece is hidden during fine-tuning.
        fine_tunings: how many fine-tunings, which differ in minibatches and dropout, are averaged;
            time and memory of the fit grow with it, the fine-tuned translator's do not.
        classifier_rate: how many times as fast as the encoder the classifier learns, at least 1.
        fine_tuning_batch, translation_batch: sentences in a minibatch of Eq. 7 and Eq. 6.
        views: embeddings of each sentence that the VAE is fitted to: the plain one and
            `views - 1` with hidden word pieces.
        latent_dimension, encoder_hidden, decoder_hidden: sizes of the VAE g.
        kl_weight: weight of the KL term of Eq. 6.
        fine_tuning, translation: optimiser and length of the two fits.

    Raises ValueError if a value is out of its range.
    """

    maximum_length: int = 40
    pooling: Pooling = "mean"
    trainable_layers: int = 3
    dropout: float = 0.1
    word_piece_dropout: float = 0.05
    fine_tunings: int = 1
    classifier_rate: float = 30.0
    fine_tuning_batch: int = 24
    translation_batch: int = 80
    views: int = 4
    latent_dimension: int = 64
    encoder_hidden: tuple[int, ...] = (1024, 1024)
    decoder_hidden: tuple[int, ...] = (1024, 1024)
    kl_weight: float = 1e-3
    fine_tuning: FitConfig = FINE_TUNING
    translation: FitConfig = TRANSLATION

    def __post_init__(self) -> None:
        if self.pooling not in ("mean", "pooler"):
            raise ValueError(f"pooling must be 'mean' or 'pooler', found {self.pooling!r}")
        for name in ("dropout", "word_piece_dropout"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in [0, 1), found {getattr(self, name)}")
        least = dict.fromkeys(("trainable_layers", "fine_tunings", "views", "latent_dimension"), 1)
        least |= {"fine_tuning_batch": 1, "translation_batch": 1, "classifier_rate": 1}
        for name, minimum in (least | {"maximum_length": 3, "kl_weight": 0}).items():
            if getattr(self, name) < minimum:
                raise ValueError(f"{name} must be at least {minimum}, found {getattr(self, name)}")


class SentenceData(struct.PyTreeNode):
    """Training sentences after the frozen part of the encoder."""

    hidden: jax.Array  # float32 [B, T, W]
    mask: jax.Array  # bool [B, T]
    style: jax.Array  # int32 [B]


class TranslationData(struct.PyTreeNode):
    """Sentence embeddings and what they should be translated to."""

    embedding: jax.Array  # float32 [B, W]
    frequencies: jax.Array  # float32 [B, U] in [0, 1]


class Translator(struct.PyTreeNode):
    """All that deployment needs; call it with what `bert_weights.tokenize` returns."""

    params: Params  # {"encoder", "classifier", "vae"}
    architecture: BertArchitecture = struct.field(pytree_node=False)
    config: TranslatorConfig = struct.field(pytree_node=False)

    def __call__(self, token_ids: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        """As `translate`."""
        return translate(self.params, self.architecture, self.config, token_ids, mask)


def embed_hidden(
    params: Params,
    architecture: BertArchitecture,
    config: TranslatorConfig,
    hidden: jax.Array,
    mask: jax.Array,
    *,
    dropout_key: jax.Array | None = None,
) -> jax.Array:
    """Sentence embeddings b [B, W] from the input [B, T, W] of the first fine-tuned layer.

    `dropout_key` is consumed; without it there is no dropout.
    """
    bert: Any = Bert(architecture, config.dropout)
    start = _first_trainable(architecture, config)
    hidden = bert.apply(
        {"params": params},
        hidden,
        mask,
        start=start,
        deterministic=dropout_key is None,
        rngs={} if dropout_key is None else {"dropout": dropout_key},
        method=Bert.run_layers,
    )
    if config.pooling == "mean":
        return mean_pooled(hidden, mask)
    return bert.apply({"params": params}, hidden, method=Bert.pool)


def prepare_sentences(
    encoder: Encoder, config: TranslatorConfig, token_ids, mask, style
) -> SentenceData:
    """Run the frozen part of the encoder once; positions that no sentence uses are cut off.

    `token_ids` and `mask` are [B, T], `style` [B] holds the index of each sentence's style.

    Raises ValueError if `trainable_layers` exceeds the encoder's layers.
    """
    length = int(mask.sum(-1).max())
    token_ids, mask = jnp.asarray(token_ids[:, :length]), jnp.asarray(mask[:, :length])
    frozen = jax.jit(frozen_hidden, static_argnums=(1, 2))
    hidden = frozen(encoder.params, encoder.architecture, config, token_ids, mask)
    return SentenceData(hidden=hidden, mask=mask, style=jnp.asarray(style, jnp.int32))


def frozen_hidden(
    variables: Params,
    architecture: BertArchitecture,
    config: TranslatorConfig,
    token_ids: jax.Array,
    mask: jax.Array,
) -> jax.Array:
    """The input [B, T, W] of the first fine-tuned layer, from token ids and mask [B, T]."""
    stop = _first_trainable(architecture, config)
    bert: Any = Bert(architecture)
    hidden = bert.apply(variables, token_ids, method=Bert.embed)
    return bert.apply(variables, hidden, mask, stop=stop, method=Bert.run_layers)


def classify(classifier: Params, embedding: jax.Array, config: TranslatorConfig) -> jax.Array:
    """Style logits [B, style] of sentence embeddings [B, W].

    The factor lets Adam, whose steps have the size of the learning rate, move the classifier
    (new) faster than the encoder, which already knows the language.
    """
    return config.classifier_rate * (embedding @ classifier["kernel"] + classifier["bias"])


def init_fine_tuning(encoder: Encoder, config: TranslatorConfig, num_styles: int) -> Params:
    """Parameters of Eq. 7: `encoder` (pre-trained last layers) and `classifier` (zeros).

    Raises:
        ValueError: if there are fewer than two styles, or more trainable layers than layers.
    """
    if num_styles < 2:
        raise ValueError(f"num_styles must be at least 2, found {num_styles}")
    layers = encoder.architecture.layers
    first = _first_trainable(encoder.architecture, config)
    names = [f"layer_{index}" for index in range(first, layers)]
    if config.pooling == "pooler":
        names.append("pooler")
    kernel, bias = jnp.zeros((encoder.architecture.width, num_styles)), jnp.zeros(num_styles)
    return {
        "encoder": {name: encoder.params["params"][name] for name in names},
        "classifier": {"kernel": kernel, "bias": bias},
    }


def start_fine_tunings(params: Params, config: TranslatorConfig) -> Params:
    """What `init_fine_tuning` returned, once for each fine-tuning: leaves [F, ...]."""
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * config.fine_tunings), params)


def average_fine_tunings(params: Params) -> Params:
    """The mean of fine-tunings with leaves [F, ...]: one encoder and one classifier.

    They began at the same parameters and went a short way, so that their mean is an encoder too.
    What it brings: docs/paper_map.md.
    """
    return jax.tree.map(lambda leaf: leaf.mean(0), params)


def make_fine_tuning(
    architecture: BertArchitecture, config: TranslatorConfig
) -> tuple[LossFn, SampleFn]:
    """Loss and minibatches of Eq. 7: cross-entropy of the style, mean over B and F.

    The parameters are those of `start_fine_tunings`, the leaves of a minibatch [F, B, ...]. The
    fine-tunings share one fit, and so one clip of the gradient's norm, which is that of all.
    "accuracy" is the mean of theirs; that of their average is not measured on the way.
    """

    def sample_fn(key: jax.Array, data: SentenceData) -> SentenceData:
        keys = jax.random.split(key, config.fine_tunings)
        return jax.vmap(lambda one: _minibatch(one, data, config.fine_tuning_batch))(keys)

    def loss_of_one(params: Params, key: jax.Array, batch: SentenceData):
        hide_key, dropout_key = jax.random.split(key)
        mask = hide_word_pieces(hide_key, batch.mask, config.word_piece_dropout)
        inputs = (params["encoder"], architecture, config, batch.hidden, mask)
        embedding = embed_hidden(*inputs, dropout_key=dropout_key if config.dropout else None)
        logits = classify(params["classifier"], embedding, config)
        accuracy = (logits.argmax(-1) == batch.style).mean()
        return classification_loss(logits, batch.style), accuracy

    def loss_fn(params: Params, key: jax.Array, batch: SentenceData):
        keys = jax.random.split(key, config.fine_tunings)
        loss, accuracy = jax.vmap(loss_of_one)(params, keys, batch)
        return loss.mean(), {"accuracy": accuracy.mean()}

    return loss_fn, sample_fn


def classification_loss(logits: jax.Array, style: jax.Array) -> jax.Array:
    """Eq. 7: -log P[C(sentence) = style], mean over B, from logits [B, style] and style [B].

    With equally many sentences for each style this is Eq. 7's mean of means.
    """
    log_probabilities = nn.log_softmax(logits)
    return -jnp.take_along_axis(log_probabilities, style[:, None], axis=-1).mean()


def hide_word_pieces(key: jax.Array, mask: jax.Array, rate: float) -> jax.Array:
    """Mask [B, T] with each word piece but the first (a marker) hidden with chance `rate`."""
    kept = jax.random.bernoulli(key, 1.0 - rate, mask.shape)
    return mask & kept.at[:, 0].set(True)


def prepare_translation(
    key: jax.Array,
    params: Params,
    architecture: BertArchitecture,
    config: TranslatorConfig,
    sentences: SentenceData,
    frequencies: jax.Array,
) -> TranslationData:
    """Embed the training sentences once, `config.views` times each, for the fit of Eq. 6.

    Args:
        key: for hiding word pieces in all views but the first.
        params: parameters of Eq. 7, as `average_fine_tunings` returns them.
        architecture, config: the encoder's and the translator's.
        sentences: training sentences, B of them.
        frequencies: [style, U], the normalised event frequencies of each style, in [0, 1].

    Raises:
        ValueError: if a frequency is outside [0, 1] or a sentence's style has none.
    """
    frequencies = jnp.asarray(frequencies, jnp.float32)
    if not ((frequencies >= 0) & (frequencies <= 1)).all():
        raise ValueError("frequencies must be normalised to [0, 1]; divide by each event's maximum")
    if int(sentences.style.max()) >= len(frequencies):
        raise ValueError(
            f"frequencies has {len(frequencies)} styles, a sentence's is {sentences.style.max()}"
        )

    @partial(jax.jit, static_argnames="rate")
    def view(layers: Params, data: SentenceData, view_key: jax.Array, rate: float) -> jax.Array:
        mask = hide_word_pieces(view_key, data.mask, rate)
        return embed_hidden(layers, architecture, config, data.hidden, mask)

    rates = [0.0] + [config.word_piece_dropout] * (config.views - 1)
    embedding = jnp.concatenate(
        [
            view(params["encoder"], sentences, view_key, rate=rate)
            for view_key, rate in zip(jax.random.split(key, config.views), rates, strict=True)
        ]
    )
    targets = jnp.tile(frequencies[sentences.style], (config.views, 1))
    return TranslationData(embedding=embedding, frequencies=targets)


def init_translation(
    key: jax.Array, architecture: BertArchitecture, config: TranslatorConfig, num_events: int
) -> Params:
    """Parameters of the VAE g for U = `num_events`."""
    embedding = jnp.zeros((1, architecture.width))
    vae: Any = _vae(config, num_events)
    return vae.init(key, embedding)["params"]


def make_translation(config: TranslatorConfig) -> tuple[LossFn, SampleFn]:
    """Loss and minibatches of Eq. 6."""

    def sample_fn(key: jax.Array, data: TranslationData) -> TranslationData:
        return _minibatch(key, data, config.translation_batch)

    def loss_fn(params: Params, key: jax.Array, batch: TranslationData):
        vae: Any = _vae(config, batch.frequencies.shape[-1])
        mean, log_variance = vae.apply(
            {"params": params}, batch.embedding, method=TranslationVAE.encode
        )
        latent = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
        translated = vae.apply({"params": params}, latent, method=TranslationVAE.decode)
        return translation_loss(translated, batch.frequencies, mean, log_variance, config.kl_weight)

    return loss_fn, sample_fn


def assemble_translator(
    encoder: Encoder, config: TranslatorConfig, fine_tuned: Params, vae: Params
) -> Translator:
    """Join the pre-trained encoder with the averaged fine-tunings and the translation's VAE."""
    merged = {**encoder.params["params"], **fine_tuned["encoder"]}
    params = {"encoder": merged, "classifier": fine_tuned["classifier"], "vae": vae}
    return Translator(params=params, architecture=encoder.architecture, config=config)


def translate(
    params: Params,
    architecture: BertArchitecture,
    config: TranslatorConfig,
    token_ids: jax.Array,
    mask: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Sentences to normalised frequencies v-hat [B, U] in [0, 1] and style logits [B, style].

    Deterministic: the VAE's posterior mean is decoded. `token_ids` and `mask` are [B, T], as
    `haland_jax.bert_weights.tokenize` returns them.
    """
    variables = {"params": params["encoder"]}
    hidden = frozen_hidden(variables, architecture, config, token_ids, mask)
    embedding = embed_hidden(params["encoder"], architecture, config, hidden, mask)
    translated = translate_embedding(params["vae"], config, embedding)
    return translated, classify(params["classifier"], embedding, config)


def translate_embedding(vae: Params, config: TranslatorConfig, embedding: jax.Array) -> jax.Array:
    """Sentence embeddings [B, W] to normalised frequencies [B, U], deterministic."""
    module: Any = _vae(config, num_events=vae["frequencies"]["bias"].shape[0])
    return module.apply({"params": vae}, embedding)


def _vae(config: TranslatorConfig, num_events: int) -> TranslationVAE:
    widths = (config.latent_dimension, config.encoder_hidden, config.decoder_hidden)
    return TranslationVAE(num_events, *widths)


def _minibatch(key: jax.Array, data: Any, size: int) -> Any:
    """`size` different rows of every leaf, or all rows where there are fewer."""
    rows = jax.tree.leaves(data)[0].shape[0]
    chosen = jax.random.permutation(key, rows)[: min(size, rows)]
    return jax.tree.map(lambda leaf: leaf[chosen], data)


def _first_trainable(architecture: BertArchitecture, config: TranslatorConfig) -> int:
    first = architecture.layers - config.trainable_layers
    if first < 0:
        raise ValueError(
            f"trainable_layers is {config.trainable_layers}, "
            f"the encoder has only {architecture.layers}"
        )
    return first
