"""`experiments.sentences`: a style told from wordings that were left out of the fine-tuning."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import sentences
from experiments.errors import UserError
from haland_jax.fit import FitConfig
from haland_jax.translator import SentenceData, prepare_sentences
from tests.test_translator import CONFIG, FREQUENCIES, small_encoder, small_sentences

QUICK = dataclasses.replace(CONFIG, fine_tuning=FitConfig(learning_rate=1e-2, steps=60))


def prepared() -> SentenceData:
    return prepare_sentences(small_encoder(), QUICK, *small_sentences())


def test_a_style_that_one_word_gives_away_is_told_from_sentences_left_out():
    found = sentences.cross_validate(small_encoder(), QUICK, prepared(), folds=4, seeds=2)
    assert found.probability.shape == (2, 12, 3)
    np.testing.assert_allclose(found.probability.sum(-1), 1.0, rtol=1e-5)
    # Nine sentences for an encoder that knows no language: it errs, but is far above 1 in 3.
    assert found.right.mean() >= 0.6


def test_sentences_left_out_are_translated_too():
    translated = sentences.cross_validate(
        small_encoder(), QUICK, prepared(), folds=4, seeds=1, v_hat=FREQUENCIES
    )
    plain = sentences.cross_validate(small_encoder(), QUICK, prepared(), folds=4, seeds=1)
    np.testing.assert_allclose(translated.probability, plain.probability, atol=1e-5)
    assert translated.classified_right.mean() == plain.right.mean()
    assert translated.right.mean() >= 0.6
    assert plain.translated is None


def test_whole_authors_may_be_left_out():
    # Of each style the first two sentences say it with another word than the others do.
    told = prepared()
    hidden = jnp.zeros_like(told.hidden)
    author = (jnp.arange(12) // 6)[:, None, None]
    says = jax.nn.one_hot(told.style, 3)[:, None] * jnp.where(author == 0, 1.0, -1.0)
    told = told.replace(hidden=hidden.at[:, 1:4, :3].add(5.0 * says))
    dealt, by_author = (
        sentences.cross_validate(small_encoder(), QUICK, told, folds=2, seeds=1, authors=authors)
        for authors in ((), (2, 2))
    )
    assert dealt.right.mean() == 1.0
    assert by_author.right.mean() < 0.7


def test_others_sentences_may_be_asked():
    told = prepared()
    learnt, asked = (
        jax.tree.map(lambda leaf, rows=rows: leaf[rows], told)
        for rows in (np.arange(9), np.arange(9, 12))
    )
    found = sentences.ask(small_encoder(), QUICK, learnt, asked, seeds=2, v_hat=FREQUENCIES)
    assert found.right.shape == (2, 3)
    np.testing.assert_array_equal(found.style, asked.style)
    again = sentences.ask(small_encoder(), QUICK, told, learnt, seeds=1)
    assert again.right.mean() >= 0.9  # It has learnt these.


def test_a_file_that_is_asked_may_lack_styles(tmp_path):
    file = tmp_path / "said.toml"
    file.write_text('level_2 = ["Only the second smallest for me."]\n')
    short = dataclasses.replace(
        sentences.TranslatorConfig(),
        fine_tuning=FitConfig(learning_rate=1e-4, steps=2),
        maximum_length=60,
    )
    arguments = sentences.Arguments("lbf/spread", asked=file, translator=short)
    found = sentences.run(arguments)
    assert found.style.tolist() == [1]
    console = sentences.Console(width=120, record=True)
    sentences.print_left_out(console, arguments, found)
    printed = console.export_text()
    assert "level_2" in printed
    assert "level_3 " not in printed
    file.write_text('level_9 = ["Any."]\n')
    with pytest.raises(UserError, match="level_9"):
        sentences.run(arguments)


def test_a_record_of_another_environment_is_refused():
    record = Path(__file__).parents[1] / "docs/comparisons/lbf/spread"
    with pytest.raises(
        UserError, match=r"is of lbf/spread with .*; expected overcooked/crossway and"
    ):
        sentences.run(sentences.Arguments("overcooked/crossway", record=record))


def test_labels_without_meaning_are_told_no_better_than_by_chance():
    # A style's wordings are the same as all others': whatever was learnt says nothing of the rest.
    told = prepared()
    same = told.replace(
        hidden=jnp.broadcast_to(told.hidden[:1], told.hidden.shape),
        mask=jnp.broadcast_to(told.mask[:1], told.mask.shape),
    )
    found = sentences.cross_validate(small_encoder(), QUICK, same, folds=2, seeds=1)
    assert found.right.mean() == pytest.approx(1 / 3)
    assert found.negative_log_likelihood > 0.9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"folds": 1}, "folds is 1; expected 2 to 4"),
        ({"folds": 5}, "folds is 5; expected 2 to 4"),
        ({"seeds": 0}, "seeds is 0; expected at least 1"),
        ({"authors": (4,)}, "authors is 1; expected 2 to 4"),
        ({"authors": (1, 2)}, "authors wrote 3 sentences of a style; expected 4"),
    ],
)
def test_bad_numbers_are_refused(change, message):
    numbers = {"folds": 2, "seeds": 1} | change
    with pytest.raises(UserError, match=message):
        sentences.cross_validate(small_encoder(), QUICK, prepared(), **numbers)


def test_an_unknown_environment_is_refused():
    with pytest.raises(UserError, match="overcooked/kitchen"):
        sentences.run(sentences.Arguments("overcooked/kitchen"))


def test_the_packaged_sentences_are_cross_validated(capsys):
    short = dataclasses.replace(
        sentences.TranslatorConfig(),
        fine_tunings=1,
        fine_tuning=FitConfig(learning_rate=1e-4, steps=16),
        translation=FitConfig(learning_rate=1e-3, steps=20),
        views=1,
    )
    record = Path(__file__).parents[1] / "docs/comparisons/assistive/jaco"
    arguments = sentences.Arguments("assistive/jaco", folds=2, translator=short, record=record)
    found = sentences.run(arguments)
    assert found.right.shape == (1, 320)
    assert found.classified_right.mean() > 0.5  # by chance 0.125
    assert found.right.mean() > 0.3
    sentences.print_left_out(sentences.Console(width=120), arguments, found)
    printed = capsys.readouterr().out
    assert f"Told right by the translation: {found.right.mean():.3f}." in printed
    assert f"Told right by the classifier: {found.classified_right.mean():.3f} of 320" in printed
    assert "scratch_upper_arm" in printed
    assert printed.count("is taken for") == (~found.right).sum()
