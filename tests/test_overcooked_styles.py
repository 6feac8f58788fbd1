"""Each style's masks against drawings of where it stands and what it uses."""

import jax
import numpy as np
import pytest

import envs
from envs.overcooked import layouts, reward, styles

# Two drawings a style: the partner's, and the ego's role. `o`: a floor cell that the player
# reaches; a letter: a station that it may use from there; a dot: any other station.

CENTER_POTS = {
    "left": """
        .XO....  ....OX.
        Xoo   .  .   ooX
        XoP.. .  . ..PoX
        Xoo   .  .   ooX
        .DS....  ....SD.""",
    "right": """
        ....OX.  .XO....
        .   ooX  Xoo   .
        . ..PoX  XoP.. .
        .   ooX  Xoo   .
        ....SD.  .DS....""",
    "upper": """
        .XOXOX.  .......
        XoooooX  .     .
        . PXP .  . PXP .
        .     .  XoooooX
        .......  .DSXSD.""",
    "lower": """
        .......  .XOXOX.
        .     .  XoooooX
        . PXP .  . PXP .
        XoooooX  .     .
        .DSXSD.  .......""",
    "upper_left": """
        .XO....  .......
        Xoo   .  .     .
        . P.. .  . PXP .
        .     .  XoooooX
        .......  .DSXSD.""",
    "upper_right": """
        ....OX.  .......
        .   ooX  .     .
        . ..P .  . PXP .
        .     .  XoooooX
        .......  .DSXSD.""",
    "lower_left": """
        .......  .XOXOX.
        .     .  XoooooX
        . P.. .  . PXP .
        Xoo   .  .     .
        .DS....  .......""",
    "lower_right": """
        .......  .XOXOX.
        .     .  XoooooX
        . ..P .  . PXP .
        .   ooX  .     .
        ....SD.  .......""",
}

CROSSWAY = {
    "upper_left": """
        ...X...  .......
        ..PoP..  ... ...
        .XOoD..  ... DX.
        Sooo  .  .  oooS
        .XD ...  ..DoOX.
        ... ...  ..PoP..
        .......  ...X...""",
    "upper_right": """
        ...X...  .......
        ..PoP..  ... ...
        ..OoDX.  .XO ...
        .  oooS  Sooo  .
        ... OX.  .XDoO..
        ... ...  ..PoP..
        .......  ...X...""",
    "lower_left": """
        .......  ...X...
        ... ...  ..PoP..
        .XO ...  ..OoDX.
        Sooo  .  .  oooS
        .XDoO..  ... OX.
        ..PoP..  ... ...
        ...X...  .......""",
    "lower_right": """
        .......  ...X...
        ... ...  ..PoP..
        ... DX.  .XOoD..
        .  oooS  Sooo  .
        ..DoOX.  .XD ...
        ..PoP..  ... ...
        ...X...  .......""",
    "upper_no_dish": """
        ...X...  ...X...
        ..PoP..  ..PoP..
        ..Oo...  .X.oDX.
        . ooo .  SoooooS
        ... O..  .XDo.X.
        ... ...  ..PoP..
        .......  ...X...""",
    "lower_no_dish": """
        .......  ...X...
        ... ...  ..PoP..
        ..O ...  .X.oDX.
        . ooo .  SoooooS
        ...oO..  .XDo.X.
        ..PoP..  ..PoP..
        ...X...  ...X...""",
    "deliver_left": """
        ...X...  ...X...
        ..PoP..  ..PoP..
        .X.oD..  ..Oo.X.
        Sooo  .  .  ooo.
        .XDo...  ...oOX.
        ..PoP..  ..PoP..
        ...X...  ...X...""",
    "deliver_right": """
        ...X...  ...X...
        ..PoP..  ..PoP..
        ...oDX.  .XOo...
        .  oooS  .ooo  .
        ..Do.X.  .X.oO..
        ..PoP..  ..PoP..
        ...X...  ...X...""",
}

LEFT_ROLE = [".OXDS....", "Xoooo   .", ".XXX.....", ".       .", "........."]
RIGHT_ROLE = ["....SDXO.", ".   ooooX", ".....XXX.", ".       .", "........."]
DIVERSE_COORDINATION = {
    f"{side}_{what}": "\n".join(
        f"{partner}  {role}" for partner, role in zip([*upper, bottom], ego_role, strict=True)
    )
    for side, ego_role, upper, bottoms in (
        (
            "left",
            LEFT_ROLE,
            [".........", ".       .", ".XXX.....", "Xoooo   ."],
            ("..PDS....", ".OP.S....", "..P.S....", ".OPD....."),
        ),
        (
            "right",
            RIGHT_ROLE,
            [".........", ".       .", ".....XXX.", ".   ooooX"],
            ("....SDP..", "....S.PO.", "....S.P..", ".....DPO."),
        ),
    )
    for what, bottom in zip(
        ("no_onion", "no_dish", "no_onion_no_dish", "no_delivery"), bottoms, strict=True
    )
}

