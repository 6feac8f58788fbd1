"""The engine's rules on small drawn fields, its grid observation, and random fields."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.lbf import dynamics, observation
from envs.lbf.dynamics import EAST, LOAD, NONE, NORTH, SOUTH, WEST, Rules, State
from envs.lbf.spawn import Spawning, random_field

STEP = jax.jit(dynamics.step, static_argnums=0)
GRID = jax.jit(observation.grid, static_argnums=0)
SPAWN = jax.jit(random_field, static_argnums=(1, 2))


def drawn_field(*rows: str, levels: str = "1" * 9) -> tuple[Rules, State]:
    """A field from rows of text: digits are foods, letters players (a is player 0), . nothing."""
    cells = np.array([list(row) for row in rows])
    players = sorted(letter for letter in cells.ravel() if letter.isalpha())
    foods = [(int(cells[cell]), cell) for cell in np.ndindex(*cells.shape) if cells[cell].isdigit()]
    state = State(
        place=jnp.array([np.argwhere(cells == letter)[0] for letter in players], jnp.int32),
        level=jnp.array([int(level) for level in levels[: len(players)]], jnp.int32),
        food_place=jnp.array([cell for _, cell in foods], jnp.int32).reshape(-1, 2),
        food_level=jnp.array([level for level, _ in foods], jnp.int32),
        time=jnp.int32(0),
        food_total=jnp.int32(sum(level for level, _ in foods)),
    )
    return Rules(rows=cells.shape[0], columns=cells.shape[1]), state


def moved(field, *actions) -> list[tuple[int, int]]:
    rules, state = field
    after = STEP(rules, state, jnp.array(actions)).after
    assert int(after.time) == 1
    return [tuple(place) for place in after.place.tolist()]


def test_borders_and_foods_stop_a_player():
    field = drawn_field("a.2", "..b", "c..")
    assert moved(field, NORTH, NORTH, WEST) == [(0, 0), (1, 2), (2, 0)]
    assert moved(field, WEST, EAST, SOUTH) == [(0, 0), (1, 2), (2, 0)]
    assert moved(field, SOUTH, SOUTH, EAST) == [(1, 0), (2, 2), (2, 1)]
    assert moved(field, NONE, WEST, NORTH) == [(0, 0), (1, 1), (1, 0)]


def test_two_players_that_want_the_same_cell_stay():
    field = drawn_field("a.b", "...", ".2.")
    assert moved(field, EAST, WEST) == [(0, 0), (0, 2)]
    beside = drawn_field("ab.", "...", ".2.")
    assert moved(beside, EAST, NONE) == [(0, 0), (0, 1)]
    assert moved(beside, EAST, LOAD) == [(0, 0), (0, 1)]


def test_players_may_follow_and_swap():
    field = drawn_field("ab.", "...", "2..")
    assert moved(field, EAST, EAST) == [(0, 1), (0, 2)]
    assert moved(field, EAST, WEST) == [(0, 1), (0, 0)]


def test_a_player_enters_the_cell_of_one_that_is_kept_from_leaving_it():
    """The reference's quirk: c follows b, but b and a want the same cell and stay."""
    field = drawn_field("a.bc", "2...")
    assert moved(field, EAST, WEST, WEST) == [(0, 0), (0, 2), (0, 2)]


def test_levels_of_the_loaders_add_up_and_share_the_reward():
    rules, state = drawn_field(".a..", "b3..", "....", "...5", levels="12")
    taken = STEP(rules, state, jnp.array([LOAD, LOAD]))
    assert taken.taken.tolist() == [True, False]
    assert taken.after.food_level.tolist() == [0, 5]
    # level * food / (levels together * all food) = 1 * 3 / (3 * 8), 2 * 3 / (3 * 8)
    np.testing.assert_allclose(taken.reward, [1 / 8, 2 / 8])
    raw = dataclasses.replace(rules, normalize_reward=False)
    np.testing.assert_array_equal(STEP(raw, state, jnp.array([LOAD, LOAD])).reward, [3, 6])


def test_a_failed_load_costs_each_loader_the_penalty():
    rules, state = drawn_field(".a..", "b3..", ".c..", "....", levels="111")
    rules = dataclasses.replace(rules, penalty=0.25)
    failed = STEP(rules, state, jnp.array([LOAD, NONE, LOAD]))
    assert failed.after.food_level.tolist() == [3]
    np.testing.assert_array_equal(failed.reward, [-0.25, 0, -0.25])
    assert STEP(rules, state, jnp.array([LOAD, LOAD, LOAD])).taken.all()
    # Loading beside nothing, or what is gone, is no attempt.
    gone = state.replace(food_level=jnp.array([0]))
    np.testing.assert_array_equal(STEP(rules, gone, jnp.array([LOAD] * 3)).reward, 0)


def test_a_player_between_two_foods_loads_the_first():
    rules, state = drawn_field("1a1", "...", levels="1")
    after = STEP(rules, state, jnp.array([LOAD])).after
    assert after.food_level.tolist() == [0, 1]
    rules, state = drawn_field(".1.", ".a1", levels="1")
    assert STEP(rules, state, jnp.array([LOAD])).after.food_level.tolist() == [0, 1]


def test_the_game_is_over_when_nothing_is_left_or_the_time_is_up():
    rules, state = drawn_field(".a..", ".1..", "....", "...1", levels="1")
    assert not dynamics.nothing_left(state)
    assert dynamics.nothing_left(state.replace(food_level=jnp.zeros(2, jnp.int32)))
    assert not dynamics.time_is_up(rules, state.replace(time=jnp.int32(49)))
    assert dynamics.time_is_up(rules, state.replace(time=jnp.int32(50)))


