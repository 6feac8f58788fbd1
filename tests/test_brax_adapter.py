"""A continuous environment as one of Brax, through Brax's own wrappers."""

import jax
import numpy as np
import pytest
from brax.envs.wrappers import training
from toy_game import ToyGame
from toy_reach import ToyReach

from envs.adapters.brax import BraxEnvironment, wrap
from envs.base import Pair

GAMES, LENGTH, STEPS = 2, 3, 5
"""Games of three steps, played for five."""


@pytest.fixture(scope="module")
def env():
    return ToyReach()


@pytest.fixture(scope="module")
def played(env):
    """The same games twice: by Brax's wrappers, and by our own environment."""
    adapted = BraxEnvironment(env, "high", lambda key, seen: seen[2:] / 2)
    wrapped = training.wrap(adapted, episode_length=LENGTH)
    actions = jax.random.uniform(jax.random.key(1), (STEPS, GAMES, 2), minval=-1, maxval=1)
    starts = jax.random.split(jax.random.PRNGKey(0), GAMES)  # Brax knows no other keys

    def through_brax(keys):
        state = wrapped.reset(keys)
        return state, jax.lax.scan(lambda s, a: (wrapped.step(s, a),) * 2, state, actions)[1]

    def directly(key, actions):
        style = env.style("high")
        first = env.reset(jax.random.split(key)[0], style)

        def one_step(carry, action):
            state, before = carry
            partner = before.observation.partner[2:] / 2
            after = env.step(key, state, Pair(action, partner), style)
            return after, after[1]

        return first[1], jax.lax.scan(one_step, first, actions)[1]

    both = jax.jit(
        lambda keys: (through_brax(keys), jax.vmap(directly, in_axes=(0, 1))(keys, actions))
    )
    return jax.tree.map(np.asarray, both(starts))


def test_brax_s_games_are_ours(played):
    (start, brax), (first, ours) = played
    np.testing.assert_allclose(start.obs, first.observation.ego, atol=1e-6)
    # Until the game ends; after that Brax's wrapper starts it anew.
    np.testing.assert_allclose(
        brax.obs[: LENGTH - 1], ours.observation.ego.swapaxes(0, 1)[: LENGTH - 1], atol=1e-5
    )
    np.testing.assert_allclose(brax.reward[:LENGTH], ours.reward.T[:LENGTH], atol=1e-5)
    assert np.abs(ours.reward).min() > 0


def test_games_end_with_their_length_and_start_again(played):
    (start, brax), _ = played
    np.testing.assert_array_equal(brax.done[:, 0], [0, 0, 1, 0, 0])
    np.testing.assert_array_equal(brax.info["truncation"][LENGTH - 1], 1)
    np.testing.assert_allclose(brax.obs[LENGTH - 1], start.obs, atol=1e-6)


def test_metrics_are_the_ego_s_events(env, played):
    (_, brax), (_, ours) = played
    assert set(env.event_names) <= set(brax.metrics)
    for number, name in enumerate(env.event_names):
        counted = ours.events[:, :LENGTH, 0, number].T
        np.testing.assert_array_equal(brax.metrics[name][:LENGTH], counted)


def test_sizes_are_the_ego_s(env):
    adapted = BraxEnvironment(env, "high")
    assert adapted.observation_size == env.observation_sizes.ego
    assert adapted.action_size == 2
    assert adapted.backend == "mjx"


def test_discrete_actions_and_an_unknown_style_are_refused(env):
    with pytest.raises(ValueError, match="toy has discrete actions; expected an env"):
        BraxEnvironment(ToyGame(), "short")
    with pytest.raises(ValueError, match="middle"):
        BraxEnvironment(env, "middle")


def test_every_game_has_a_start_of_its_own(env):
    adapted = BraxEnvironment(env, "high")
    starts = jax.random.split(jax.random.PRNGKey(0), GAMES)
    numbers = {}
    for name, wrapped in (
        ("brax", training.wrap(adapted, episode_length=LENGTH)),
        ("ours", wrap(adapted, episode_length=LENGTH)),
    ):
        state = jax.jit(wrapped.reset)(starts)
        step, seen, dones = jax.jit(wrapped.step), [state.obs], [np.zeros(GAMES)]
        for _ in range(2 * LENGTH):
            state = step(state, jax.numpy.zeros((GAMES, 2)))
            seen.append(state.obs)
            dones.append(state.done)
        # A game's drawn number, in its first and last moment; three games in a row.
        drawn = np.asarray(seen)[:, :, 1]
        np.testing.assert_array_equal(drawn[0], drawn[LENGTH - 1])
        np.testing.assert_array_equal(drawn[LENGTH], drawn[2 * LENGTH - 1])
        np.testing.assert_array_equal(np.asarray(dones)[LENGTH], 1)
        assert np.asarray(dones).sum() == 2 * GAMES
        numbers[name] = drawn[::LENGTH]
    np.testing.assert_array_equal(numbers["brax"][0], numbers["brax"][1])
    assert len(np.unique(numbers["ours"])) == 3 * GAMES


def test_randomised_systems_are_refused(env):
    with pytest.raises(ValueError, match="randomization_fn is given; expected None"):
        wrap(BraxEnvironment(env, "high"), randomization_fn=lambda system: system)
