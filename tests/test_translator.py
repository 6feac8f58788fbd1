"""Equations 6 and 7 against NumPy, tokenisation, and a whole small translator."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax.bert import Bert, BertArchitecture, mean_pooled
from haland_jax.bert_weights import Encoder, load_tokenizer, tokenize
from haland_jax.fit import FitConfig, init_fit, make_fit_chunk
from haland_jax.translation_vae import translation_loss
from haland_jax.translator import (
    SentenceData,
    TranslatorConfig,
    assemble_translator,
    average_fine_tunings,
    classification_loss,
    classify,
    embed_hidden,
    hide_word_pieces,
    init_fine_tuning,
    init_translation,
    make_fine_tuning,
    make_translation,
    prepare_sentences,
    prepare_translation,
    start_fine_tunings,
    translate,
)

ARCHITECTURE = BertArchitecture(
    vocabulary=40, width=16, layers=3, heads=2, intermediate_width=32, positions=32
)
CONFIG = TranslatorConfig(
    trainable_layers=2,
    fine_tunings=2,
    classifier_rate=2.0,
    fine_tuning_batch=6,
    translation_batch=12,
    views=2,
    latent_dimension=4,
    encoder_hidden=(32,),
    decoder_hidden=(32,),
    fine_tuning=FitConfig(learning_rate=1e-2, steps=60, warmup_steps=5),
    translation=FitConfig(learning_rate=3e-3, steps=300, warmup_steps=5),
)
FREQUENCIES = np.array([[0.0, 0.5, 1.0], [1.0, 0.1, 0.3], [0.6, 0.9, 0.0]], np.float32)


def small_encoder() -> Encoder:
    tokens = jnp.zeros((1, 4), jnp.int32)
    params = Bert(ARCHITECTURE).init(jax.random.key(7), tokens, jnp.ones_like(tokens, bool))
    return Encoder(params=params, architecture=ARCHITECTURE)


def small_sentences() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twelve sentences of 5 to 8 pieces; piece 10 + style tells the style."""
    random = np.random.default_rng(1)
    style = np.arange(12) % 3
    token_ids = random.integers(20, 40, size=(12, 32)).astype(np.int32)
    mask = np.arange(32) < random.integers(5, 9, size=(12, 1))
    mask[0] = np.arange(32) < 8
    token_ids[:, 2] = 10 + style
    return np.where(mask, token_ids, 0), mask, style


def fitted(loss_and_sample, config: FitConfig, params, data):
    chunk = make_fit_chunk(*loss_and_sample, config, config.steps)
    state, metrics = chunk(init_fit(jax.random.key(3), params, config), data)
    return state.params, metrics


@pytest.fixture(scope="module")
def translator():
    encoder = small_encoder()
    token_ids, mask, style = small_sentences()
    sentences = prepare_sentences(encoder, CONFIG, token_ids, mask, style)
    fine_tunings, metrics = fitted(
        make_fine_tuning(ARCHITECTURE, CONFIG),
        CONFIG.fine_tuning,
        start_fine_tunings(init_fine_tuning(encoder, CONFIG, 3), CONFIG),
        sentences,
    )
    tuned = average_fine_tunings(fine_tunings)
    assert metrics["loss"].shape == (CONFIG.fine_tuning.steps,)
    data = prepare_translation(
        jax.random.key(1), tuned, ARCHITECTURE, CONFIG, sentences, FREQUENCIES
    )
    vae, _ = fitted(
        make_translation(CONFIG),
        CONFIG.translation,
        init_translation(jax.random.key(2), ARCHITECTURE, CONFIG, 3),
        data,
    )
    return assemble_translator(encoder, CONFIG, tuned, vae)


# Equation 7.


def test_classification_loss_equals_numpy():
    logits = np.array([[2.0, 0.0, -1.0], [0.0, 0.0, 0.0]], np.float32)
    # -log(e^2 / (e^2 + 1 + e^-1)) and log 3.
    by_hand = [np.log(np.exp(2) + 1 + np.exp(-1)) - 2, np.log(3)]
    loss = classification_loss(jnp.asarray(logits), jnp.array([0, 2]))
    np.testing.assert_allclose(loss, np.mean(by_hand), rtol=1e-6)


