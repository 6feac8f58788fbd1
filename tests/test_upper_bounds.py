"""Upper bounds against kitchens counted by hand, and against a cook by script in the game."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.overcooked import bounds, layouts, pot_times, prices, relaxation
from envs.overcooked.env import Overcooked

# The ego does everything from one cell; the partner reaches only dishes. The ego faces the pot.
# An ingredient takes four steps: turn, take, turn, put. Starting the pot takes one.
ALONE = layouts.parse_layout("alone", "XPXXX\nO1D2X\nXSXXX")


def kitchen(max_steps: int, cook_time: int = 20) -> Overcooked:
    return Overcooked(layout=dataclasses.replace(ALONE, cook_time=cook_time), max_steps=max_steps)


def relaxed(env: Overcooked, style: str = "free"):
    return relaxation.relax(env.layout, env.style(style), max_steps=env.max_steps)


def test_times_of_the_pot_counted_by_hand():
    # Ingredients in steps 3, 7, 11, the start in 12, the soup in 32, its delivery in 34. After a
    # soup is taken: two steps to deliver it, three times four to fill, one to start, 20 to cook.
    (limits,) = pot_times.pot_times(relaxed(kitchen(400)).market, 400)
    assert limits.first_soup == 32
    assert limits.turns == 1 + (397 - 32) // 35


def test_counters_are_empty_at_first_and_a_soup_lies_in_the_way():
    # left_no_dish of diverse_coordination: the partner alone reaches the pot, and onions two cells
    # beside it. It walks three steps, turns, takes, steps back, turns and pots in step 7; further
    # onions may come over the counter, one in four steps: 7, 11, 15, the start in 16.
    env = envs.make("overcooked/diverse_coordination")
    limits, out_of_reach = pot_times.pot_times(relaxed(env, "left_no_dish").market, 400)
    assert limits.first_soup == 36
    assert out_of_reach.turns == 0
    # After a soup is taken: to the wall, the soup on it, turn, an onion, back, turn, pot: 7 steps,
    # 11, 15, the start in 16, 20 to cook. A delivery takes four steps.
    assert limits.turns == 1 + (395 - 36) // 36 == 10
    # Without onions of its own, the first one comes over the counter two steps later: the ego
    # walks three steps, turns, takes, turns and puts it down in step 6; three steps to the pot.
    limits, _ = pot_times.pot_times(relaxed(env, "left_no_onion").market, 400)
    assert limits.first_soup == 38


@pytest.mark.parametrize(("max_steps", "soups"), [(104, 2), (105, 3), (400, 11)])
def test_a_pot_that_cooks_long_limits_the_soups(max_steps, soups):
    # Deliveries in steps 34, 69, 104, …
    assert kitchen(max_steps).upper_bounds() == {"free": 20.0 * soups}


@pytest.mark.parametrize(("max_steps", "soups"), [(100, 5), (120, 6)])
def test_a_pot_that_cooks_fast_leaves_the_cook_as_the_limit(max_steps, soups):
    # Twelve steps for three ingredients, one for the start, two for a dish, two for the soup, two
    # for its delivery: deliveries in steps 18, 37, 56, 75, 94, 113.
    assert kitchen(max_steps, cook_time=2).upper_bounds() == {"free": 20.0 * soups}


# From facing north with empty hands to the delivery, 35 steps in which the ego never idles but for
# the soup that cooks: north 0, south 1, east 2, west 3, stay 4, interact 5.
ONE_SOUP = [3, 5, 0, 5] * 3 + [5, 2, 5, 0] + [4] * 16 + [5, 1, 5]


def earned_by_the_script(env: Overcooked) -> float:
    """Plays the cook's script over and over; the partner stays."""
    style = env.style("free")

    def step(state, action):
        after, timestep = env.step(jax.random.key(0), state, envs.Pair(action, 4), style)
        return after, timestep.reward

    actions = np.resize(ONE_SOUP, env.max_steps)
    state, _ = env.reset(jax.random.key(0), style)
    return float(jax.jit(lambda s: jax.lax.scan(step, s, jnp.asarray(actions)))(state)[1].sum())


@pytest.mark.parametrize("max_steps", [104, 105])
def test_a_cook_by_script_earns_the_bound_of_its_kitchen_in_the_game(max_steps):
    env = kitchen(max_steps)
    assert earned_by_the_script(env) == env.upper_bounds()["free"]


def test_any_prices_give_a_bound_and_the_steady_ones_a_low_one():
    relaxation_ = relaxed(kitchen(105))
    count = len(relaxation_.allowance)
    random = np.random.default_rng(0)
    anyhow = [bounds.market_bound(relaxation_, 5 * random.random(count)) for _ in range(3)]
    steady = bounds.market_bound(relaxation_, prices.steady_prices(relaxation_))
    assert all(60.0 <= steady <= bound for bound in anyhow)


@pytest.mark.parametrize("name", layouts.STYLED)
def test_the_first_and_last_style_have_positive_bounds(name):
    env = envs.make(f"overcooked/{name}", max_steps=100)
    for style in (env.style_names[0], env.style_names[-1]):
        found = bounds.upper_bound(env.layout, env.style(style), max_steps=100, old_dynamics=False)
        assert 20 <= found <= 20 * 16
        assert found % 20 == 0


def test_a_target_of_spread_pays_once():
    env = envs.make("lbf/spread")
    assert env.upper_bounds() == dict.fromkeys(env.style_names, 1.0)


def test_bounds_are_rounded_down_only_where_all_soups_pay_the_same():
    assert bounds.whole_soups(59.9, np.array([0.0, 20.0])) == 40.0
    # What sums of 32 bits may have lost is given back first.
    assert bounds.whole_soups(59.99, np.array([0.0, 20.0])) == 60.0
    assert bounds.whole_soups(59.9, np.array([20.0, 15.0])) == 59.9
