"""Live games side by side: the same as one by one, again from a recording, on after a crash."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Pair
from experiments.study.arena import Arena
from haland_jax.learner import make_networks

SEATS, STEPS = 3, 25


@pytest.fixture(scope="module", params=["overcooked/diverse_orders", "lbf/spread"])
def arena(request):
    env = envs.make(request.param)
    return Arena(env, SEATS, a_policy(env, 0))


def a_policy(env, seed):
    ego = make_networks(env)[0].ego
    params = ego.init(jax.random.key(seed), jnp.zeros(env.observation_sizes.ego))
    noise = jax.random.key(seed + 100)
    return jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(noise, leaf.shape), params)


def pressed(seed):
    """What a person does."""
    return np.random.default_rng(seed).integers(0, 6, STEPS)


def assert_same(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def at(states, index):
    return jax.tree.map(lambda leaf: leaf[index], states)


def play(arena, first, steps, people, seats=range(SEATS)):
    """Plays some steps; the egos' actions and the rewards, [steps, seat], and the last states."""
    playing = np.isin(np.arange(SEATS), list(seats))
    egos, rewards, states = [], [], None
    for step in range(first, first + steps):
        actions = np.array([people[seat][step] for seat in range(SEATS)], np.int32)
        played, states = arena.advance(actions, playing)
        egos.append(played.ego_action)
        rewards.append(played.reward)
    return np.array(egos), np.array(rewards), states


def test_every_seat_is_a_game_of_its_own_that_can_be_played_again(arena):
    people = [pressed(seat) for seat in range(SEATS)]
    starts = [arena.begin(s, a_policy(arena.env, s), s, seed=40 + s) for s in range(SEATS)]
    egos, rewards, states = play(arena, 0, STEPS, people)
    for seat in range(SEATS):
        again = arena.replay(seat, 40 + seat, Pair(egos[:, seat], people[seat]))
        assert_same(at(again.states, 0), starts[seat])
        assert_same(at(again.states, STEPS), at(states, seat))
        np.testing.assert_array_equal(again.rewards, rewards[:, seat])
    # Another neighbour changes nothing.
    arena.begin(0, a_policy(arena.env, 7), 5, seed=3)
    for seat in (1, 2):
        arena.begin(seat, a_policy(arena.env, seat), seat, seed=40 + seat)
    others = play(arena, 0, STEPS, people)
    np.testing.assert_array_equal(others[0][:, 1:], egos[:, 1:])
    assert (others[0][:, 0] != egos[:, 0]).any()


def test_a_game_goes_on_where_it_was(arena):
    people = [pressed(seat) for seat in range(SEATS)]
    for seat in range(SEATS):
        arena.begin(seat, a_policy(arena.env, seat), seat, seed=seat)
    egos, rewards, states = play(arena, 0, STEPS, people)
    broken = 11
    before = Pair(egos[:broken, 2], people[2][:broken])
    arena.resume(0, a_policy(arena.env, 2), 2, 2, before)  # on another seat, too
    moved = [people[2], people[1], people[2]]
    again = play(arena, broken, STEPS - broken, moved, seats=[0])
    np.testing.assert_array_equal(again[0][:, 0], egos[broken:, 2])
    np.testing.assert_array_equal(again[1][:, 0], rewards[broken:, 2])
    assert_same(at(again[2], 0), at(states, 2))


def test_seats_that_pause_do_not_move(arena):
    people = [pressed(seat) for seat in range(SEATS)]
    for seat in range(SEATS):
        arena.begin(seat, a_policy(arena.env, seat), seat, seed=seat)
    _, _, before = play(arena, 0, 3, people)
    egos, _, after = play(arena, 3, 4, people, seats=[1])
    assert_same(at(after, 0), at(before, 0))
    assert_same(at(after, 2), at(before, 2))
    straight = arena.replay(1, 1, Pair(np.zeros(0, int), np.zeros(0, int)))
    assert len(straight.rewards) == 0
    assert int(after.time[1]) == int(before.time[1]) + 4
    # What paused goes on as if it had not.
    arena.begin(0, a_policy(arena.env, 0), 0, seed=0)
    through, _, _ = play(arena, 0, 7, people, seats=[0])
    for seat in (0, 2):
        arena.begin(seat, a_policy(arena.env, seat), seat, seed=seat)
    first, _, _ = play(arena, 0, 3, people, seats=[0])
    play(arena, 3, 4, people, seats=[2])
    rest, _, _ = play(arena, 3, 4, people, seats=[0])
    np.testing.assert_array_equal(through[:, 0], np.concatenate([first, rest])[:, 0])
    assert egos.shape == (4, SEATS)


def test_an_arm_has_no_keys():
    env = envs.make("assistive/jaco")
    with pytest.raises(ValueError, match="has continuous actions, which no key stands for"):
        Arena(env, 2, None)
