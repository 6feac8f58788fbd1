"""Populations shared out over devices compute what a plain vmap computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax.population import over_population, population_size, share_out, turns


def one_member(key, member):
    noise = jax.random.normal(key, (3,))
    return {"sum": member["weight"] @ noise, "number": member["number"] + 1}


def some(size: int):
    keys = jax.random.split(jax.random.key(0), size)
    weight = jnp.arange(size * 6, dtype=jnp.float32).reshape(size, 2, 3)
    return keys, {"weight": weight, "number": jnp.arange(size)}


def test_the_tests_run_on_two_devices():
    assert len(jax.devices()) == 2


@pytest.mark.parametrize("size", [1, 2, 3, 4, 7])
def test_the_result_is_that_of_vmap_also_where_devices_do_not_divide(size):
    arguments = some(size)
    found = over_population(one_member)(*arguments)
    expected = jax.jit(jax.vmap(one_member))(*arguments)
    assert population_size(found) == size
    np.testing.assert_allclose(found["sum"], expected["sum"], rtol=1e-6)
    np.testing.assert_array_equal(found["number"], np.arange(size) + 1)


@pytest.mark.parametrize("size", [3, 4])
def test_shared_arguments_are_the_same_for_all_members(size):
    def scaled(key, factor, member):
        return jax.random.uniform(key) + factor["by"] * member

    members = jnp.arange(size, dtype=jnp.float32)
    key, factor = jax.random.key(3), {"by": jnp.float32(10)}
    found = over_population(scaled, shared=2)(key, factor, members)
    np.testing.assert_allclose(found, jax.random.uniform(key) + 10 * members, rtol=1e-6)


def test_the_work_is_shared_out():
    found = over_population(one_member)(*some(4))
    holders = {shard.device for shard in found["number"].addressable_shards}
    assert holders == set(jax.devices())
    placed = share_out(some(4)[1])
    for leaf in jax.tree.leaves(placed):
        assert len(leaf.sharding.device_set) == 2
        assert leaf.addressable_shards[0].data.shape[0] == 2


def test_what_devices_do_not_divide_is_left_where_it_is():
    population = some(3)[1]
    assert share_out(population) is population


@pytest.mark.parametrize(("members", "devices"), [(1, 2), (4, 2), (3, 2), (5, 2), (9, 6), (3, 8)])
def test_turns_are_fair_and_devices_share_each_group(members, devices):
    groups = turns(members, devices)
    taken = np.bincount(np.concatenate(groups), minlength=members)
    assert len(taken) == members
    assert set(taken) == {taken[0]}
    for group in groups:
        assert len(set(group)) == len(group)
        assert len(group) % devices == 0 or len(groups) == 1


def test_three_members_on_two_devices():
    assert [group.tolist() for group in turns(3, 2)] == [[0, 1], [2, 0], [1, 2]]
    assert len(turns(49, 2)) == 1, "one copy among fifty is cheaper than turns"


def test_donated_arguments_are_consumed_and_others_are_not():
    advance = over_population(lambda state, step: state + step, donate=(0,))
    state, step = share_out(jnp.zeros((4, 1000))), share_out(jnp.ones((4, 1000)))
    after = advance(state, step)
    np.testing.assert_array_equal(after, 1)
    assert state.is_deleted()
    assert not step.is_deleted()
    keep = over_population(lambda state, step: state + step)
    keep(after, step)
    assert not after.is_deleted()
