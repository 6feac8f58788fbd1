"""Deliveries and shaped rewards, each term in a transition in which it fires."""

import dataclasses

import jax
import numpy as np
import pytest
from drawn_kitchen import DrawnKitchen, content_code

import envs
from envs.overcooked import dynamics, reward
from envs.overcooked.reward import ShapingWeights

WEIGHTS = ShapingWeights(
    potting=3.0,
    dish=3.0,
    soup_taken=5.0,
    unordered_soup_taken=2.0,
    start_full=1.0,
    spoilt=-1.0,
    unordered_delivery=-1.0,
    hand_over=2.0,
    way=0.0,
    bring=0.0,
)


@pytest.fixture(scope="module")
def rooms():
    """Two rooms: the ego above must give onions, the partner below cooks on the left."""
    return envs.make("overcooked/diverse_coordination", weights=WEIGHTS)


@pytest.fixture(scope="module")
def orders():
    """Two rooms with tomatoes: only the named soup at the named serving cell pays."""
    return envs.make("overcooked/diverse_orders", weights=WEIGHTS)


@pytest.fixture
def kitchen(rooms):
    return DrawnKitchen(rooms.layout, rooms.style("left_no_onion"))


def guided(env, style, transition, weights=WEIGHTS):
    return reward.guided_shaping_terms(
        env.layout,
        transition,
        pays=style.pays,
        hand_over=style.hand_over,
        welcome=style.welcome,
        way=style.way,
        weights=weights,
    )


def terms(env, style_name: str, transition) -> dict[str, list[float]]:
    """The guided shaping's terms that are not zero for both players."""
    found = guided(env, env.style(style_name), transition)
    return {name: np.asarray(v).tolist() for name, v in found.items() if np.any(np.asarray(v))}


def coordination_terms(rooms, transition) -> dict[str, list[float]]:
    return terms(rooms, "left_no_onion", transition)


def test_potting_what_an_order_needs_pays_three(rooms, kitchen):
    kitchen.place(1, 2, 3, facing="south", held="onion")
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == {"potting": [0, 3]}


def test_potting_what_spoils_the_soup_costs_one(orders):
    kitchen = DrawnKitchen(orders.layout, orders.style("onion_2"))
    kitchen.place(0, 2, 1, facing="south", held="tomato")
    assert terms(orders, "onion_2", kitchen.play("interact")) == {"spoilt": [-1, 0]}
    kitchen.place(0, 2, 1, facing="south", held="onion")
    spoilt_already = terms(orders, "onion_2", kitchen.play("interact"))
    assert spoilt_already == {"spoilt": [-1, 0]}
    # The same tomato is right for another style.
    kitchen = DrawnKitchen(orders.layout, orders.style("tomato_2"))
    kitchen.place(0, 2, 1, facing="south", held="tomato")
    assert terms(orders, "tomato_2", kitchen.play("interact")) == {"potting": [3, 0]}


def test_a_dish_is_worth_three_while_a_pot_waits_for_one(rooms, kitchen):
    kitchen.place(1, 3, 3, facing="south")
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == {}
    kitchen.place(1, 3, 3, facing="south")
    kitchen.fill(2, 4, "ooo", timer=4)
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == {"dish": [0, 3]}
    # One dish is under way for the only waiting pot.
    kitchen.place(0, 3, 1, facing="north")
    assert coordination_terms(rooms, kitchen.play("interact")) == {}


def test_a_dish_on_a_counter_makes_another_one_useless(rooms, kitchen):
    kitchen.fill(2, 4, "ooo", timer=4)
    kitchen.lay(4, 2, "dish")
    kitchen.place(1, 3, 3, facing="south")
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == {}


@pytest.mark.parametrize(("inside", "expected"), [("ooo", {"start_full": [0, 1]}), ("oo", {})])
def test_starting_pays_one_for_an_ordered_soup_only(rooms, kitchen, inside, expected):
    kitchen.fill(2, 4, inside)
    kitchen.place(1, 2, 3, facing="south")
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == expected


@pytest.mark.parametrize(
    ("inside", "expected"),
    [("ooo", {"soup_taken": [0, 5]}), ("o", {"unordered_soup_taken": [0, 2]})],
)
def test_taking_a_soup_pays_five_if_ordered_else_two(rooms, kitchen, inside, expected):
    kitchen.fill(2, 4, inside, timer=20)
    kitchen.place(1, 2, 3, facing="south", held="dish")
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == expected


def test_deliveries_pay_by_style_and_only_what_nobody_orders_is_fined(orders):
    style = orders.style("onion_2")
    for x, soup, pays in ((3, "ooo", 20), (1, "ooo", 0), (3, "ttt", 0), (3, "oo", 0)):
        kitchen = DrawnKitchen(orders.layout, style)
        kitchen.place(0, x, 1, facing="north", held=soup)
        transition = kitchen.play("interact")
        paid = reward.delivery_reward(orders.layout, transition.interactions, style.pays)
        assert np.asarray(paid).tolist() == [pays, 0], (x, soup)
        expected = {"unordered_delivery": [-1, 0]} if soup == "oo" else {}
        assert terms(orders, "onion_2", transition) == expected
        assert kitchen.held(0) == 0, "the soup is gone either way"