def test_normalised_rewards_need_the_total():
    rules, state = drawn_field(".a", ".1")
    with pytest.raises(ValueError, match="food_total is None"):
        STEP(rules, state.replace(food_total=None), jnp.array([LOAD]))


def test_the_grid_observation_by_hand():
    rules, state = drawn_field("a..", ".3.", "..b", levels="12")
    near = dataclasses.replace(rules, sight=1)
    first, second = np.asarray(GRID(near, state))
    assert dict(zip(observation.GRID_LAYERS, first.tolist(), strict=True)) == {
        "players": [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        "foods": [[0, 0, 0], [0, 0, 0], [0, 0, 3]],
        "free": [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    }
    assert dict(zip(observation.GRID_LAYERS, second.tolist(), strict=True)) == {
        "players": [[0, 0, 0], [0, 2, 0], [0, 0, 0]],
        "foods": [[3, 0, 0], [0, 0, 0], [0, 0, 0]],
        "free": [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
    }
    # Without a limit the window holds the whole field wherever the player stands.
    whole = np.asarray(GRID(rules, state))
    assert whole.shape == (2, 3, 7, 7)
    np.testing.assert_array_equal(whole[0][:, 3:6, 3:6].sum(axis=(1, 2)), [3, 3, 6])
    np.testing.assert_array_equal(whole[0].sum(axis=(1, 2)), whole[1].sum(axis=(1, 2)))


@pytest.fixture(scope="module")
def fields():
    """Random fields of 10 x 8 cells, three players, four foods; NumPy, leading axis [game]."""
    draw = jax.jit(
        jax.vmap(lambda key: random_field(key, Rules(rows=10, columns=8), Spawning(3, 4, 3)))
    )
    return jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(0), 3000)))


def test_spawned_foods_keep_off_the_border_the_players_and_each_other(fields):
    food, player = fields.food_place, fields.place
    assert (fields.food_level > 0).all()
    assert food.min() == 1
    assert food[..., 0].max() == 8
    assert food[..., 1].max() == 6
    assert player.min() == 0
    assert (player.max(axis=(0, 1)) == [9, 7]).all()
    away = np.sort(np.abs(food[:, :, None] - food[:, None]), axis=-1)
    others = away[:, ~np.eye(4, dtype=bool)]
    assert (others[..., 1] > 1).all()
    assert not ((others == [0, 2]).all(axis=-1)).any()
    assert (others == [1, 2]).all(axis=-1).any()  # a knight's move apart is allowed
    assert not (food[:, :, None] == player[:, None]).all(axis=-1).any()
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (player[:, one] != player[:, other]).any(axis=-1).all()


def test_spawned_levels_are_drawn_from_their_ranges(fields):
    assert set(fields.level.ravel().tolist()) == {1, 2, 3}
    greatest = fields.level.sum(axis=1)
    assert (fields.food_level <= greatest[:, None]).all()
    assert fields.food_level.min() == 1
    assert (fields.food_level.max(axis=1) == greatest).any()
    np.testing.assert_array_equal(fields.food_total, fields.food_level.sum(axis=1))


def test_places_are_drawn_evenly(fields):
    """The first player and the first food have all cells that are free for them."""
    counts = np.zeros((10, 8), int)
    np.add.at(counts, tuple(fields.place[:, 0].T), 1)
    assert abs(counts - 3000 / 80).max() < 6 * np.sqrt(3000 / 80)
    counts = np.zeros((10, 8), int)
    np.add.at(counts, tuple(fields.food_place[:, 0].T), 1)
    inner = counts[1:-1, 1:-1]
    assert inner.sum() == 3000
    assert abs(inner - 3000 / 48).max() < 6 * np.sqrt(3000 / 48)


def test_forced_cooperation_gives_every_food_the_greatest_level():
    rules, key = Rules(rows=8, columns=8), jax.random.key(4)
    state = SPAWN(key, rules, Spawning(4, 3, force_coop=True))
    lowest = sorted(state.level.tolist())[:3]
    assert state.food_level.tolist() == [sum(lowest)] * 3
    capped = SPAWN(key, rules, Spawning(2, 3, max_food_level=7, force_coop=True))
    assert capped.food_level.tolist() == [7, 7, 7]
    again = SPAWN(key, rules, Spawning(2, 3, max_food_level=7, force_coop=True))
    jax.tree.map(np.testing.assert_array_equal, capped, again)


def test_foods_without_room_are_left_out():
    state = SPAWN(jax.random.key(0), Rules(rows=4, columns=4), Spawning(1, 6))
    there = np.asarray(state.food_level > 0)
    assert 1 <= there.sum() < 6
    assert (np.asarray(state.food_place)[~there] == -1).all()
    assert int(state.food_total) == int(state.food_level.sum())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rules(rows=0, columns=3), "rows is 0"),
        (lambda: Rules(rows=3, columns=2000), "columns is 2000"),
        (lambda: Rules(rows=3, columns=3, sight=-1), "sight is -1"),
        (lambda: Rules(rows=3, columns=3, penalty=-0.1), "penalty is -0.1"),
        (lambda: Spawning(num_foods=0), "num_foods is 0"),
        (
            lambda: random_field(jax.random.key(0), Rules(rows=1, columns=1), Spawning()),
            "num_players is 2",
        ),
    ],
)
def test_wrong_rules_are_refused(make, message):
    with pytest.raises(ValueError, match=f"{message}.*expected"):
        make()
