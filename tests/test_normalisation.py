"""Running statistics of observations, and networks that take them up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import normalisation
from haland_jax.networks import DistributionKind, MLPActor, MLPCritic


def test_hand_worked_statistics():
    seen = normalisation.update(normalisation.fresh(2), jnp.array([[1.0, 5.0], [3.0, 5.0]]))
    np.testing.assert_allclose(seen.mean, [2.0, 5.0])
    np.testing.assert_allclose(seen.variance, [1.0, 0.0])
    seen = normalisation.update(seen, jnp.array([[5.0, 8.0], [7.0, 8.0]]))
    np.testing.assert_allclose(seen.mean, [4.0, 6.5])
    np.testing.assert_allclose(seen.variance, [5.0, 2.25])
    assert seen.count == 4


def test_pieces_of_any_size_give_the_statistics_of_the_whole():
    rows = np.random.default_rng(0).normal([0.0, 100.0, -3.0], [1.0, 0.3, 20.0], (60, 3))
    seen = normalisation.fresh(3)
    for piece in np.split(rows, [1, 7, 40]):
        seen = normalisation.update(seen, jnp.asarray(piece))
    np.testing.assert_allclose(seen.mean, rows.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(seen.variance, rows.var(axis=0), rtol=1e-3)


def test_leading_axes_are_all_samples():
    rows = jnp.arange(24.0).reshape(2, 4, 3)
    found = normalisation.update(normalisation.fresh(3), rows)
    expected = normalisation.update(normalisation.fresh(3), rows.reshape(8, 3))
    np.testing.assert_allclose(found.mean, expected.mean)
    assert found.count == 8


def test_nothing_seen_changes_nothing():
    observation = jnp.array([3.0, -2.0])
    np.testing.assert_array_equal(
        normalisation.normalise(normalisation.fresh(2), observation), observation
    )
    np.testing.assert_array_equal(normalisation.normalise(None, observation), observation)


def test_what_never_changes_is_not_blown_up():
    seen = normalisation.update(normalisation.fresh(1), jnp.full((10, 1), 4.0))
    found = normalisation.normalise(seen, jnp.array([4.001]))
    assert 0 < float(found[0]) < 0.2


@pytest.mark.parametrize("network", [MLPActor(3, kind=DistributionKind.GAUSSIAN), MLPCritic()])
def test_a_folded_network_reads_raw_observations_and_can_be_unfolded(network):
    rows = jax.random.normal(jax.random.key(1), (50, 4)) * jnp.array([1, 10, 0.1, 3]) + 2.0
    seen = normalisation.update(normalisation.fresh(4), rows)
    params = network.init(jax.random.key(0), rows[0])
    expected = network.apply(params, normalisation.normalise(seen, rows))
    folded = normalisation.fold(seen, params)
    for found, wanted in zip(
        jax.tree.leaves(network.apply(folded, rows)), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
    back = normalisation.unfold(seen, folded)
    for found, wanted in zip(jax.tree.leaves(back), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