def test_handing_over_pays_the_giver_and_the_taker(rooms, kitchen):
    kitchen.place(0, 2, 1, facing="south", held="onion")
    kitchen.place(1, 2, 3, facing="north")
    assert coordination_terms(rooms, kitchen.play("interact")) == {"hand_over": [2, 0]}
    assert coordination_terms(rooms, kitchen.play("stay", "interact")) == {"hand_over": [0, 2]}


def test_junk_on_a_shared_counter_costs_and_elsewhere_does_not(rooms, kitchen):
    kitchen.place(0, 2, 1, facing="south", held="dish")
    junk = coordination_terms(rooms, kitchen.play("interact"))
    assert junk["hand_over"][0] < 0
    assert junk["hand_over"][1] == 0
    # The partner of this style reaches counters x 1 to 3 only, so (5, 2) is nobody's.
    kitchen.place(0, 5, 1, facing="south", held="dish")
    assert coordination_terms(rooms, kitchen.play("interact")) == {}


def test_nothing_is_earned_by_putting_down_and_taking_back(rooms, orders):
    for env, name in ((rooms, "left_no_onion"), (rooms, "left_no_delivery"), (orders, "onion_2")):
        for item in ("onion", "dish", "ooo"):
            for agent, row, facing in ((0, 1, "south"), (1, 3, "north")):
                kitchen = DrawnKitchen(env.layout, env.style(name))
                kitchen.place(agent, 3, row, facing=facing, held=item)
                action = [("interact", "stay"), ("stay", "interact")][agent]
                earned = [terms(env, name, kitchen.play(*action)) for _ in range(2)]
                assert set(earned[0]) <= {"hand_over"}
                total = sum(np.array(e.get("hand_over", [0, 0])) for e in earned)
                np.testing.assert_array_equal(total, 0, err_msg=f"{name}: {item} by {agent}")


def test_nothing_is_earned_by_passing_a_thing_round(rooms, kitchen):
    kitchen.place(0, 2, 1, facing="south", held="onion")
    kitchen.place(1, 2, 3, facing="north")
    total = np.zeros(2)
    # Ego puts, partner takes, partner puts, ego takes: all is as before.
    for actions in (("interact", "stay"), *2 * [("stay", "interact")], ("interact", "stay")):
        total += coordination_terms(rooms, kitchen.play(*actions)).get("hand_over", [0, 0])
    assert kitchen.held(0) == 1
    np.testing.assert_array_equal(total, 0)


def test_further_things_are_in_the_way_where_several_kinds_share_the_counters(orders):
    style = orders.style("onion_2")
    kitchen = DrawnKitchen(orders.layout, style)
    assert float(style.welcome[2]) == 1
    for x, worth in ((3, 1.0), (4, reward.IN_THE_WAY)):
        kitchen.place(1, x, 3, facing="north", held="dish")
        put = terms(orders, "onion_2", kitchen.play("stay", "interact"))
        assert put == {"hand_over": [0, 2 * worth]}
    # Taking the second back returns its price, whichever of the two is taken first.
    kitchen.place(1, 3, 3, facing="north")
    taken = terms(orders, "onion_2", kitchen.play("stay", "interact"))
    assert taken == {"hand_over": [0, -2 * reward.IN_THE_WAY]}


def test_every_guided_term_was_seen_in_these_tests(rooms, kitchen):
    """Fails when a term is added without a transition in which it fires."""
    found = guided(rooms, rooms.style("left_no_onion"), kitchen.play())
    assert set(found) == {
        *("potting", "spoilt", "dish", "start_full", "soup_taken"),
        *("unordered_soup_taken", "unordered_delivery", "hand_over", "way", "bring"),
    }


@pytest.fixture(scope="module")
def crossway():
    return envs.make("overcooked/crossway")


def way_term(crossway, kitchen, *actions) -> list[float]:
    style = crossway.style("upper_no_dish")
    weights = dataclasses.replace(WEIGHTS, way=0.5)
    return np.asarray(guided(crossway, style, kitchen.play(*actions), weights)["way"]).tolist()


def in_the_upper_arm(crossway) -> DrawnKitchen:
    """The ego at the centre with a dish; the partner at the arm's end, where a soup cooks."""
    kitchen = DrawnKitchen(crossway.layout, crossway.style("upper_no_dish"))
    kitchen.fill(2, 1, "ooo", timer=3)
    kitchen.place(0, 3, 3, held="dish")
    kitchen.place(1, 3, 1)
    return kitchen


def test_walking_to_a_cooking_pot_with_a_dish_pays_both_for_each_step(crossway):
    kitchen = in_the_upper_arm(crossway)
    kitchen.place(1, 4, 3)
    # From the centre it is two steps to the pot; each is worth one half.
    assert way_term(crossway, kitchen, "north", "stay") == [0.5, 0.5]
    assert way_term(crossway, kitchen, "south", "stay") == [-0.5, -0.5]


