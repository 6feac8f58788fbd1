"""The benchmark's loops play what they claim to play; speeds are not tested."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Pair
from experiments import benchmark, benchmark_ppo, contenders
from experiments.configs import PRESETS
from haland_jax.ppo import PPOConfig


def test_our_games_restart_after_400_steps():
    contender = contenders.our_games("cramped_room", "features")
    start = contender.start(jax.random.key(1), 3)
    advance = jax.jit(lambda carried, keys: jax.lax.scan(contender.advance, carried, keys)[0])
    (state, observation) = advance(start, jax.random.split(jax.random.key(2), 400))
    np.testing.assert_array_equal(state.time, 0)
    jax.tree.map(np.testing.assert_array_equal, observation, start[1])
    (state, observation) = advance((state, observation), jax.random.split(jax.random.key(2), 399))
    np.testing.assert_array_equal(state.time, 399)
    assert (np.asarray(observation.ego) != start[1].ego).any()


def test_our_loop_is_the_environment_with_random_actions():
    contender = contenders.our_games("cramped_room", "grid")
    env = envs.make("overcooked/cramped_room", encoding="grid")
    style, key = env.style("free"), jax.random.key(4)
    carried = contender.start(key, 2)
    state, _ = env.reset(key, style)
    keys = jax.random.split(jax.random.key(5), 30)
    ours = jax.jit(lambda c: jax.lax.scan(contender.advance, c, keys)[0])(carried)

    def step(state, key):
        both = jax.random.randint(key, (2,), 0, 36)
        actions = Pair(both // 6, both % 6)
        state, timestep = jax.vmap(lambda s, a: env.step(key, s, a, style))(state, actions)
        return state, timestep.observation

    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), state)
    state, observations = jax.jit(lambda s: jax.lax.scan(step, s, keys))(batch)
    jax.tree.map(np.testing.assert_array_equal, ours[0], state)
    np.testing.assert_array_equal(ours[1].partner, observations.partner[-1])


def test_kitchen_without_the_peer(monkeypatch):
    monkeypatch.setattr(contenders, "has_peer", lambda: False)
    found = benchmark.measure_kitchen("cramped_room", 8, 20, 1)
    assert set(found) == {"ours, features", "ours, grid"}
    assert all(row.keys() == {"steps_per_second"} for row in found.values())
    assert all(row["steps_per_second"] > 0 for row in found.values())
    table = benchmark.env_table({"batch": 8, "kitchens": {"cramped_room": found}, "machine": {}})
    assert table.row_count == 2


@pytest.mark.slow
def test_kitchen_with_the_peer():
    pytest.importorskip("jaxmarl")
    found = benchmark.measure_kitchen("cramped_room", 8, 20, 1)
    peer = found[contenders.PEER]["steps_per_second"]
    for encoding, bar in benchmark.BARS.items():
        row = found[f"ours, {encoding}"]
        assert row["ratio"] == pytest.approx(row["steps_per_second"] / peer)
        assert row["met"] == (row["ratio"] >= bar)


def test_training_is_measured():
    tiny = PPOConfig(total_steps=320, num_envs=4, rollout_steps=10, num_minibatches=2, epochs=1)
    found = benchmark_ppo.measure_ppo("overcooked/center_pots", 1, 1, tiny, seeds=2)
    assert found["what"] == "both players learning, 16 pairs"
    assert found["steps_per_second"] > 0
    assert found["met"] == (found["steps_per_second"] >= benchmark_ppo.BAR)
    assert benchmark_ppo.ppo_table(found | {"machine": {}}).row_count == 1


@pytest.mark.slow
def test_training_of_egos_with_a_memory_is_measured():
    config = PRESETS["smoke"]("overcooked/center_pots", 0)
    found = benchmark_ppo.measure_recurrent("overcooked/center_pots", 1, 1, config)
    assert "Adaptive Ego, 32 games each" in found["what"]
    assert found["steps_per_second"] > 0
    assert found["met"] == (found["steps_per_second"] >= benchmark_ppo.RECURRENT_BAR)


def test_arguments_are_checked():
    with pytest.raises(benchmark.UserError, match=r"batch is 511; expected a multiple of cores"):
        benchmark._check(benchmark.EnvArguments(batch=511))
    with pytest.raises(benchmark.UserError, match=r"unknown kitchen 'cramped'"):
        benchmark._check(benchmark.EnvArguments(kitchens=("cramped",)))
    with pytest.raises(benchmark.UserError, match=r"repeats is 0"):
        benchmark._check(benchmark.PpoArguments(repeats=0))
