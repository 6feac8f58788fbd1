"""Events: their names and places, and what is counted in episodes made by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_kitchen import DrawnKitchen

import envs
from envs.overcooked import dynamics, events, layouts

KITCHENS = layouts.STYLED + layouts.CLASSIC


def play(kitchen: DrawnKitchen, table, steps) -> dict[str, dict[str, float]]:
    """Plays steps ((ego, partner), ...) and sums the events by player."""
    total = np.zeros((2, len(table.names)))
    for actions in steps:
        total += np.asarray(events.count_events(table, kitchen.play(*actions)))
    return {
        player: {n: float(c) for n, c in zip(table.names, counts, strict=True) if c}
        for player, counts in zip(("ego", "partner"), total, strict=True)
    }


@pytest.mark.parametrize("name", KITCHENS)
def test_names_are_distinct_and_every_change_has_an_event(name):
    layout = layouts.load_layout(name)
    table = events.build_event_table(layout)
    assert len(set(table.names)) == len(table.names)
    assert set(table.of_cell) <= set(range(len(table.names)))
    none = len(table.names)
    onion = events.ITEM_KINDS.index("onion")
    for station, kind in enumerate(layout.kinds[:-1]):
        of = table.of_interaction[station]
        expected = {
            layouts.COUNTER: {dynamics.PUT_ON_COUNTER, dynamics.TAKEN_FROM_COUNTER},
            layouts.POT: {dynamics.POTTED, dynamics.COOKING_STARTED, dynamics.SOUP_TAKEN},
            layouts.SERVING: {dynamics.DELIVERED},
        }.get(int(kind), {dynamics.TAKEN_FROM_DISPENSER})
        assert set(np.flatnonzero((of != none).any(axis=1))) == expected
        assert of[min(expected), onion] != none
    assert (table.of_interaction[-1] == none).all(), "there is nothing beyond the stations"
    assert (table.of_interaction[:, dynamics.NO_CHANGE] == none).all()


def test_places_tell_stations_apart():
    def of(name, *prefixes):
        return {n for n in envs.make(f"overcooked/{name}").event_names if n.startswith(prefixes)}

    assert of("center_pots", "pickup_", "start_") == {
        *("pickup_onion@left", "pickup_onion@right", "pickup_dish@left", "pickup_dish@right"),
        *("start_cooking@left", "start_cooking@right"),
    }
    assert of("crossway", "pot_", "deliver_onion") == {
        *("pot_onion@upper_left", "pot_onion@upper_right", "pot_onion@lower_left"),
        *("pot_onion@lower_right", "deliver_onion_soup@left", "deliver_onion_soup@right"),
    }
    assert of("diverse_coordination", "deliver_") == {
        *("deliver_onion_soup@upper", "deliver_other_soup@upper"),
        *("deliver_onion_soup@lower", "deliver_other_soup@lower"),
    }
    numbered = {f"deliver_{what}_soup@{n}" for what in ("onion", "tomato", "other") for n in "1234"}
    assert of("diverse_orders", "deliver_") == numbered
    # A kitchen's only pot needs no place.
    assert of("cramped_room", "pot_", "pickup_dish") == {"pot_onion", "pickup_dish"}


def test_regions():
    layout = layouts.load_layout("crossway")
    assert events.region_name(layout, 3, 3) == "centre"
    assert events.region_name(layout, 3, 1) == "upper"
    assert events.region_name(layout, 0, 3) == "left"
    assert events.region_name(layout, 6, 6) == "lower_right"


def test_an_onion_soup_from_dispenser_to_serving_cell():
    layout = layouts.load_layout("cramped_room")
    kitchen, table = DrawnKitchen(layout), events.build_event_table(layout)
    kitchen.place(0, 1, 1)
    kitchen.place(1, 3, 2)
    fetch = [("west", "stay"), ("interact", "stay"), ("east", "stay"), ("north", "stay")]
    fetch += [("interact", "stay"), ("west", "stay")]
    steps = 3 * fetch + [("east", "stay"), ("north", "stay"), ("interact", "stay")]
    found = play(kitchen, table, steps)
    assert {n: c for n, c in found["ego"].items() if "stand" not in n} == {
        "pickup_onion@left": 3,
        "pot_onion": 3,
        "start_cooking": 1,
    }
    assert found["partner"] == {"stand@lower_right": len(steps)}

    kitchen.place(1, 1, 2, facing="south")
    waiting = 19 * [("stay", "stay")]
    found = play(kitchen, table, [("west", "interact"), ("stay", "north"), *waiting])
    assert found["partner"]["pickup_dish"] == 1
    kitchen.place(0, 1, 2)
    kitchen.place(1, 2, 1, held="dish")
    steps = [("stay", a) for a in ("interact", "east", "south", "south", "interact")]
    found = play(kitchen, table, steps)
    assert found["partner"]["take_soup_from_pot"] == 1
    assert found["partner"]["deliver_onion_soup"] == 1
    assert "deliver_other_soup" not in found["partner"]
    assert found["ego"] == {"stand@lower_left": 5}


def test_soups_are_counted_by_recipe_and_serving_cell():
    layout = layouts.load_layout("diverse_orders")
    table = events.build_event_table(layout)
    for x, soup, event in (
        (1, "ooo", "deliver_onion_soup@1"),
        (3, "ttt", "deliver_tomato_soup@2"),
        (5, "oot", "deliver_other_soup@3"),
        (7, "o", "deliver_other_soup@4"),
    ):
        kitchen = DrawnKitchen(layout)
        kitchen.place(0, x, 1, held=soup)
        found = play(kitchen, table, [("interact", "stay")])["ego"]
        assert {n for n in found if not n.startswith("stand")} == {event}


def test_things_on_counters_are_counted_by_object_region_and_player():
    layout = layouts.load_layout("diverse_coordination")
    table = events.build_event_table(layout)
    kitchen = DrawnKitchen(layout)
    kitchen.place(0, 1, 1, facing="south", held="dish")
    kitchen.place(1, 1, 3, facing="north")
    found = play(kitchen, table, [("interact", "stay"), ("stay", "interact")])
    assert found["ego"] == {"put_dish@left": 1, "stand@upper_left": 2}
    assert found["partner"] == {"take_dish@left": 1, "stand@lower_left": 2}


@pytest.mark.parametrize("name", ["diverse_orders", "crossway"])
def test_a_player_causes_one_region_event_a_step_and_at_most_one_other(name):
    env = envs.make(f"overcooked/{name}")
    styles = env.styles
    stands = np.array([n.startswith("stand@") for n in env.event_names])

    def game(key):
        def one_step(state, key):
            # Every second action is an interaction, so that many happen.
            action = jnp.minimum(jax.random.randint(key, (2,), 0, 10), 5)
            state, timestep = env.step(key, state, envs.Pair(action[0], action[1]), style)
            return state, timestep.events

        start = jax.tree.map(lambda leaf: leaf[-1], style.pool)
        return jax.lax.scan(one_step, start, jax.random.split(key, 300))[1]

    style = jax.tree.map(lambda leaf: leaf[0], styles)
    counts = np.asarray(jax.jit(game)(jax.random.key(0)))
    assert set(np.unique(counts)) == {0, 1}
    np.testing.assert_array_equal(counts[..., stands].sum(-1), 1)
    others = counts[..., ~stands].sum(-1)
    assert others.max() == 1
    assert others.mean() > 0.02