def test_leaving_the_arm_clears_the_way_and_entering_it_blocks_it(crossway):
    kitchen = in_the_upper_arm(crossway)
    kitchen.place(0, 3, 4, held="dish")
    kitchen.place(1, 3, 3)
    # The partner at the centre blocks the way (12 steps); beside it, three steps are left.
    assert way_term(crossway, kitchen, "stay", "west") == [4.5, 4.5]
    kitchen.place(1, 2, 3)
    assert way_term(crossway, kitchen, "stay", "east") == [-4.5, -4.5]


def test_the_way_pays_nothing_without_a_load_or_a_place_for_it(crossway):
    kitchen = in_the_upper_arm(crossway)
    kitchen.place(1, 4, 3)
    kitchen.place(0, 3, 3)
    assert way_term(crossway, kitchen, "north", "stay") == [0, 0]
    kitchen.place(0, 3, 3, held="dish")
    kitchen.fill(2, 1, "ooo")
    assert way_term(crossway, kitchen, "north", "stay") == [0, 0], "nobody started the pot"


def test_a_soup_is_carried_to_where_it_pays(crossway):
    kitchen = in_the_upper_arm(crossway)
    kitchen.place(0, 3, 3, held="ooo")
    assert way_term(crossway, kitchen, "west", "stay") == [0.5, 0.5]
    kitchen.place(0, 3, 3, held="oo")
    assert way_term(crossway, kitchen, "west", "stay") == [0, 0], "nobody ordered it"


def bring_term(orders, kitchen, held, action) -> list[float]:
    """The term for a step of the ego in the middle, two steps from either pot."""
    kitchen.place(0, 4, 1, held=held)
    weights = dataclasses.replace(WEIGHTS, bring=0.5)
    style = orders.style("onion_2")
    return np.asarray(guided(orders, style, kitchen.play(action), weights)["bring"]).tolist()


def test_an_ingredient_is_brought_to_the_nearest_pot_that_takes_it(orders):
    kitchen = DrawnKitchen(orders.layout, orders.style("onion_2"))
    kitchen.place(1, 4, 3)
    # Only the carrier is paid.
    assert bring_term(orders, kitchen, "onion", "west") == [0.5, 0]
    assert bring_term(orders, kitchen, "onion", "east") == [0.5, 0]
    for content, timer in (("ooo", 3), ("ooo", dynamics.IDLE), ("t", dynamics.IDLE)):
        kitchen.fill(2, 2, content, timer)
        assert bring_term(orders, kitchen, "onion", "west") == [-0.5, 0], content
        assert bring_term(orders, kitchen, "onion", "east") == [0.5, 0], content
    kitchen.fill(2, 2, "oo")
    assert bring_term(orders, kitchen, "onion", "west") == [0.5, 0]
    for useless in ("tomato", "dish", ""):
        assert bring_term(orders, kitchen, useless, "west") == [0, 0], useless


def test_reference_shaping_pays_any_potting_dish_and_soup(orders):
    kitchen = DrawnKitchen(orders.layout, orders.style("onion_2"))
    layout = orders.layout

    def shaped(*actions):
        return np.asarray(reward.reference_shaping(layout, kitchen.play(*actions))).tolist()

    kitchen.place(0, 2, 1, facing="south", held="tomato")
    kitchen.place(1, 3, 3, facing="south")
    assert shaped("interact", "stay") == [3, 0], "a tomato that nobody ordered"
    assert shaped("stay", "interact") == [0, 3], "a dish for the pot that is partly filled"
    kitchen.fill(2, 2, "t", timer=20)
    kitchen.place(1, 2, 3, facing="north", held="dish")
    assert shaped("stay", "interact") == [0, 5], "a soup of one tomato"
    kitchen.place(0, 3, 1, facing="north", held="t")
    assert shaped("interact", "stay") == [0, 0], "deliveries are no shaped reward"


def test_the_environment_adds_the_terms_up_or_takes_the_reference(rooms, kitchen):
    reference = envs.make("overcooked/diverse_coordination", shaping="reference")
    key = jax.random.key(0)
    style = rooms.style("left_no_onion")
    kitchen.place(0, 2, 1, facing="south", held="onion")
    kitchen.place(1, 2, 3, facing="south", held="onion")
    actions = envs.Pair(np.int32(5), np.int32(5))
    _, guided = jax.jit(rooms.step)(key, kitchen.state, actions, style)
    _, plain = jax.jit(reference.step)(key, kitchen.state, actions, style)
    assert np.asarray(guided.shaped_reward).tolist() == [2, 3]
    assert np.asarray(plain.shaped_reward).tolist() == [0, 3]
    assert float(guided.reward) == 0


def test_what_a_content_can_still_become():
    onions = reward.reachable_values(reward.order_values((12,)))
    both = reward.reachable_values(reward.order_values((12, 3)))
    for content in ("", "o", "oo", "ooo"):
        assert onions[content_code(content)] == 20
        assert both[content_code(content)] == 20
    for content in ("t", "tt", "ttt"):
        assert onions[content_code(content)] == 0
        assert both[content_code(content)] == 20
    for content in ("ot", "oot", "ott"):
        assert onions[content_code(content)] == both[content_code(content)] == 0
