"""Event frequencies, Eq. 8, interpolation between bins, label encodings: worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization

from haland_jax.task_language import (
    agent_event_names,
    build_label_language,
    build_task_language,
    drawn_to_styles,
    event_frequencies,
    jittered,
    nearest_style,
    neighbouring_tokens,
    sinusoidal_labels,
    token_ids,
)


def test_frequencies_are_events_a_step_over_all_episodes():
    # One style, one seed, two episodes of 10 and 30 steps, two agents, two events.
    counts = np.array([[[[[1, 0], [2, 4]], [[3, 0], [0, 4]]]]])
    frequencies = event_frequencies(counts, np.array([[[10, 30]]]))
    np.testing.assert_allclose(frequencies, [[[4 / 40, 0, 2 / 40, 8 / 40]]], rtol=1e-6)
    assert agent_event_names(("a", "b")) == ("ego:a", "ego:b", "partner:a", "partner:b")


def test_frequencies_without_an_episode_axis():
    counts = np.array([[[[5, 1]], [[0, 2]]]])
    frequencies = event_frequencies(counts, 20)
    np.testing.assert_allclose(frequencies, [[[0.25, 0.05], [0.0, 0.1]]], rtol=1e-6)


def test_unseen_events_are_dropped_and_the_rest_divided_by_the_largest():
    frequencies = np.array(
        [
            [[0.2, 0.0, 0.0], [0.4, 0.0, 0.0]],  # style 0: means 0.3, 0, 0
            [[0.1, 0.0, 0.5], [0.2, 0.0, 0.0]],  # style 1: means 0.15, 0, 0.25
        ]
    )
    language = build_task_language(frequencies, ("stir", "never", "serve"))
    assert language.event_names == ("stir", "serve")
    assert language.dropped_event_names == ("never",)
    np.testing.assert_allclose(language.scale, [0.3, 0.25], rtol=1e-6)
    np.testing.assert_allclose(language.v_hat, [[1.0, 0.0], [0.5, 1.0]], rtol=1e-6)
    by_seed = [[[2 / 3, 0.0], [1.0, 0.0]], [[1 / 3, 1.0], [2 / 3, 0.0]]]
    np.testing.assert_allclose(language.v_hat_by_seed, by_seed, rtol=1e-6)


def test_an_event_of_a_single_seed_is_kept():
    frequencies = np.zeros((2, 3, 2))
    frequencies[1, 2, 0] = 0.01
    frequencies[:, :, 1] = 0.1
    assert build_task_language(frequencies, ("rare", "usual")).event_names == ("rare", "usual")


def test_tokens_of_equation_8():
    v_hat = jnp.array([[0.0, 0.05, 0.1, 0.55, 0.999, 1.0], [1.2, -0.3, 0.31, 0.7, 0.89, 0.5]])
    within = np.array([[0, 0, 1, 5, 9, 9], [9, 0, 3, 7, 8, 5]])
    expected = within + 10 * np.arange(6)
    np.testing.assert_array_equal(token_ids(v_hat), expected)
    assert token_ids(v_hat).dtype == jnp.int32


def test_tokens_of_other_dimensions_and_bins_never_collide():
    ids = token_ids(jnp.array([[k / 4 + 0.1] * 3 for k in range(4)]), bins=4)
    assert sorted(np.asarray(ids).ravel().tolist()) == list(range(12))


def test_interpolation_between_neighbouring_bins():
    v_hat = jnp.array([0.02, 0.05, 0.11, 0.25, 0.97, 1.0])
    lower, upper, weight = neighbouring_tokens(v_hat)
    offset = 10 * np.arange(6)
    # (v - 0.05) / 0.1 = -0.3, 0, 0.6, 2, 9.2, 9.5; clipped to [0, 9]
    np.testing.assert_array_equal(lower, np.array([0, 0, 0, 2, 8, 8]) + offset)
    np.testing.assert_array_equal(upper, np.asarray(lower) + 1)
    np.testing.assert_allclose(weight, [0.0, 0.0, 0.6, 0.0, 1.0, 1.0], atol=2e-6)


def test_at_a_centre_interpolation_selects_the_token_of_equation_8():
    centres = (jnp.arange(10) + 0.5) / 10
    lower, upper, weight = neighbouring_tokens(centres)
    selected = np.where(np.asarray(weight) > 0.5, upper, lower)
    np.testing.assert_array_equal(selected, token_ids(centres))
    np.testing.assert_allclose(np.abs(np.asarray(weight) - np.round(weight)), 0.0, atol=1e-5)


def test_nearest_style():
    styles = jnp.array([[0.0, 1.0], [1.0, 0.0], [0.5, 0.5]])
    queries = jnp.array([[0.1, 0.8], [0.9, 0.3], [0.6, 0.5]])
    np.testing.assert_array_equal(nearest_style(queries, styles), [0, 1, 2])
    assert int(nearest_style(queries[1], styles)) == 1


def test_translations_are_drawn_to_the_styles_by_hand():
    # The two styles that are most alike are 3 apart: the error's standard deviation is 1.
    styles = jnp.array([[0.0, 0.0], [3.0, 0.0], [0.0, 9.0]])
    drawn = np.asarray(drawn_to_styles(jnp.array([[1.0, 0.0], [0.2, -0.1], [1.5, 0.0]]), styles))
    # Squared distances 1 and 4 from the first two; the third is too far to count.
    weight = np.exp(-2.0) / (np.exp(-0.5) + np.exp(-2.0))
    np.testing.assert_allclose(drawn[0], [3.0 * weight, 0.0], atol=1e-5)
    np.testing.assert_allclose(drawn[1], [0.0, 0.0], atol=0.06)
    np.testing.assert_allclose(drawn[2], [1.5, 0.0], atol=1e-5)  # No guess where it is even.
    np.testing.assert_allclose(drawn_to_styles(styles, styles), styles, atol=0.04)
    np.testing.assert_array_equal(
        drawn_to_styles(jnp.array([[0.5, 0.4]]), jnp.ones((2, 2))), jnp.ones((1, 2))
    )


def test_sinusoidal_labels_by_hand():
    encodings = sinusoidal_labels(3, 4, 100.0)
    # Frequencies 1 and 100^(-1/2) = 0.1.
    expected = [[np.sin(k), np.sin(0.1 * k), np.cos(k), np.cos(0.1 * k)] for k in range(3)]
    np.testing.assert_allclose(encodings, expected, atol=1e-6)
    with pytest.raises(ValueError, match="even"):
        sinusoidal_labels(3, 5, 100.0)


def test_label_language_tells_all_styles_apart():
    language = build_label_language(8, 5, features=32)
    v_hat = np.asarray(language.v_hat)
    assert v_hat.shape == (8, 32)
    assert v_hat.min() >= 0
    assert v_hat.max() <= 1
    assert len(language.event_names) == len(set(language.event_names)) == 32
    np.testing.assert_array_equal(language.v_hat_by_seed[:, 3], v_hat)
    assert len({tuple(ids) for ids in np.asarray(token_ids(language.v_hat))}) == 8
    distance = np.linalg.norm(v_hat[:, None] - v_hat[None], axis=-1) + 9 * np.eye(8)
    assert distance.min() > 0.5


def test_jitter_is_bounded_and_clipped():
    v_hat = jnp.array([0.0, 0.5, 1.0] * 200)
    moved = np.asarray(jittered(jax.random.key(0), v_hat, 0.03))
    assert np.abs(moved - v_hat).max() <= 0.03 + 1e-6
    assert np.abs(moved - v_hat)[1::3].max() > 0.02
    assert moved.min() >= 0
    assert moved.max() <= 1


def test_task_language_survives_serialization():
    language = build_task_language(np.random.default_rng(0).uniform(size=(3, 2, 4)), "abcd")
    blank = jax.tree.map(jnp.zeros_like, language)
    restored = serialization.from_bytes(blank, serialization.to_bytes(language))
    np.testing.assert_array_equal(restored.v_hat, language.v_hat)
    assert restored.event_names == ("a", "b", "c", "d")


@pytest.mark.parametrize(
    ("frequencies", "message"),
    [
        (np.zeros((2, 2, 3)), "all zero"),
        (-np.ones((2, 2, 3)), "negative"),
        (np.full((2, 2, 3), np.nan), "non-finite"),
        (np.ones((2, 2, 4)), "names"),
    ],
)
def test_bad_frequencies_are_refused(frequencies, message):
    with pytest.raises(ValueError, match=message):
        build_task_language(frequencies, ("a", "b", "c"))


def test_bad_counts_are_refused():
    with pytest.raises(ValueError, match="shape"):
        event_frequencies(np.ones((2, 2, 2)), 10)
    with pytest.raises(ValueError, match="steps"):
        event_frequencies(np.ones((2, 2, 2, 2)), 0)
    with pytest.raises(ValueError, match="negative"):
        event_frequencies(-np.ones((2, 2, 2, 2)), 10)