def test_fine_tuning_loss_is_the_cross_entropy_of_the_pooled_embedding():
    encoder = small_encoder()
    config = dataclasses.replace(CONFIG, dropout=0.0, word_piece_dropout=0.0)
    token_ids, mask, style = small_sentences()
    params = init_fine_tuning(encoder, config, 3)
    kernel = 0.1 * np.random.default_rng(0).normal(size=params["classifier"]["kernel"].shape)
    params["classifier"] = {"kernel": jnp.asarray(kernel), "bias": jnp.array([0.1, 0.0, -0.1])}
    data = prepare_sentences(encoder, config, token_ids, mask, style)
    loss_fn, _ = make_fine_tuning(ARCHITECTURE, config)
    # Two fine-tunings: one has the sentences' styles, the other the next ones.
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), data)
    batch = batch.replace(style=jnp.stack([data.style, (data.style + 1) % 3]))
    loss, metrics = loss_fn(start_fine_tunings(params, config), jax.random.key(0), batch)
    # The whole encoder in one piece, pooled and classified in NumPy.
    hidden = np.asarray(Bert(ARCHITECTURE).apply(encoder.params, token_ids, mask).hidden)
    embedding = np.stack([row[used].mean(0) for row, used in zip(hidden, mask, strict=True)])
    logits = config.classifier_rate * (embedding @ kernel + np.array([0.1, 0.0, -0.1]))
    normaliser = np.log(np.exp(logits).sum(-1))
    asked = np.stack([style, (style + 1) % 3])
    expected = (normaliser - logits[np.arange(12), asked]).mean()
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    np.testing.assert_allclose(metrics["accuracy"], (logits.argmax(-1) == asked).mean())


def test_fine_tunings_begin_alike_and_are_averaged():
    params = {"encoder": jnp.array([1.0, 2.0]), "classifier": jnp.array(3.0)}
    begun = start_fine_tunings(params, dataclasses.replace(CONFIG, fine_tunings=3))
    np.testing.assert_array_equal(begun["encoder"], [[1.0, 2.0]] * 3)
    moved = begun | {"encoder": begun["encoder"] + jnp.array([[0.0], [1.0], [5.0]])}
    average = average_fine_tunings(moved)
    np.testing.assert_allclose(average["encoder"], [3.0, 4.0])
    np.testing.assert_allclose(average["classifier"], 3.0)


@pytest.mark.parametrize(
    ("dropout", "batch", "alike"), [(0.0, 12, True), (0.0, 6, False), (0.1, 12, False)]
)
def test_fine_tunings_differ_in_minibatches_and_dropout_alone(dropout, batch, alike):
    encoder = small_encoder()
    config = dataclasses.replace(
        CONFIG, dropout=dropout, word_piece_dropout=0.0, fine_tuning_batch=batch
    )
    sentences = prepare_sentences(encoder, config, *small_sentences())
    initial = start_fine_tunings(init_fine_tuning(encoder, config, 3), config)
    few = FitConfig(learning_rate=1e-2, steps=3)
    params, _ = fitted(make_fine_tuning(ARCHITECTURE, config), few, initial, sentences)
    kernels = np.asarray(params["classifier"]["kernel"])
    assert kernels.shape == (2, 16, 3)
    # With all sentences in a minibatch their order differs, and so the rounding.
    assert (np.abs(kernels[0] - kernels[1]).max() < 1e-3) == alike


# Equation 6.


def test_translation_loss_equals_numpy():
    translated = jnp.array([[0.5, 0.25], [1.0, 0.0]])
    frequencies = jnp.array([[0.0, 0.75], [1.0, 0.5]])
    mean = jnp.array([[1.0, 0.0], [0.0, -2.0]])
    log_variance = jnp.array([[0.0, np.log(4.0)], [0.0, 0.0]])
    # Squared errors 0.25 + 0.25 and 0 + 0.25: mean 0.375.
    # KL: 1/2 (1 + 1 - 1 - 0) + 1/2 (0 + 4 - 1 - log 4) = 2 - log 2, and 1/2 * 4 = 2.
    kl = (2 - np.log(2) + 2) / 2
    loss, metrics = translation_loss(translated, frequencies, mean, log_variance, 0.1)
    np.testing.assert_allclose(metrics["squared_error"], 0.375, rtol=1e-6)
    np.testing.assert_allclose(metrics["kl"], kl, rtol=1e-6)
    np.testing.assert_allclose(loss, 0.375 + 0.1 * kl, rtol=1e-6)