DIVERSE_ORDERS = dict.fromkeys(
    (f"{ingredient}_{number}" for ingredient in ("onion", "tomato") for number in (1, 2, 3, 4)),
    """
        .........  .SXSXSXS.
        .       .  OoooooooT
        .XPXXXPX.  .XPXXXPX.
        OoooooooT  .       .
        .XXDXDXX.  .........""",
)

DRAWINGS = {
    "center_pots": CENTER_POTS,
    "crossway": CROSSWAY,
    "diverse_coordination": DIVERSE_COORDINATION,
    "diverse_orders": DIVERSE_ORDERS,
}
CASES = [(kitchen, style) for kitchen, drawn in DRAWINGS.items() for style in drawn]


def columns(drawing: str) -> tuple[list[str], list[str]]:
    """The rows of the two drawings; a row of one may hold spaces, so they split by width."""
    rows = [row.strip() for row in drawing.strip("\n").splitlines()]
    width = (len(rows[0]) - 2) // 2
    assert all(len(row) == 2 * width + 2 for row in rows), rows
    return [row[:width] for row in rows], [row[width + 2 :] for row in rows]


def reached(layout, start: int, cells: np.ndarray) -> np.ndarray:
    """The allowed floor cells that can be walked to."""
    room, waiting = {start}, [start]
    while waiting:
        for there in layout.neighbour[waiting.pop()]:
            if cells[there] and int(there) not in room:
                room.add(int(there))
                waiting.append(int(there))
    return np.isin(np.arange(len(layout.floor)), list(room))


def draw(layout, start: int, cells: np.ndarray, targets: np.ndarray) -> list[str]:
    """The drawing of what a player reaches and may use."""
    room = reached(layout, start, cells)
    usable = layout.stations_beside(room) & targets
    rows = [["." if letter != " " else " " for letter in row] for row in layout.terrain]
    for (x, y), inside in zip(layout.floor, room, strict=True):
        rows[y][x] = "o" if inside else " "
    for (x, y), kind, may in zip(layout.stations, layout.station_kinds, usable, strict=True):
        rows[y][x] = kind if may else "."
    return ["".join(row) for row in rows]


@pytest.fixture(scope="module")
def kitchens():
    return {name: envs.make(f"overcooked/{name}") for name in (*layouts.STYLED, "cramped_room")}


@pytest.mark.parametrize("kitchen", DRAWINGS)
def test_every_style_is_drawn_and_in_the_papers_order(kitchens, kitchen):
    assert kitchens[kitchen].style_names == tuple(DRAWINGS[kitchen])


@pytest.mark.parametrize(("kitchen", "name"), CASES)
def test_the_partner_stands_and_uses_what_is_drawn(kitchens, kitchen, name):
    env = kitchens[kitchen]
    style = jax.tree.map(np.asarray, env.style(name))
    assert style.cells[1, style.start[1]], "the partner starts on a cell of its own"
    found = draw(env.layout, style.start[1], style.cells[1], style.targets[1])
    assert found == columns(DRAWINGS[kitchen][name])[0]


@pytest.mark.parametrize(("kitchen", "name"), CASES)
def test_the_egos_role_is_as_drawn_and_binds_only_when_confined(kitchens, kitchen, name):
    env = kitchens[kitchen]
    style = jax.tree.map(np.asarray, env.style(name))
    found = draw(env.layout, style.start[0], style.role_cells, style.role_targets)
    assert found == columns(DRAWINGS[kitchen][name])[1]
    assert style.cells[0].all()
    assert style.targets[0].all()
    confined = env.confine(style)
    np.testing.assert_array_equal(confined.cells, [style.role_cells, style.cells[1]])
    np.testing.assert_array_equal(confined.targets, [style.role_targets, style.targets[1]])


STARTS = {
    ("crossway", "upper_no_dish"): [(3, 5), (3, 1)],
    ("crossway", "lower_no_dish"): [(3, 1), (3, 5)],
    ("crossway", "deliver_left"): [(3, 2), (1, 3)],
    ("crossway", "deliver_right"): [(3, 2), (5, 3)],
    ("diverse_coordination", "left_no_dish"): [(4, 1), (4, 3)],
    ("diverse_orders", "tomato_3"): [(4, 1), (4, 3)],
    # The file's cells, (1, 1) and (5, 3), where the style allows them, else the nearest.
    ("center_pots", "right"): [(1, 1), (5, 3)],
    ("center_pots", "lower"): [(1, 1), (5, 3)],
    ("center_pots", "upper"): [(1, 3), (5, 1)],
    ("center_pots", "upper_right"): [(1, 3), (5, 1)],
}


