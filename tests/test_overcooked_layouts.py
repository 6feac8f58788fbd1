"""Kitchens: the text notation, its errors, and the tables made from it."""

import numpy as np
import pytest

from envs.overcooked import layouts
from envs.overcooked.layouts import load_layout, parse_layout

GOOD = "XXPXX\nO  2O\nX1  X\nXDXSX"


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "same length"),
        (changed("XDXSX", "XDXS"), "same length"),
        (changed("P", "Q"), r"unknown letters \['Q'\]"),
        (changed("XXPXX", "XXP X"), "border"),
        (changed("X1  X", "X1   "), "border"),
        (changed("XDXSX", "XD1SX").replace("X1  X", "X   X"), "border"),
        (changed("1", " "), "player 1 must stand on exactly one cell"),
        (changed("X1  X", "X1 2X"), "player 2 must stand on exactly one cell"),
        (changed("P", "X"), "at least one pot"),
        (changed("D", "X"), "at least one dish dispenser"),
        (changed("S", "X"), "at least one serving cell"),
        (GOOD.replace("O", "X"), "needs onions"),
    ],
)
def test_a_wrong_drawing_is_refused_with_the_kitchens_name(text, message):
    with pytest.raises(ValueError, match=message) as error:
        parse_layout("mine", text)
    assert "'mine'" in str(error.value)


def test_the_good_drawing_is_read_as_drawn():
    kitchen = parse_layout("mine", GOOD)
    assert kitchen.terrain == ("XXPXX", "O   O", "X   X", "XDXSX")
    assert (kitchen.width, kitchen.height) == (5, 4)
    assert kitchen.floor.tolist() == [[1, 1], [2, 1], [3, 1], [1, 2], [2, 2], [3, 2]]
    # The corners are out of reach; (2, 3) is a counter between dishes and serving.
    assert kitchen.station_kinds == "XXXXXPOODS"
    assert sorted(map(tuple, kitchen.stations[:5].tolist())) == [
        (0, 2),
        (1, 0),
        (2, 3),
        (3, 0),
        (4, 2),
    ]
    assert [tuple(kitchen.floor[cell].tolist()) for cell in kitchen.start] == [(1, 2), (3, 1)]
    assert (kitchen.num_counters, kitchen.num_pots) == (5, 1)
    assert kitchen.orders == (12,)
    assert not kitchen.has_tomatoes


def test_tomatoes_add_the_tomato_soup_to_the_orders():
    kitchen = parse_layout("mine", changed("O", "T"))
    assert kitchen.has_tomatoes
    assert kitchen.orders == (12, 3)


def test_floor_index_names_a_cell_that_is_not_floor():
    kitchen = parse_layout("mine", GOOD)
    assert kitchen.floor_index(2, 2) == 4
    with pytest.raises(ValueError, match=r"\(2, 0\) is not a floor cell of kitchen 'mine'"):
        kitchen.floor_index(2, 0)


def test_stations_beside_cells_are_the_touched_ones():
    kitchen = parse_layout("mine", GOOD)
    cells = np.zeros(len(kitchen.floor), bool)
    cells[kitchen.floor_index(1, 1)] = True
    touched = kitchen.stations[kitchen.stations_beside(cells)]
    assert sorted(map(tuple, touched.tolist())) == [(0, 1), (1, 0)]


SIZES = {
    # floor cells, kinds of the reachable stations, start cells of ego and partner
    "center_pots": (12, "XXXXXXXXXXXPPOODDSS", [(1, 1), (5, 3)]),
    "crossway": (9, "XXXXXXPPPPOODDSS", [(3, 2), (3, 4)]),
    "diverse_coordination": (14, 13 * "X" + "PPOOOODDDDSS", [(4, 1), (4, 3)]),
    "diverse_orders": (14, 13 * "X" + "PPOOTTDDSSSS", [(4, 1), (4, 3)]),
    "cramped_room": (6, "XXXXXPOODS", [(1, 2), (3, 1)]),
    "asymmetric_advantages": (14, 12 * "X" + "PPOODDSS", [(6, 2), (1, 3)]),
    "coordination_ring": (8, "XXXXXXXPPOODS", [(2, 1), (1, 2)]),
    "forced_coordination": (6, "XXXXXXXPPOODS", [(3, 1), (1, 2)]),
    "counter_circuit": (14, 16 * "X" + "PPOODS", [(3, 3), (3, 1)]),
}


def test_the_nine_kitchens_are_the_expected_ones():
    assert set(SIZES) == set(layouts.STYLED + layouts.CLASSIC)
    with pytest.raises(ValueError, match=r"unknown kitchen 'canteen'; expected one of .*crossway"):
        load_layout("canteen")


@pytest.mark.parametrize("name", SIZES)
def test_a_packaged_kitchen_has_its_cells_stations_and_starts(name):
    cells, kinds, starts = SIZES[name]
    kitchen = load_layout(name)
    assert len(kitchen.floor) == cells
    assert kitchen.station_kinds == kinds
    assert [tuple(kitchen.floor[cell].tolist()) for cell in kitchen.start] == starts
    assert kitchen.orders == ((12, 3) if name == "diverse_orders" else (12,))
    assert kitchen.cook_time == 20
    assert kitchen.soup_reward == 20


@pytest.mark.parametrize("name", SIZES)
def test_tables_agree_with_the_drawing(name):
    kitchen = load_layout(name)
    floor = [tuple(cell) for cell in kitchen.floor.tolist()]
    stations = [tuple(station) for station in kitchen.stations.tolist()]
    for i, (x, y) in enumerate(floor):
        assert kitchen.terrain[y][x] == " "
        for direction, (dx, dy) in enumerate([(0, -1), (0, 1), (1, 0), (-1, 0)]):
            there = (x + dx, y + dy)
            if kitchen.terrain[there[1]][there[0]] == " ":
                assert floor[kitchen.neighbour[i, direction]] == there
                assert kitchen.facing[i, direction] == len(stations)
            else:
                assert kitchen.neighbour[i, direction] == i
                assert stations[kitchen.facing[i, direction]] == there
    for (x, y), kind in zip(stations, kitchen.station_kinds, strict=True):
        assert kitchen.terrain[y][x] == kind
    assert kitchen.kinds[-1] == layouts.NOTHING