# The parts.


def test_the_frozen_part_and_the_rest_make_the_whole_encoder():
    encoder = small_encoder()
    token_ids, mask, style = small_sentences()
    whole = Bert(ARCHITECTURE).apply(encoder.params, token_ids, mask)
    for pooling, expected in (("mean", mean_pooled(whole.hidden, mask)), ("pooler", whole.pooled)):
        config = dataclasses.replace(CONFIG, pooling=pooling)
        data = prepare_sentences(encoder, config, token_ids, mask, style)
        assert data.hidden.shape == (12, 8, 16)  # cut to the longest sentence
        tuned = init_fine_tuning(encoder, config, 3)["encoder"]
        found = embed_hidden(tuned, ARCHITECTURE, config, data.hidden, data.mask)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_hidden_word_pieces_are_only_those_of_the_mask_and_never_the_first():
    mask = jnp.ones((400, 11), bool).at[:, 8:].set(False)
    hidden = hide_word_pieces(jax.random.key(0), mask, 0.25)
    assert not hidden[:, 8:].any()
    assert hidden[:, 0].all()
    np.testing.assert_allclose(hidden[:, 1:8].mean(), 0.75, atol=0.03)
    np.testing.assert_array_equal(hide_word_pieces(jax.random.key(0), mask, 0.0), mask)


def test_a_minibatch_holds_different_sentences_with_their_own_styles():
    rows = jnp.arange(12)
    data = SentenceData(hidden=rows * 1.0, mask=rows >= 0, style=rows)
    batch = make_fine_tuning(ARCHITECTURE, CONFIG)[1](jax.random.key(0), data)
    for style in batch.style:  # of one fine-tuning
        assert len(set(style.tolist())) == CONFIG.fine_tuning_batch
    assert set(batch.style[0].tolist()) != set(batch.style[1].tolist())
    np.testing.assert_array_equal(batch.hidden, batch.style)


def test_the_views_repeat_sentences_and_targets():
    encoder = small_encoder()
    token_ids, mask, style = small_sentences()
    sentences = prepare_sentences(encoder, CONFIG, token_ids, mask, style)
    tuned = init_fine_tuning(encoder, CONFIG, 3)
    data = prepare_translation(
        jax.random.key(1), tuned, ARCHITECTURE, CONFIG, sentences, FREQUENCIES
    )
    plain = embed_hidden(tuned["encoder"], ARCHITECTURE, CONFIG, sentences.hidden, sentences.mask)
    assert data.embedding.shape == (24, 16)
    np.testing.assert_allclose(data.embedding[:12], plain, atol=1e-5)
    assert float(jnp.abs(data.embedding[12:] - plain).max()) > 1e-3
    np.testing.assert_array_equal(data.frequencies[12:], FREQUENCIES[style])


# The whole.


def test_a_fitted_translator_gives_each_style_its_frequencies(translator):
    token_ids, mask, style = small_sentences()
    frequencies, logits = jax.jit(lambda t, i, m: t(i, m))(translator, token_ids, mask)
    assert frequencies.shape == (12, 3)
    assert logits.shape == (12, 3)
    assert 0 <= frequencies.min() <= frequencies.max() <= 1
    np.testing.assert_array_equal(logits.argmax(-1), style)
    assert np.abs(frequencies - FREQUENCIES[style]).mean() < 0.05


def test_translation_is_the_same_each_time_and_whatever_the_padding(translator):
    token_ids, mask, _ = small_sentences()
    config = translator.config
    first, _ = translate(translator.params, ARCHITECTURE, config, token_ids, mask)
    again, _ = translate(translator.params, ARCHITECTURE, config, token_ids, mask)
    short, _ = translate(translator.params, ARCHITECTURE, config, token_ids[:, :8], mask[:, :8])
    np.testing.assert_array_equal(first, again)
    np.testing.assert_allclose(first, short, atol=1e-5)