@pytest.mark.parametrize(("kitchen", "name"), STARTS)
def test_start_cells(kitchens, kitchen, name):
    env = kitchens[kitchen]
    cells = env.layout.floor[np.asarray(env.style(name).start)]
    assert [tuple(cell) for cell in cells.tolist()] == STARTS[kitchen, name]


@pytest.mark.parametrize(("kitchen", "name"), CASES)
def test_players_start_apart_and_inside_their_masks(kitchens, kitchen, name):
    style = jax.tree.map(np.asarray, kitchens[kitchen].style(name))
    assert style.start[0] != style.start[1]
    assert style.role_cells[style.start[0]]
    assert style.cells[1][style.start[1]]


def test_in_diverse_orders_one_soup_at_one_serving_cell_pays(kitchens):
    env = kitchens["diverse_orders"]
    serving = {(1, 0): 1, (3, 0): 2, (5, 0): 3, (7, 0): 4}
    for name in env.style_names:
        ingredient, number = name.split("_")
        expected = np.zeros((len(env.layout.stations), reward.NUM_CONTENTS))
        for index, place in enumerate(map(tuple, env.layout.stations.tolist())):
            if serving.get(place) == int(number):
                expected[index, 12 if ingredient == "onion" else 3] = 20
        assert expected.sum() == 20
        np.testing.assert_array_equal(env.style(name).pays, expected, err_msg=name)


def test_in_the_other_kitchens_the_onion_soup_pays_at_every_serving_cell(kitchens):
    for kitchen in ("center_pots", "crossway", "diverse_coordination", "cramped_room"):
        env = kitchens[kitchen]
        pays = np.asarray(env.styles.pays)
        serving = env.layout.kinds[:-1] == layouts.SERVING
        assert (pays[:, serving, 12] == 20).all()
        assert (np.delete(pays, 12, axis=2) == 0).all()
        assert env.styles.task.shape[-1] == 0


def test_the_task_names_ingredient_and_serving_cell(kitchens):
    env = kitchens["diverse_orders"]
    np.testing.assert_array_equal(env.style("onion_1").task, [1, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(env.style("tomato_4").task, [0, 1, 0, 0, 0, 1])
    assert len({tuple(task) for task in np.asarray(env.styles.task).tolist()}) == 8


GIVEN = {
    # what the ego and the partner hand over, and over which counters
    ("diverse_coordination", "left_no_onion"): (("onion",), (), (1, 2, 3)),
    ("diverse_coordination", "right_no_onion"): (("onion",), (), (5, 6, 7)),
    ("diverse_coordination", "left_no_dish"): (("dish",), (), (1, 2, 3)),
    ("diverse_coordination", "right_no_dish"): (("dish",), (), (5, 6, 7)),
    ("diverse_coordination", "left_no_onion_no_dish"): (("onion", "dish"), (), (1, 2, 3)),
    ("diverse_coordination", "left_no_delivery"): ((), ("soup",), (1, 2, 3)),
    ("diverse_coordination", "right_no_delivery"): ((), ("soup",), (5, 6, 7)),
    ("diverse_orders", "onion_2"): ((), ("dish", "soup"), (1, 3, 4, 5, 7)),
}


@pytest.mark.parametrize(("kitchen", "name"), GIVEN)
def test_only_what_is_needed_is_worth_handing_over(kitchens, kitchen, name):
    env = kitchens[kitchen]
    *gives, over = GIVEN[kitchen, name]
    worth = np.asarray(env.style(name).hand_over)
    for counter, (x, y) in enumerate(env.layout.stations[: env.layout.num_counters]):
        for agent in (0, 1):
            for kind, item in enumerate(("onion", "tomato", "dish", "soup")):
                if y != 2 or x not in over:
                    wanted = 0
                elif item in gives[agent]:
                    wanted = 1
                else:
                    # Taking earns the opposite of putting: the taker of a gift earns 1.
                    wanted = -1 if item in gives[1 - agent] else reward.IN_THE_WAY
                assert worth[agent, counter, kind] == wanted, (x, y, agent, item)
    assert reward.IN_THE_WAY < 0


def test_nothing_is_handed_over_where_both_reach_everything(kitchens):
    for kitchen in ("center_pots", "crossway"):
        assert not np.asarray(kitchens[kitchen].styles.hand_over).any()


def test_classic_kitchens_have_one_style_that_forbids_nothing(kitchens):
    env = kitchens["cramped_room"]
    assert env.style_names == (styles.FREE_STYLE,)
    for mask in (env.styles.cells, env.styles.targets, env.styles.role_cells):
        assert np.asarray(mask).all()
