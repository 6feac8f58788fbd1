"""The gates against shares worked out by hand."""

import numpy as np
import pytest

from experiments import gates, summary
from experiments.judge import Scores, by_style

BOUNDS = (200.0, 100.0)
VAE = {"decoded_share": np.array([[0.97, 1.01]]), "perturbed_share": np.array([[0.94, 1.0]])}


def results(best, haland, wrong, oracle=((100.0, 200.0), (50.0, 0.0))):
    """Two styles, two held-out seeds; in the second style the last Oracle earns nothing."""
    returns = {
        summary.ORACLE: oracle,
        summary.BEST_RESPONSE: best,
        summary.HEADLINE: haland,
        summary.WRONG: wrong,
    }
    return {method: Scores(np.array(values), None) for method, values in returns.items()}


def test_shares_leave_out_partners_whose_oracle_earns_nothing():
    earned, oracle = np.array([[90.0, 150.0], [50.0, 7.0]]), np.array([[100.0, 200.0], [50.0, 0.0]])
    found = summary.shares(earned, oracle)
    np.testing.assert_allclose(found[0], [0.9, 0.75])
    assert found[1, 0] == 1.0
    assert np.isnan(found[1, 1])


def test_gates_hold_the_mean_share_and_the_lowest_style():
    best, haland = ((90.0, 150.0), (50.0, 0.0)), ((80.0, 200.0), (50.0, 0.0))
    found = gates.gates(results(best, haland, ((60.0, 120.0), (30.0, 0.0))), VAE, BOUNDS)
    # (0.9 + 0.75 + 1.0) / 3; the style with the lowest share earns 240 / 300 of its Oracles.
    assert found["best responses / Oracle, mean"]["value"] == pytest.approx(2.65 / 3)
    assert not found["best responses / Oracle, mean"]["met"]
    assert found["best responses / Oracle, lowest style"]["value"] == pytest.approx(0.8)
    assert found["best responses / Oracle, lowest style"]["met"]
    # The Oracles earn 150 of 200 and 25 of 100.
    assert found["Oracle / upper bound, lowest style"]["value"] == pytest.approx(0.25)
    assert not found["Oracle / upper bound, lowest style"]["met"]
    assert found["decoded / original policy, lowest"]["met"]
    assert not found["decoded / original policy, z perturbed, lowest"]["met"]
    assert found["Haland from test sentences / Oracle"]["value"] == pytest.approx(2.8 / 3)
    wrong = found["Haland from a wrong sentence / Oracle"]
    assert wrong["value"] == pytest.approx(0.6)
    assert wrong["at_most"]


def test_a_style_whose_oracles_lose_meets_no_bar():
    oracle = ((100.0, 200.0), (-30.0, 10.0))
    best = ((100.0, 200.0), (-900.0, 10.0))
    found = gates.gates(results(best, best, best, oracle), VAE, BOUNDS)
    assert found["best responses / Oracle, lowest style"]["value"] == 0
    assert found["best responses / Oracle, mean"]["value"] == pytest.approx(1.0)


def test_without_any_oracle_no_share_is_met_and_all_values_are_finite():
    nothing = np.zeros((2, 2))
    found = gates.gates(results(nothing, nothing, nothing, oracle=nothing), VAE, BOUNDS)
    assert found["Haland from test sentences / Oracle"] == {"value": 0.0, "bar": 0.9, "met": False}
    assert all(np.isfinite(gate["value"]) for gate in found.values())


def test_where_games_can_succeed_successes_are_held_against_the_oracles():
    returns = np.full((2, 2), 100.0)
    successes = {
        summary.ORACLE: [[1.0, 0.8], [0.6, 0.8]],
        summary.BEST_RESPONSE: [[1.0, 0.8], [0.6, 0.8]],
        summary.HEADLINE: [[1.0, 0.6], [0.6, 0.6]],
        summary.WRONG: [[0.0, 0.4], [0.3, 0.2]],
    }
    scores = {method: Scores(returns, np.array(values)) for method, values in successes.items()}
    found = gates.gates(scores, VAE, BOUNDS)
    assert "Oracle / upper bound, lowest style" not in found
    oracle = found["Oracle, games that succeed, lowest style"]
    assert oracle["value"] == pytest.approx(0.7)
    assert not oracle["met"]
    haland = found["Haland from test sentences / Oracle, games that succeed"]
    assert haland["value"] == pytest.approx((1.0 + 0.75 + 1.0 + 0.75) / 4)
    assert not haland["met"]
    wrong = found["Haland from a wrong sentence / Oracle, games that succeed"]
    assert wrong["value"] == pytest.approx((0.0 + 0.5 + 0.5 + 0.25) / 4)
    assert wrong["met"]


def test_scores_are_stored_by_style_and_only_what_was_measured():
    returns = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert list(by_style(Scores(returns, None), ("a", "b"))["a"]) == ["returns"]
    stored = by_style(Scores(returns, returns / 4), ("a", "b"))
    np.testing.assert_allclose(stored["b"]["successes"], [0.75, 1.0])
