"""The kitchen's rules, in situations drawn by hand and in random play."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_kitchen import DrawnKitchen, content_code, item_code

import envs
from envs.overcooked import dynamics, layouts

ROOM = layouts.parse_layout("room", "XXPXX\nO  2O\nX1  X\nT  SX\nXDXXX")


def change(transition, agent=0) -> int:
    return int(transition.interactions.change[agent])


def room(**options) -> DrawnKitchen:
    return DrawnKitchen(ROOM, **options)


@pytest.mark.parametrize(
    ("direction", "there"),
    [("north", (2, 1)), ("south", (2, 3)), ("east", (3, 2)), ("west", (1, 2))],
)
def test_a_free_way_is_taken(direction, there):
    kitchen = room()
    kitchen.place(0, 2, 2)
    kitchen.play(direction)
    assert kitchen.cell(0) == there
    assert kitchen.facing(0) == direction


@pytest.mark.parametrize("direction", ["north", "west"])
def test_a_blocked_player_turns_and_stays(direction):
    kitchen = room()
    kitchen.place(0, 1, 1, facing="east")
    kitchen.play(direction)
    assert kitchen.cell(0) == (1, 1)
    assert kitchen.facing(0) == direction


def test_staying_and_interacting_do_not_turn():
    kitchen = room()
    kitchen.place(0, 1, 1, facing="east")
    kitchen.play("stay", "interact")
    kitchen.play("interact", "stay")
    assert kitchen.cell(0) == (1, 1)
    assert kitchen.facing(0) == "east"


def test_players_who_want_the_same_cell_both_stay_and_turn():
    kitchen = room()
    kitchen.place(0, 1, 2)
    kitchen.place(1, 3, 2)
    kitchen.play("east", "west")
    assert (kitchen.cell(0), kitchen.cell(1)) == ((1, 2), (3, 2))
    assert (kitchen.facing(0), kitchen.facing(1)) == ("east", "west")


def test_players_cannot_swap_but_can_follow():
    kitchen = room()
    kitchen.place(0, 1, 2)
    kitchen.place(1, 2, 2)
    kitchen.play("east", "west")
    assert (kitchen.cell(0), kitchen.cell(1)) == ((1, 2), (2, 2))
    kitchen.play("east", "east")
    assert (kitchen.cell(0), kitchen.cell(1)) == ((2, 2), (3, 2))


def test_a_player_who_stays_is_not_walked_over():
    kitchen = room()
    kitchen.place(0, 1, 2)
    kitchen.place(1, 2, 2)
    kitchen.play("east", "stay")
    assert (kitchen.cell(0), kitchen.cell(1)) == ((1, 2), (2, 2))


@pytest.mark.parametrize(
    ("cell", "facing", "item"),
    [((1, 1), "west", "onion"), ((1, 3), "west", "tomato"), ((1, 3), "south", "dish")],
)
def test_a_dispenser_fills_empty_hands_only(cell, facing, item):
    kitchen = room()
    kitchen.place(0, *cell, facing=facing)
    assert change(kitchen.play("interact")) == dynamics.TAKEN_FROM_DISPENSER
    assert kitchen.held(0) == item_code(item)
    kitchen.place(0, *cell, facing=facing, held="ooo")
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.held(0) == item_code("ooo")


@pytest.mark.parametrize("item", ["onion", "tomato", "dish", "oot"])
def test_a_counter_holds_one_thing_of_any_kind(item):
    kitchen = room()
    kitchen.place(0, 1, 2, facing="west", held=item)
    assert change(kitchen.play("interact")) == dynamics.PUT_ON_COUNTER
    assert kitchen.held(0) == 0
    assert kitchen.lying(0, 2) == item_code(item)
    kitchen.place(0, 1, 2, facing="west", held="onion")
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.held(0) == dynamics.ONION
    kitchen.place(0, 1, 2, facing="west")
    assert change(kitchen.play("interact")) == dynamics.TAKEN_FROM_COUNTER
    assert kitchen.held(0) == item_code(item)
    assert kitchen.lying(0, 2) == 0


def test_the_first_player_takes_before_the_second():
    kitchen = room()
    kitchen.lay(2, 4, "dish")
    kitchen.place(0, 2, 3, facing="south")
    kitchen.place(1, 3, 2, facing="east")
    kitchen.play("interact", "interact")
    assert (kitchen.held(0), kitchen.held(1)) == (dynamics.DISH, 0)
    # The ring lets two players face one counter from two sides.
    ring = DrawnKitchen(layouts.load_layout("center_pots"))
    ring.lay(3, 2, "onion")
    ring.place(0, 3, 1, facing="south")
    ring.place(1, 3, 3, facing="north")
    transition = ring.play("interact", "interact")
    assert (ring.held(0), ring.held(1)) == (dynamics.ONION, 0)
    assert change(transition, 1) == dynamics.NO_CHANGE


def test_the_second_player_meets_what_the_first_has_put():
    ring = DrawnKitchen(layouts.load_layout("center_pots"))
    ring.place(0, 3, 1, facing="south", held="onion")
    ring.place(1, 3, 3, facing="north")
    transition = ring.play("interact", "interact")
    assert (ring.held(0), ring.held(1)) == (0, dynamics.ONION)
    assert change(transition, 1) == dynamics.TAKEN_FROM_COUNTER
    assert ring.lying(3, 2) == 0


@pytest.mark.parametrize(
    ("inside", "item", "becomes"),
    [("", "onion", "o"), ("oo", "onion", "ooo"), ("o", "tomato", "ot"), ("tt", "tomato", "ttt")],
)
def test_an_ingredient_goes_into_an_unfinished_pot(inside, item, becomes):
    kitchen = room()
    kitchen.fill(2, 0, inside)
    kitchen.place(0, 2, 1, held=item)
    assert change(kitchen.play("interact")) == dynamics.POTTED
    assert kitchen.pot(2, 0) == (content_code(becomes), dynamics.IDLE)
    assert kitchen.held(0) == 0


@pytest.mark.parametrize(
    ("inside", "timer", "item"),
    [("ooo", -1, "onion"), ("o", 3, "onion"), ("o", 20, "onion"), ("o", -1, "ooo")],
)
def test_a_pot_refuses_what_does_not_belong(inside, timer, item):
    kitchen = room()
    kitchen.fill(2, 0, inside, timer)
    kitchen.place(0, 2, 1, held=item)
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.held(0) == item_code(item)
    assert kitchen.pot(2, 0)[0] == content_code(inside)


@pytest.mark.parametrize("inside", ["o", "ot", "ooo"])
def test_a_started_pot_cooks_for_twenty_steps(inside):
    kitchen = room()
    kitchen.fill(2, 0, inside)
    kitchen.place(0, 2, 1)
    assert change(kitchen.play("interact")) == dynamics.COOKING_STARTED
    assert kitchen.pot(2, 0) == (content_code(inside), 1)
    for tick in range(2, 20):
        kitchen.play()
        assert kitchen.pot(2, 0)[1] == tick
    kitchen.place(0, 2, 1, held="dish")
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE, "not ready yet"
    assert kitchen.pot(2, 0)[1] == 20
    kitchen.play()
    assert kitchen.pot(2, 0)[1] == 20, "a ready soup neither burns nor cooks on"
    assert change(kitchen.play("interact")) == dynamics.SOUP_TAKEN
    assert kitchen.held(0) == item_code(inside)
    assert kitchen.pot(2, 0) == (0, dynamics.IDLE)


def test_an_empty_pot_does_not_start_and_a_running_one_not_again():
    kitchen = room()
    kitchen.place(0, 2, 1)
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.pot(2, 0) == (0, dynamics.IDLE)
    kitchen.fill(2, 0, "oo", timer=7)
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.pot(2, 0) == (8, 8)


@pytest.mark.parametrize("item", ["", "onion", "oo"])
def test_a_ready_soup_needs_a_dish(item):
    kitchen = room()
    kitchen.fill(2, 0, "ooo", timer=20)
    kitchen.place(0, 2, 1, held=item)
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.pot(2, 0) == (12, 20)
    assert kitchen.held(0) == item_code(item)


@pytest.mark.parametrize(("item", "delivered"), [("ooo", True), ("t", True), ("dish", False)])
def test_the_serving_cell_takes_any_soup_and_nothing_else(item, delivered):
    kitchen = room()
    kitchen.place(0, 2, 3, facing="east", held=item)
    transition = kitchen.play("interact")
    assert (change(transition) == dynamics.DELIVERED) == delivered
    assert kitchen.held(0) == (0 if delivered else item_code(item))
    assert int(transition.interactions.item[0]) == item_code(item)


def test_with_old_dynamics_a_full_pot_starts_by_itself_and_only_so():
    kitchen = room(old_dynamics=True)
    kitchen.fill(2, 0, "oo")
    kitchen.place(0, 2, 1)
    assert change(kitchen.play("interact")) == dynamics.NO_CHANGE
    assert kitchen.pot(2, 0) == (8, dynamics.IDLE)
    kitchen.place(0, 2, 1, held="onion")
    kitchen.play("interact")
    assert kitchen.pot(2, 0) == (12, 1)
    for _ in range(19):
        kitchen.play()
    assert kitchen.pot(2, 0) == (12, 20)


def test_with_new_dynamics_a_full_pot_waits():
    kitchen = room()
    kitchen.fill(2, 0, "ooo")
    kitchen.play()
    assert kitchen.pot(2, 0) == (12, dynamics.IDLE)


def test_forbidden_cells_turn_the_player_and_forbidden_stations_do_nothing():
    kitchen = room()
    kitchen.cells[1, ROOM.floor_index(2, 2)] = False
    kitchen.targets[1, kitchen.station(0, 1)] = False
    kitchen.place(1, 1, 2)
    kitchen.place(0, 2, 3)
    kitchen.play("stay", "east")
    assert kitchen.cell(1) == (1, 2)
    assert kitchen.facing(1) == "east"
    kitchen.place(1, 1, 1, facing="west")
    assert change(kitchen.play("stay", "interact"), 1) == dynamics.NO_CHANGE
    assert kitchen.held(1) == 0
    # The same cell and station are free to the other player.
    kitchen.place(1, 3, 1)
    kitchen.place(0, 1, 1, facing="west")
    kitchen.play("interact")
    assert kitchen.held(0) == dynamics.ONION
    kitchen.place(0, 2, 1)
    kitchen.play("south")
    assert kitchen.cell(0) == (2, 2)


# Random play: the same actions in every style, from several moments of games.

ACTIONS = st.sampled_from([*range(5), 5, 5, 5, 5, 5])
GAMES = st.lists(st.tuples(ACTIONS, ACTIONS), min_size=40, max_size=40)
KITCHENS = layouts.STYLED + layouts.CLASSIC
STARTS = 6


@functools.cache
def kitchen_player(name: str):
    """Plays [T, agent] actions in all styles from the first `STARTS` moments of their pools."""
    env = envs.make(f"overcooked/{name}")
    styles = env.styles

    def one_game(style, start, actions):
        def one_step(state, action):
            transition = dynamics.step(
                env.layout, state, action, cells=style.cells, targets=style.targets
            )
            return transition.after, transition

        return jax.lax.scan(one_step, start, actions)[1]

    def play(actions):
        def of_style(style):
            starts = jax.tree.map(lambda leaf: leaf[:STARTS], style.pool)
            return jax.vmap(one_game, in_axes=(None, 0, None))(style, starts, actions)

        return jax.vmap(of_style)(styles)

    return env, jax.jit(play)


def played(name: str, actions) -> tuple:
    """Transitions as NumPy arrays [style, game, T, ...]."""
    env, play = kitchen_player(name)
    return env, jax.tree.map(np.asarray, play(jnp.array(actions, jnp.int32)))


def amounts(state) -> dict[str, np.ndarray]:
    """How many onions, tomatoes and dishes there are, loose, in pots and in soups."""
    items = np.concatenate([state.held, state.counters], axis=-1)
    soups = np.where(items >= dynamics.SOUP, items - dynamics.SOUP, 0)
    return {
        "onion": ((items == dynamics.ONION) + (soups >> 2)).sum(-1)
        + (state.pot_content >> 2).sum(-1),
        "tomato": ((items == dynamics.TOMATO) + (soups & 3)).sum(-1)
        + (state.pot_content & 3).sum(-1),
        "dish": ((items == dynamics.DISH) | (items >= dynamics.SOUP)).sum(-1),
    }


@pytest.mark.parametrize("name", KITCHENS)
@hypothesis.given(actions=GAMES)
@hypothesis.settings(max_examples=6)
def test_in_random_play_the_rules_hold(name, actions):
    env, transitions = played(name, actions)
    layout, styles = env.layout, jax.tree.map(np.asarray, env.styles)
    before, after = transitions.before, transitions.after
    allowed = styles.cells[:, None, None]

    # Nothing appears but from dispensers, and nothing goes but over the serving cells.
    gained = {"onion": 0, "tomato": 0, "dish": 0}
    for agent in (0, 1):
        station = layout.facing[before.cell[..., agent], before.orientation[..., agent]]
        kind = layout.kinds[station]
        may_use = np.pad(styles.targets[:, agent], ((0, 0), (0, 1)))
        may_use = may_use[np.arange(len(may_use))[:, None, None], station]
        acts = may_use & (np.array(actions)[:, agent] == dynamics.INTERACT)
        held = before.held[..., agent]
        for item, dispenser in (
            ("onion", layouts.ONIONS),
            ("tomato", layouts.TOMATOES),
            ("dish", layouts.DISHES),
        ):
            gained[item] = gained[item] + (acts & (held == 0) & (kind == dispenser))
        served = acts & (held >= dynamics.SOUP) & (kind == layouts.SERVING)
        gained["onion"] = gained["onion"] - served * ((held - dynamics.SOUP) >> 2)
        gained["tomato"] = gained["tomato"] - served * ((held - dynamics.SOUP) & 3)
        gained["dish"] = gained["dish"] - served
    for item, count in amounts(after).items():
        np.testing.assert_array_equal(count - amounts(before)[item], gained[item], err_msg=item)

    assert (after.cell[..., 0] != after.cell[..., 1]).all(), "players share a cell"
    for agent in (0, 1):
        stands = np.take_along_axis(
            np.broadcast_to(allowed[..., agent, :], (*after.cell.shape[:-1], allowed.shape[-1])),
            after.cell[..., agent, None],
            axis=-1,
        )
        assert stands.all(), f"player {agent} stands on a forbidden cell"
    assert (after.pot_timer >= dynamics.IDLE).all()
    assert (after.pot_timer <= layout.cook_time).all()
    assert ((after.pot_timer == dynamics.IDLE) | (after.pot_content > 0)).all()
    assert (dynamics.num_ingredients(after.pot_content) <= 3).all()
    assert (after.time == before.time + 1).all()
    moved = np.abs(layout.floor[after.cell] - layout.floor[before.cell]).sum(-1)
    assert moved.max() <= 1


@pytest.mark.parametrize("name", layouts.STYLED)
@hypothesis.given(actions=st.lists(ACTIONS, min_size=40, max_size=40))
@hypothesis.settings(max_examples=4)
def test_in_random_play_a_partner_never_uses_what_its_style_forbids(name, actions):
    # The ego stays, so whatever changes is the partner's doing.
    env, transitions = played(name, [(dynamics.STAY, action) for action in actions])
    layout = env.layout
    first_pot, end = layout.num_counters, layout.num_counters + layout.num_pots
    forbidden = ~np.asarray(env.styles.targets)[:, 1]
    assert forbidden.shape[0] == 8
    before, after = transitions.before, transitions.after
    for style in range(8):
        counters, pots = forbidden[style, :first_pot], forbidden[style, first_pot:end]
        unchanged = before.counters[style] == after.counters[style]
        assert unchanged[..., counters].all()
        assert (before.pot_content[style] == after.pot_content[style])[..., pots].all()
        station = transitions.interactions.station[style, ..., 1]
        used = transitions.interactions.change[style, ..., 1] != dynamics.NO_CHANGE
        assert not (used & np.append(forbidden[style], False)[station]).any()
        np.testing.assert_array_equal(before.held[style][..., 0], after.held[style][..., 0])