def test_only_the_chosen_layers_are_fine_tuned(translator):
    before = small_encoder().params["params"]
    after = translator.params["encoder"]
    same = {
        name: jax.tree.all(jax.tree.map(np.array_equal, before[name], after[name]))
        for name in before
    }
    assert {name for name, equal in same.items() if not equal} == {"layer_1", "layer_2"}


def test_the_style_logits_are_the_classifiers(translator):
    token_ids, mask, style = small_sentences()
    encoder = Encoder(params={"params": translator.params["encoder"]}, architecture=ARCHITECTURE)
    data = prepare_sentences(encoder, CONFIG, token_ids, mask, style)
    embedding = embed_hidden(encoder.params["params"], ARCHITECTURE, CONFIG, data.hidden, data.mask)
    expected = classify(translator.params["classifier"], embedding, CONFIG)
    np.testing.assert_allclose(translator(token_ids, mask)[1], expected, atol=1e-4)


# Input checks.


@pytest.fixture(scope="module")
def tokenizer():
    return load_tokenizer()


def test_token_ids_are_padded_and_masked(tokenizer):
    token_ids, mask = tokenize(tokenizer, ["Stay left.", "No onions for me, please."])
    assert token_ids.shape == mask.shape == (2, 40)
    assert token_ids.dtype == np.int32
    np.testing.assert_array_equal(mask.sum(-1), [5, 9])  # words, full stops, two markers
    assert (token_ids[~mask] == tokenizer.pad_token_id).all()
    assert (token_ids[:, 0] == tokenizer.cls_token_id).all()


@pytest.mark.parametrize("sentence", ["", "  \n\t"])
def test_a_blank_sentence_is_refused(tokenizer, sentence):
    with pytest.raises(ValueError, match="sentence 1 is blank"):
        tokenize(tokenizer, ["Stay left.", sentence])


def test_the_longest_sentence_passes_and_a_longer_one_is_refused(tokenizer):
    assert tokenize(tokenizer, ["left " * 38])[1].all()
    with pytest.raises(ValueError, match=r"41 word pieces .* maximum is 40"):
        tokenize(tokenizer, ["left " * 39])


def test_a_sentence_without_a_known_word_is_refused(tokenizer):
    with pytest.raises(ValueError, match="no word that the encoder knows"):
        tokenize(tokenizer, ["\U0001f345"])


@pytest.mark.parametrize("sentences", [[], "Stay left."])
def test_something_else_than_a_list_of_sentences_is_refused(tokenizer, sentences):
    with pytest.raises(ValueError, match="list of at least one sentence"):
        tokenize(tokenizer, sentences)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pooling": "max"}, "pooling must be"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\)"),
        ({"word_piece_dropout": -0.1}, "word_piece_dropout"),
        ({"classifier_rate": 0.5}, "classifier_rate must be at least 1"),
        ({"trainable_layers": 0}, "trainable_layers must be at least 1"),
        ({"views": 0}, "views must be at least 1"),
        ({"maximum_length": 2}, "maximum_length"),
        ({"kl_weight": -1.0}, "kl_weight"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        TranslatorConfig(**change)


def test_more_trainable_layers_than_layers_are_refused():
    config = dataclasses.replace(CONFIG, trainable_layers=4)
    with pytest.raises(ValueError, match="trainable_layers is 4, the encoder has only 3"):
        init_fine_tuning(small_encoder(), config, 3)


@pytest.mark.parametrize(
    ("frequencies", "message"),
    [(FREQUENCIES * 3, "normalised"), (FREQUENCIES * np.nan, "normalised"), (FREQUENCIES[:2], "2")],
)
def test_bad_frequencies_are_refused(frequencies, message):
    encoder = small_encoder()
    sentences = prepare_sentences(encoder, CONFIG, *small_sentences())
    tuned = init_fine_tuning(encoder, CONFIG, 3)
    with pytest.raises(ValueError, match=message):
        prepare_translation(jax.random.key(1), tuned, ARCHITECTURE, CONFIG, sentences, frequencies)
