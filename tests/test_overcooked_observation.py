"""Both observations against independent ones: features in NumPy, the grid by hand."""

import dataclasses

import jax
import numpy as np
import pytest

import envs
from envs.overcooked import dynamics, layouts, observation
from envs.overcooked.dynamics import State

MAX_STEPS = 400
SOUP_OF_THREE_ONIONS = dynamics.SOUP + 12


def random_states(layout, size, seed=0) -> State:
    """Moments of games with all kinds of things in all places; leading axis [size]."""
    random = np.random.default_rng(seed)
    contents = np.array([0, 4, 8, 12] + [1, 2, 3, 5, 6, 9] * layout.has_tomatoes)
    items = np.array([0, 0, 1, 3, *(dynamics.SOUP + contents[1:])] + [2] * layout.has_tomatoes)
    content = random.choice(contents, (size, layout.num_pots))
    timer = random.integers(dynamics.IDLE, layout.cook_time + 1, content.shape)
    leaves = {
        "cell": [random.permutation(len(layout.floor))[:2] for _ in range(size)],
        "orientation": random.integers(0, 4, (size, 2)),
        "held": random.choice(items, (size, 2)),
        "counters": random.choice(items, (size, layout.num_counters)),
        "pot_content": content,
        "pot_timer": np.where(content > 0, timer, dynamics.IDLE),
        "time": random.integers(0, MAX_STEPS + 1, size),
    }
    return State(**{name: np.array(leaf, np.int32) for name, leaf in leaves.items()})


def item_features(layout, item) -> list[float]:
    onions, tomatoes = divmod(item - dynamics.SOUP, 4) if item >= dynamics.SOUP else (0, 0)
    flags = [item == dynamics.ONION, item == dynamics.TOMATO, item == dynamics.DISH]
    amounts = [item >= dynamics.SOUP, onions / 3, tomatoes / 3]
    if not layout.has_tomatoes:
        del flags[1], amounts[2]
    return [*flags, *amounts]


