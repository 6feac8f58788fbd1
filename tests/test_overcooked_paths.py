"""Ways to stations around the other player, against ways counted by hand."""

import numpy as np
import pytest

from envs.overcooked import layouts, paths


@pytest.fixture(scope="module")
def crossway():
    return layouts.load_layout("crossway")


def steps(layout, other, own, station, cells=None, targets=None):
    cells = np.ones(len(layout.floor), bool) if cells is None else cells
    targets = np.ones(len(layout.stations), bool) if targets is None else targets
    table = paths.steps_around(layout, cells, targets)
    (index,) = np.flatnonzero((layout.stations == station).all(axis=1))
    return table[layout.floor_index(*other), layout.floor_index(*own), index]


def test_open_ways_are_counted_in_steps(crossway):
    assert steps(crossway, other=(5, 3), own=(3, 1), station=(2, 1)) == 0
    assert steps(crossway, other=(5, 3), own=(3, 3), station=(2, 1)) == 2
    assert steps(crossway, other=(5, 3), own=(1, 3), station=(4, 5)) == 4


def test_a_player_in_the_way_blocks_it(crossway):
    assert steps(crossway, other=(3, 2), own=(3, 3), station=(2, 1)) == paths.REACH
    assert steps(crossway, other=(3, 1), own=(3, 3), station=(2, 1)) == paths.REACH


def test_a_ring_is_walked_the_other_way_round():
    ring = layouts.load_layout("center_pots")
    # From (1, 1) to the upper side of the right pot: three steps, or five the other way round.
    assert steps(ring, other=(1, 3), own=(1, 1), station=(4, 2)) == 3
    assert steps(ring, other=(2, 1), own=(1, 1), station=(4, 2)) == 5
    assert steps(ring, other=(3, 1), own=(1, 1), station=(4, 0)) == 9


def test_what_is_forbidden_is_out_of_reach(crossway):
    upper = crossway.floor[:, 1] <= 3
    assert steps(crossway, (5, 3), (3, 3), (4, 5), cells=upper) == paths.REACH
    none = np.zeros(len(crossway.stations), bool)
    assert steps(crossway, (5, 3), (3, 3), (2, 1), targets=none) == paths.REACH
