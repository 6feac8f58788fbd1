"""The benchmark's foraging games are those that they claim to be; speeds are not tested."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.lbf import dynamics
from experiments import benchmark, benchmark_lbf, contenders, contenders_lbf
from experiments.contenders_lbf import RULES


def advanced(contender, carried, keys):
    """Plays on; jitted."""
    return jax.jit(lambda c, k: jax.lax.scan(contender.advance, c, k)[0])(carried, keys)


def test_our_fields_are_played_by_the_rules_and_restart_afresh():
    contender = contenders_lbf.our_fields("flat")
    start = contender.start(jax.random.key(1), 3)
    keys = jax.random.split(jax.random.key(2), RULES.max_steps)
    state, observation = advanced(contender, start, keys[:10])
    np.testing.assert_array_equal(state.time, 10)

    expected = start[0]
    step = jax.jit(jax.vmap(lambda s, a: dynamics.step(RULES, s, a).after))
    for key in keys[:10]:
        action_key, _ = jax.random.split(key)
        actions = jnp.stack(contenders.random_actions(action_key, 3), axis=1)
        expected = step(expected, actions)
    jax.tree.map(np.testing.assert_array_equal, state, expected)
    assert observation.shape == (3, 2, 3 * (8 + 2))

    late = (start[0].replace(time=jnp.array([0, RULES.max_steps - 1, 5])), start[1])
    state, observation = advanced(contender, late, keys[:1])
    assert state.time.tolist() == [1, 0, 6]
    np.testing.assert_array_equal(state.food_place[0], start[0].food_place[0])
    assert np.any(np.asarray(state.food_place[1] != start[0].food_place[1]))
    # What is carried for the new game is what its players see.
    entries = np.asarray(observation[1, 0]).reshape(-1, 3)
    assert entries[8].tolist() == [*state.place[1, 0].tolist(), int(state.level[1, 0])]


def test_fields_without_the_peer(monkeypatch):
    monkeypatch.setattr(contenders_lbf, "has_peer", lambda: False)
    found = benchmark_lbf.measure_fields(("flat", "features"), 8, 5, 1)
    assert set(found) == {"ours, flat", "ours, features"}
    assert all(row["kind"] == "vector" for row in found.values())
    assert all(row["steps_per_second"] > 0 for row in found.values())
    table = benchmark_lbf.lbf_table({"batch": 8, "engines": found, "machine": {}})
    assert table.row_count == 2


@pytest.mark.slow
def test_fields_with_the_peer():
    pytest.importorskip("jumanji")
    found = benchmark_lbf.measure_fields(("flat",), 8, 5, 1)
    peer = found[f"{contenders_lbf.PEER}, vector"]["steps_per_second"]
    row = found["ours, flat"]
    assert row["ratio"] == pytest.approx(row["steps_per_second"] / peer)
    assert row["met"] == (row["ratio"] >= benchmark_lbf.BAR)


def test_arguments_are_checked():
    with pytest.raises(benchmark.UserError, match=r"batch is 511; expected a multiple of cores"):
        benchmark._check(benchmark.LbfArguments(batch=511))
    with pytest.raises(benchmark.UserError, match=r"unknown encoding 'pixels'"):
        benchmark._check(benchmark.LbfArguments(encodings=("pixels",)))
