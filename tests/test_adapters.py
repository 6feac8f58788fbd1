"""The adapters: the same game, in other packages' terms."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_reach import ToyReach

from envs import registry
from envs.adapters.jaxmarl import JaxMARLEnvironment
from envs.base import AGENTS, Pair
from envs.overcooked import dynamics

MAX_STEPS = 60


@pytest.fixture(scope="module")
def environment():
    return registry.make("overcooked/diverse_orders", max_steps=MAX_STEPS)


@pytest.fixture(scope="module")
def adapted(environment):
    return JaxMARLEnvironment(environment)


def play(adapted, key, num_steps):
    """Plays random actions; returns the start, what each step returned, and the actions."""
    reset_key, scan_key = jax.random.split(key)
    observation, state = adapted.reset(reset_key)

    def advance(state, key):
        action_key, step_key = jax.random.split(key)
        keys = dict(zip(AGENTS, jax.random.split(action_key), strict=True))
        actions = {agent: adapted.action_space(agent).sample(keys[agent]) for agent in AGENTS}
        outcome = adapted.step(step_key, state, actions)
        return outcome[1], (outcome, actions)

    _, (outcomes, actions) = jax.lax.scan(advance, state, jax.random.split(scan_key, num_steps))
    return observation, state, outcomes, actions


@pytest.fixture(scope="module")
def recording(adapted):
    return jax.jit(lambda key: play(adapted, key, 2 * MAX_STEPS + 5))(jax.random.key(3))


def test_jaxmarl_steps_equal_the_environment(environment, adapted, recording):
    first, start, (observations, states, rewards, _, infos), actions = recording
    style = environment.style(environment.style_names[int(start.style)])
    state, timestep = environment.reset(jax.random.key(0), style)
    np.testing.assert_array_equal(first["partner"], timestep.observation.partner)
    step = jax.jit(environment.step)
    for t in range(MAX_STEPS):
        pair = Pair(actions["ego"][t], actions["partner"][t])
        state, timestep = step(jax.random.key(0), state, pair, style)
        seen = infos["terminal_observation"]
        for index, agent in enumerate(AGENTS):
            np.testing.assert_array_equal(seen[agent][t], timestep.observation[index])
            assert float(rewards[agent][t]) == float(timestep.reward)
            shaped = float(infos["shaped_reward"][agent][t])
            assert shaped == pytest.approx(float(timestep.shaped_reward[index]))
        np.testing.assert_array_equal(infos["events"][t], timestep.events)
        if t < MAX_STEPS - 1:
            np.testing.assert_array_equal(observations["ego"][t], timestep.observation.ego)
            assert int(states.step[t]) == t + 1


def test_jaxmarl_resets_by_itself_and_keeps_the_terminal_observation(environment, recording):
    _, _, (observations, states, _, dones, infos), _ = recording
    ends = np.flatnonzero(dones["__all__"])
    assert ends.tolist() == [MAX_STEPS - 1, 2 * MAX_STEPS - 1]
    for agent in AGENTS:
        np.testing.assert_array_equal(dones[agent], dones["__all__"])
    np.testing.assert_array_equal(infos["truncated"], dones["__all__"])
    assert not np.any(infos["terminated"])
    for end in ends:
        style = environment.style(environment.style_names[int(states.style[end])])
        fresh = environment.reset(jax.random.key(0), style)[1].observation
        for index, agent in enumerate(AGENTS):
            np.testing.assert_array_equal(observations[agent][end], fresh[index])
            terminal = infos["terminal_observation"][agent][end]
            assert np.any(np.asarray(terminal) != np.asarray(observations[agent][end]))
        assert int(states.step[end]) == 0
        assert not bool(states.done[end])


def test_jaxmarl_spaces_describe_observations_and_actions(environment, adapted, recording):
    first, state, (observations, *_), actions = recording
    assert adapted.agents == ["ego", "partner"]
    assert adapted.num_agents == 2
    assert adapted.name == "overcooked/diverse_orders"
    for index, agent in enumerate(AGENTS):
        space = adapted.observation_space(agent)
        assert space.shape == (environment.observation_sizes[index],) == first[agent].shape
        assert space.dtype == first[agent].dtype
        assert bool(space.contains(observations[agent][0]))
        assert not bool(space.contains(jnp.zeros(3)))
        assert adapted.action_space(agent).n == 6
        assert set(np.unique(actions[agent])) == set(range(6))
        assert bool(adapted.action_space(agent).contains(jnp.int32(5)))
        assert not bool(adapted.action_space(agent).contains(jnp.int32(6)))
        assert adapted.get_avail_actions(state)[agent].shape == (6,)
        np.testing.assert_array_equal(adapted.get_obs(state)[agent], first[agent])


def test_jaxmarl_draws_only_the_wanted_styles(environment):
    two = JaxMARLEnvironment(environment, ["onion_2", "tomato_4"])
    _, states = jax.vmap(two.reset)(jax.random.split(jax.random.key(1), 64))
    drawn = {environment.style_names[int(index)] for index in states.style}
    assert drawn == {"onion_2", "tomato_4"}
    with pytest.raises(ValueError, match=r"toy_reach has continuous actions; expected .* discrete"):
        JaxMARLEnvironment(ToyReach())
    with pytest.raises(ValueError, match="expected one or more of"):
        JaxMARLEnvironment(environment, ["soup_9"])
    with pytest.raises(ValueError, match="expected one or more of"):
        JaxMARLEnvironment(environment, [])


def test_jaxmarl_starts_from_a_given_reset_state(adapted):
    _, start = adapted.reset(jax.random.key(0))
    _, wanted = adapted.reset(jax.random.key(5))
    late = start.replace(inner=start.inner.replace(time=jnp.int32(MAX_STEPS - 1)))
    stay = dict.fromkeys(AGENTS, jnp.int32(dynamics.STAY))
    observation, state, _, dones, _ = adapted.step(jax.random.key(1), late, stay, wanted)
    assert bool(dones["__all__"])
    for got, expected in zip(jax.tree.leaves(state), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(observation["ego"], wanted.observation["ego"])


def test_jaxmarl_interface_against_the_package(adapted):
    multi_agent_env = pytest.importorskip("jaxmarl.environments.multi_agent_env")
    theirs = multi_agent_env.MultiAgentEnv
    wanted = {name for name in vars(theirs(2)) | vars(theirs) if not name.startswith("_")}
    assert {"reset", "step", "get_obs", "observation_space", "agents"} <= wanted
    assert wanted <= set(dir(adapted))
    for name in ("reset", "step", "step_env", "get_obs", "get_avail_actions"):
        ours = list(inspect.signature(getattr(JaxMARLEnvironment, name)).parameters)
        assert ours == list(inspect.signature(getattr(theirs, name)).parameters)


def test_jaxmarl_log_wrapper_counts_episodes(adapted):
    wrappers = pytest.importorskip("jaxmarl.wrappers.baselines", exc_type=ImportError)
    logged = wrappers.LogWrapper(adapted)
    _, state = logged.reset(jax.random.key(0))
    stay = dict.fromkeys(AGENTS, jnp.int32(dynamics.STAY))
    for _ in range(MAX_STEPS):
        _, state, _, _, infos = logged.step(jax.random.key(1), state, stay)
    assert np.asarray(infos["returned_episode"]).all()
    assert np.asarray(infos["returned_episode_lengths"]).tolist() == [MAX_STEPS] * 2


@pytest.fixture
def parallel(environment):
    pytest.importorskip("pettingzoo")
    from envs.adapters.pettingzoo import PettingZooEnvironment

    return PettingZooEnvironment(environment, render_mode="rgb_array")


@pytest.mark.filterwarnings("error::UserWarning")
def test_pettingzoo_passes_the_packages_own_test(parallel):
    from pettingzoo.test import parallel_api_test

    parallel_api_test(parallel, num_cycles=2 * MAX_STEPS)


def test_pettingzoo_steps_equal_the_environment(environment, parallel):
    observations, infos = parallel.reset(seed=7, options={"style": "tomato_3"})
    assert infos["partner"]["style"] == "tomato_3"
    assert "style" not in infos["ego"]
    style = environment.style("tomato_3")
    state, timestep = environment.reset(jax.random.key(0), style)
    step = jax.jit(environment.step)
    random = np.random.default_rng(0)
    events_seen = 0.0
    for t in range(MAX_STEPS):
        for index, agent in enumerate(AGENTS):
            np.testing.assert_array_equal(observations[agent], timestep.observation[index])
            assert parallel.observation_space(agent).contains(observations[agent])
        actions = {agent: int(random.integers(6)) for agent in AGENTS}
        assert parallel.agents == ["ego", "partner"]
        observations, rewards, terminated, truncated, infos = parallel.step(actions)
        state, timestep = step(jax.random.key(0), state, Pair(**actions), style)
        assert rewards == dict.fromkeys(AGENTS, float(timestep.reward))
        assert terminated == dict.fromkeys(AGENTS, False)
        assert truncated == dict.fromkeys(AGENTS, t == MAX_STEPS - 1)
        for index, agent in enumerate(AGENTS):
            counts = dict.fromkeys(environment.event_names, 0.0) | infos[agent]["events"]
            np.testing.assert_array_equal(list(counts.values()), timestep.events[index])
            events_seen += sum(counts.values())
    assert events_seen > 0
    assert parallel.agents == []
    with pytest.raises(RuntimeError, match="call reset first"):
        parallel.step(actions)


def test_pettingzoo_seeds_repeat_the_styles(parallel):
    def styles(seed):
        names = [parallel.reset(seed=seed)[1]["partner"]["style"]]
        return names + [parallel.reset()[1]["partner"]["style"] for _ in range(5)]

    assert styles(1) == styles(1)
    assert len(set(styles(1) + styles(2))) > 2


def test_pettingzoo_renders_the_moment(parallel):
    with pytest.raises(RuntimeError, match="nothing to render"):
        parallel.render()
    parallel.reset(seed=0)
    before = parallel.render()
    assert before.dtype == np.uint8
    assert before.shape[1:] == (9 * 64, 3)
    parallel.step({"ego": dynamics.STAY, "partner": 2})
    assert np.any(parallel.render() != before)


def test_pettingzoo_renders_any_environment_with_a_viewer():
    pytest.importorskip("pettingzoo")
    from envs.adapters.pettingzoo import PettingZooEnvironment

    field = PettingZooEnvironment(registry.make("lbf/spread"), render_mode="rgb_array")
    field.reset(seed=0)
    assert field.render().shape[1:] == (9 * 64, 3)


def test_pettingzoo_refuses_wrong_arguments(environment, parallel):
    from envs.adapters.pettingzoo import PettingZooEnvironment

    parallel.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions\['partner'\] must be"):
        parallel.step({"ego": 0})
    with pytest.raises(ValueError, match=r"actions\['ego'\] must be"):
        parallel.step({"ego": 6, "partner": 0})
    with pytest.raises(ValueError, match="unknown style"):
        parallel.reset(options={"style": "nobody"})
    with pytest.raises(ValueError, match="render_mode"):
        PettingZooEnvironment(environment, render_mode="human")
    with pytest.raises(ValueError, match=r"toy_reach has continuous actions; expected .* discrete"):
        PettingZooEnvironment(ToyReach())
    with pytest.raises(ValueError, match="expected one or more of"):
        PettingZooEnvironment(environment, [])
    assert PettingZooEnvironment(environment).render() is None
