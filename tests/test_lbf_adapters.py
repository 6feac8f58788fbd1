"""Spread in other packages' terms; the adapters themselves are tested in test_adapters.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import registry
from envs.adapters.jaxmarl import JaxMARLEnvironment
from envs.base import AGENTS
from envs.lbf import dynamics, scripted

MAX_STEPS = 12


@pytest.fixture(scope="module")
def environment():
    return registry.make("lbf/spread", max_steps=MAX_STEPS)


def scripted_actions(state, target) -> dict:
    return dict(zip(AGENTS, scripted.choose_actions(state, target), strict=True))


def test_jaxmarl_tells_a_win_from_time_that_is_up(environment):
    """The scripted pair wins game after game; then nobody moves until the time is up."""
    adapted = JaxMARLEnvironment(environment, ["level_3", "level_7"])
    targets = environment.styles.target

    def advance(state, inputs):
        key, idle = inputs
        actions = scripted_actions(state.inner, targets[state.style])
        actions = jax.tree.map(lambda action: jnp.where(idle, dynamics.NONE, action), actions)
        outcome = adapted.step(key, state, actions)
        return outcome[1], outcome

    def play(key):
        reset_key, scan_key = jax.random.split(key)
        idle = jnp.arange(10 * MAX_STEPS) >= 8 * MAX_STEPS
        keys = jax.random.split(scan_key, 10 * MAX_STEPS)
        return jax.lax.scan(advance, adapted.reset(reset_key)[1], (keys, idle))[1]

    outcomes = jax.tree.map(np.asarray, jax.jit(play)(jax.random.key(0)))
    observations, states, rewards, dones, infos = outcomes
    won = infos["terminated"]
    assert won[: 8 * MAX_STEPS].sum() >= 8
    assert not won[9 * MAX_STEPS :].any()
    assert infos["truncated"][8 * MAX_STEPS :].any()
    np.testing.assert_array_equal(rewards["ego"], won)
    np.testing.assert_array_equal(rewards["partner"], won)
    np.testing.assert_array_equal(dones["__all__"], won | infos["truncated"])
    assert set(states.style.tolist()) == {2, 6}
    for end in np.flatnonzero(dones["__all__"]):
        assert int(states.inner.time[end]) == 0
        fresh, terminal = observations["ego"][end], infos["terminal_observation"]["ego"][end]
        assert fresh[-1] == 1.0  # all the time is left
        assert terminal[-1] < 1.0
    assert len(np.unique(states.inner.food_place.reshape(-1, 16), axis=0)) > 8


@pytest.mark.parametrize("encoding", ["features", "grid"])
@pytest.mark.filterwarnings("error::UserWarning")
def test_pettingzoo_passes_the_packages_own_test(encoding):
    pytest.importorskip("pettingzoo")
    from pettingzoo.test import parallel_api_test

    from envs.adapters.pettingzoo import PettingZooEnvironment

    game = registry.make("lbf/spread", max_steps=MAX_STEPS, encoding=encoding)
    parallel_api_test(PettingZooEnvironment(game), num_cycles=2 * MAX_STEPS)


def test_pettingzoo_ends_a_won_game(environment):
    pytest.importorskip("pettingzoo")
    from envs.adapters.pettingzoo import PettingZooEnvironment

    parallel = PettingZooEnvironment(environment)
    observations, infos = parallel.reset(seed=3, options={"style": "level_8"})
    assert infos["partner"]["style"] == "level_8"
    assert observations["partner"][-8:].tolist() == [0] * 7 + [1]
    choose = jax.jit(scripted.choose_actions)
    returns = 0.0
    while parallel.agents:
        pair = choose(parallel._state, jnp.int32(8))
        actions = {agent: int(action) for agent, action in zip(AGENTS, pair, strict=True)}
        observations, rewards, terminated, truncated, infos = parallel.step(actions)
        returns += rewards["ego"]
        for agent in AGENTS:
            assert parallel.observation_space(agent).contains(observations[agent])
    assert returns == 1.0
    assert terminated == dict.fromkeys(AGENTS, True)
    assert truncated == dict.fromkeys(AGENTS, False)
    assert infos["ego"]["events"]["take_food_8"] == 1.0