def expected_features(layout, state, agent) -> dict[str, list[float]]:
    """One state's features, from coordinates and letters rather than from tables."""
    other = 1 - agent
    steps = ((0, -1), (0, 1), (1, 0), (-1, 0))
    place = layout.floor[state.cell[agent]]
    x, y = place + steps[state.orientation[agent]]
    letter = layout.terrain[y][x]
    found = np.flatnonzero((layout.stations == (x, y)).all(axis=1))
    item, ready = dynamics.NO_ITEM, False
    if letter == "X":
        item = int(state.counters[found[0]])
    elif letter == "P":
        pot = found[0] - layout.num_counters
        content = int(state.pot_content[pot])
        item = dynamics.SOUP + content if content else dynamics.NO_ITEM
        ready = state.pot_timer[pot] == layout.cook_time
    pots = []
    for content, timer in zip(state.pot_content, state.pot_timer, strict=True):
        cooking = 0 <= timer < layout.cook_time
        left = (layout.cook_time - timer) / layout.cook_time if timer >= 0 else 0
        pots += [content // 4 / 3, content % 4 / 3, cooking, timer == layout.cook_time, left]

    def one_hot(index, size):
        return [float(index == i) for i in range(size)]

    return {
        "own_cell": one_hot(state.cell[agent], len(layout.floor)),
        "other_cell": one_hot(state.cell[other], len(layout.floor)),
        "own_orientation": one_hot(state.orientation[agent], 4),
        "other_orientation": one_hot(state.orientation[other], 4),
        "own_held": item_features(layout, int(state.held[agent])),
        "other_held": item_features(layout, int(state.held[other])),
        "faced_kind": one_hot("XPOTDS ".index(letter), 7),
        "faced_item": item_features(layout, item),
        "faced_ready": [ready],
        "faced_other": [tuple(layout.floor[state.cell[other]]) == (x, y)],
        "pots": pots,
        "counters": [v for c in state.counters for v in item_features(layout, int(c))],
        "time_left": [1 - state.time / MAX_STEPS],
    }


@pytest.mark.parametrize("kitchen", ["counter_circuit", "diverse_orders"])
def test_features_match_numpy(kitchen):
    layout = layouts.load_layout(kitchen)
    states = random_states(layout, 100)
    slices = observation.feature_slices(layout)
    for agent in (0, 1):
        encode = jax.jit(
            jax.vmap(lambda s, agent=agent: observation.features(layout, s, agent, MAX_STEPS))
        )
        encoded = np.asarray(encode(states))
        assert encoded.shape == (100, observation.num_features(layout))
        for index in range(100):
            state = jax.tree.map(lambda leaf, index=index: leaf[index], states)
            expected = expected_features(layout, state, agent)
            assert expected.keys() == slices.keys()
            for name, values in expected.items():
                np.testing.assert_allclose(
                    encoded[index, slices[name]], values, atol=1e-6, err_msg=name
                )


# Two pots, so that one cooks and one waits; the counter at (1, 3) is reachable.
KITCHEN = "XPPXX\nO1 2S\nT   D\nXXXXX"


def kitchen_state(layout) -> State:
    """Ego at (1, 1) with a dish, facing east; partner at (3, 2) with a soup, facing south."""
    counters = np.zeros(layout.num_counters, np.int32)
    lying = {(3, 0): dynamics.ONION, (1, 3): dynamics.TOMATO, (3, 3): dynamics.SOUP + 5}
    for place, item in lying.items():
        (station,) = np.flatnonzero((layout.stations == place).all(axis=1))
        counters[station] = item
    return State(
        cell=np.array([layout.floor_index(1, 1), layout.floor_index(3, 2)], np.int32),
        orientation=np.array([2, 1], np.int32),
        held=np.array([dynamics.DISH, SOUP_OF_THREE_ONIONS], np.int32),
        counters=counters,
        # Pot (1, 0) waits with 2 onions and 1 tomato, (2, 0) has cooked 3 tomatoes for 5 steps.
        pot_content=np.array([9, 3], np.int32),
        pot_timer=np.array([dynamics.IDLE, 5], np.int32),
        time=np.array(100, np.int32),
    )


# Values of every channel that is not all 0, at (x, y), for the ego.
DRAWN = {
    "own_location": {(1, 1): 1},
    "other_location": {(3, 2): 1},
    "own_orientation_east": {(1, 1): 1},
    "other_orientation_south": {(3, 2): 1},
    "pot": {(1, 0): 1, (2, 0): 1},
    "counter": dict.fromkeys([(0, 0), (3, 0), (4, 0), *((x, 3) for x in range(5))], 1),
    "onions": {(0, 1): 1},
    "tomatoes": {(0, 2): 1},
    "dishes": {(4, 2): 1},
    "serving": {(4, 1): 1},
    "onions_in_pot": {(1, 0): 2},
    "tomatoes_in_pot": {(1, 0): 1},
    "onions_in_soup": {(3, 2): 3, (3, 3): 1},
    "tomatoes_in_soup": {(2, 0): 3, (3, 3): 1},
    "cooking_time_left": {(2, 0): 15},
    "soup_ready": {(3, 2): 1, (3, 3): 1},
    "dish": {(1, 1): 1},
    "onion": {(3, 0): 1},
    "tomato": {(1, 3): 1},
}


def drawn_grid(drawn) -> np.ndarray:
    grid = np.zeros((5, 4, 26))
    for channel, values in drawn.items():
        for (x, y), value in values.items():
            grid[x, y, observation.GRID_CHANNELS.index(channel)] = value
    return grid


def assert_same_grid(grid, expected):
    assert grid.dtype == np.uint8
    for index, channel in enumerate(observation.GRID_CHANNELS):
        np.testing.assert_array_equal(grid[..., index], expected[..., index], err_msg=channel)


def test_grid_of_a_drawn_kitchen():
    layout = layouts.parse_layout("drawn", KITCHEN)
    state = kitchen_state(layout)
    assert_same_grid(observation.grid(layout, state, 0, MAX_STEPS), drawn_grid(DRAWN))
    swapped = {
        name.replace("own_", "OTHER_").replace("other_", "own_").replace("OTHER_", "other_"): value
        for name, value in DRAWN.items()
    }
    assert_same_grid(observation.grid(layout, state, 1, MAX_STEPS), drawn_grid(swapped))


@pytest.mark.parametrize(("time", "urgent"), [(360, 0), (361, 1), (400, 1)])
def test_grid_is_urgent_when_less_than_forty_steps_are_left(time, urgent):
    layout = layouts.parse_layout("drawn", KITCHEN)
    state = kitchen_state(layout).replace(time=np.array(time, np.int32))
    expected = drawn_grid(DRAWN)
    expected[..., -1] = urgent
    assert_same_grid(observation.grid(layout, state, 0, MAX_STEPS), expected)


def test_grid_of_a_ready_pot():
    layout = layouts.parse_layout("drawn", KITCHEN)
    state = kitchen_state(layout).replace(pot_timer=np.array([dynamics.IDLE, 20], np.int32))
    drawn = DRAWN | {"cooking_time_left": {}, "soup_ready": DRAWN["soup_ready"] | {(2, 0): 1}}
    assert_same_grid(observation.grid(layout, state, 0, MAX_STEPS), drawn_grid(drawn))


def test_cook_time_of_the_kitchen_is_shown():
    layout = dataclasses.replace(layouts.parse_layout("drawn", KITCHEN), cook_time=7)
    grid = observation.grid(layout, kitchen_state(layout), 0, MAX_STEPS)
    assert grid[2, 0, observation.GRID_CHANNELS.index("cooking_time_left")] == 2


def test_batched_grids_are_the_single_ones():
    layout = layouts.load_layout("cramped_room")
    states = random_states(layout, 5)
    batched = jax.jit(jax.vmap(lambda s: observation.grid(layout, s, 1, MAX_STEPS)))(states)
    for index in range(5):
        state = jax.tree.map(lambda leaf, index=index: leaf[index], states)
        single = observation.grid(layout, state, 1, MAX_STEPS)
        np.testing.assert_array_equal(batched[index], single)


def test_the_environment_shows_both_encodings():
    for encoding in ("features", "grid"):
        env = envs.make("overcooked/cramped_room", encoding=encoding)
        _, first = env.reset(jax.random.key(0), env.style("free"))
        shape = (5, 4, 26) if encoding == "grid" else (env.observation_sizes.ego,)
        assert first.observation.ego.shape == first.observation.partner.shape == shape


@pytest.mark.parametrize("encoding", ["features", "grid"])
def test_out_of_sight_the_partner_is_in_no_slice_and_the_rest_stays(encoding):
    layout = layouts.load_layout("counter_circuit")
    states = random_states(layout, 60)
    kitchen = {"max_steps": MAX_STEPS, "encoding": encoding}
    everywhere = envs.make("overcooked/counter_circuit", **kitchen)
    nearby = envs.make("overcooked/counter_circuit", partner_sight=1, **kitchen)
    style = everywhere.style("free")
    full, near = (
        jax.vmap(env._observe, in_axes=(0, None))(states, style) for env in (everywhere, nearby)
    )
    # The partner's own view stays as it is.
    np.testing.assert_array_equal(near.partner, full.partner)
    place = layout.floor[np.asarray(states.cell)]
    hidden = np.abs(place[:, 0] - place[:, 1]).max(axis=1) > 1
    assert 5 < hidden.sum() < 55
    np.testing.assert_array_equal(near.ego[~hidden], full.ego[~hidden])
    seen, expected = np.asarray(near.ego)[hidden], np.array(full.ego)[hidden]
    if encoding == "features":
        for name in ("other_cell", "other_orientation", "other_held"):
            expected[:, observation.feature_slices(layout)[name]] = 0
    else:
        for index, (x, y) in enumerate(place[hidden, 1]):
            # Nothing but players and what they hold is on a floor cell.
            assert expected[index, x, y, observation.GRID_CHANNELS.index("other_location")]
            expected[index, x, y, : observation.GRID_CHANNELS.index("urgency")] = 0
    np.testing.assert_array_equal(seen, expected)


def test_a_sight_of_less_than_nothing_is_refused():
    with pytest.raises(ValueError, match="partner_sight is -1; expected 0 or more, or None"):
        envs.make("overcooked/center_pots", partner_sight=-1)
