"""Interquartile means by hand, and intervals that hold what they promise."""

import numpy as np
import pytest

from experiments import intervals


def test_the_interquartile_mean_leaves_out_a_quarter_on_each_side():
    assert intervals.interquartile_mean(np.array([100.0, 1, 2, 3, 4, 5, 6, -100])) == 3.5
    scores = np.array([[0.0, 1, 2, 100], [4, 4, 4, 4]])
    np.testing.assert_allclose(intervals.interquartile_mean(scores, axis=1), [1.5, 4.0])
    assert intervals.interquartile_mean(np.array([1.0, 2.0, 9.0])) == 4.0  # nothing to leave out


def test_styles_are_strata():
    """Seeds that agree leave nothing uncertain, however much the styles differ."""
    scores = np.repeat([[0.1], [0.5], [0.9]], 4, axis=1)
    found = intervals.mean_estimate(scores)
    assert found == pytest.approx((0.5, 0.5, 0.5))
    noisy = intervals.mean_estimate(scores + np.array([-0.1, 0.1, -0.1, 0.1]))
    assert noisy.low < 0.5 < noisy.high
    # Deviation of a style's mean sqrt(0.04 / 3 / 4), of three styles' mean 0.0333; t has 9 degrees.
    assert noisy.high - noisy.low == pytest.approx(2 * 2.262 * 0.0333, rel=0.15)


@pytest.mark.parametrize(("styles", "seeds"), [(6, 20), (8, 3), (8, 2)])
def test_an_interval_holds_the_truth_as_often_as_it_says(styles, seeds):
    """Of 400 intervals 380; the deviation of that count is 4.4."""
    rng = np.random.default_rng(3)
    truth = np.linspace(0, 1, styles)
    held = 0
    for trial in range(400):
        scores = truth[:, None] + rng.normal(0, 0.2, (styles, seeds))
        found = intervals.mean_estimate(scores, seed=trial)
        held += found.low <= truth.mean() <= found.high
    assert 364 <= held <= 392


def test_scores_that_are_missing_are_left_out():
    whole = intervals.estimate(np.array([[1.0, 2.0, 3.0]]))
    holed = intervals.estimate(np.array([[1.0, np.nan, 2.0, 3.0], [np.nan] * 4]))
    assert whole == holed
    with pytest.raises(ValueError, match="there are no scores"):
        intervals.estimate(np.array([[np.nan]]))


def test_intervals_overlap_where_they_share_a_point():
    one = intervals.Estimate(0.5, 0.4, 0.6)
    assert one.overlaps(intervals.Estimate(0.7, 0.6, 0.8))
    assert intervals.Estimate(0.5, 0.0, 1.0).overlaps(one)
    assert not one.overlaps(intervals.Estimate(0.8, 0.7, 0.9))
