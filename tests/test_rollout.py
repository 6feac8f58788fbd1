"""Whole games of a pair: nothing counts after a game's end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_game import ToyGame, always

from envs.base import Pair
from haland_jax import rollout


@pytest.fixture(scope="module")
def game():
    return ToyGame(ego_weight=1.0, partner_weight=10.0)


def policies(ego_action: int, partner_action: int):
    return always(ego_action, 3, 3), always(partner_action, 2, 4)


@pytest.mark.parametrize(("style", "length"), [("short", 3), ("long", 5)])
def test_returns_lengths_and_events_stop_with_the_game(game, style, length):
    played = rollout.play(game, jax.random.key(0), *policies(2, 1), game.style(style), num_games=4)
    np.testing.assert_array_equal(played.lengths, 4 * [length])
    np.testing.assert_array_equal(played.returns, 4 * [12.0 * length])
    # Event 0 counts steps, event 1 the player's own action.
    one = [[length, 2 * length], [length, length]]
    np.testing.assert_array_equal(played.events, 4 * [one])


def test_games_are_drawn_apart_and_by_the_key(game):
    even = {"params": {**always(0, 3, 3)["params"]}}
    even = jax.tree.map(jnp.zeros_like, even)
    partner = always(0, 2, 4)

    def returns(key):
        played = rollout.play(game, key, even, partner, game.style("long"), num_games=200)
        return np.asarray(played.returns)

    first = returns(jax.random.key(0))
    np.testing.assert_array_equal(first, returns(jax.random.key(0)))
    assert (first != returns(jax.random.key(1))).any()
    # Five draws from {0, 1, 2}: mean 5, variance 5 * 2 / 3; 200 games.
    assert abs(first.mean() - 5) < 4 * np.sqrt(10 / 3 / 200)
    assert first.var() == pytest.approx(10 / 3, rel=0.4)


def test_greedy_play_takes_the_most_probable_action(game):
    ego = always(0, 3, 3)
    ego["params"]["dense_2"]["bias"] = jnp.array([0.0, 0.1, 0.0])
    partner = always(0, 2, 4)
    style = game.style("long")
    greedy = rollout.play(game, jax.random.key(0), ego, partner, style, num_games=20, greedy=True)
    np.testing.assert_array_equal(greedy.returns, 5.0)
    sampled = rollout.play(game, jax.random.key(0), ego, partner, style, num_games=20)
    assert np.asarray(sampled.returns).std() > 0


@pytest.mark.parametrize(("style", "length"), [("short", 3), ("long", 5)])
def test_a_recording_holds_every_step_and_marks_the_end(game, style, length):
    kept = rollout.record(game, jax.random.key(0), *policies(1, 1), game.style(style))
    alive = np.arange(5) < length
    np.testing.assert_array_equal(kept.alive, alive)
    np.testing.assert_array_equal(kept.rewards, 11.0 * alive)
    np.testing.assert_array_equal(kept.states.time[:length], np.arange(length))
    np.testing.assert_array_equal(kept.actions.ego, 1)
    # The observation of a step is that of the state before it.
    np.testing.assert_allclose(kept.observations.ego[:length, 1], np.arange(length) / 5)
    assert kept.observations.partner.shape == (5, 4)


def test_both_players_draw_with_keys_of_their_own():
    even = Pair(jnp.zeros((1000, 2)), jnp.zeros((1000, 2)))
    ego, partner = rollout.draw_actions(jax.random.key(0), even)
    assert abs(np.mean(np.asarray(ego) == np.asarray(partner)) - 0.5) < 0.08


@pytest.mark.parametrize("games_each", [1, 3])
def test_visited_observations_are_of_games_that_are_on(game, games_each):
    visited = jax.jit(
        lambda key: rollout.visited_observations(
            game,
            key,
            always(1, 3, 3),
            jax.tree.map(lambda leaf: jnp.stack(4 * [leaf]), always(0, 2, 4)),
            game.style("short"),
            num_kept=200,
            games_each=games_each,
        )
    )(jax.random.key(0))
    assert visited.shape == (200, 3)
    # The short game is over after three steps: times 0, 1 and 2 of 5 are seen, and all of them.
    np.testing.assert_allclose(np.unique(np.asarray(visited[:, 1])), [0.0, 0.2, 0.4], atol=1e-6)
    seen = np.unique(np.asarray(visited[:, 2]))
    assert len(seen) == 4 * games_each, "states of all games are drawn"
