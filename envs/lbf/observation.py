"""What a player sees in lbforaging 2.0.0's terms: its flat vector and its grid.

Reference: `ForagingEnv._make_gym_obs` of lbforaging 2.0.0, with its agents' levels observed.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from envs.lbf.dynamics import Rules, State

GRID_LAYERS = ("players", "foods", "free")
_BITS = 10
"""Bits of a row, a column and a level while they travel in one integer."""


def flat_size(num_players: int, num_foods: int) -> int:
    """Returns the length of the flat observation."""
    return 3 * (num_foods + num_players)


def foods_in_sight(rules: Rules, state: State) -> jax.Array:
    """Returns which foods that are still there each player sees, bool [player, food]."""
    there = jnp.broadcast_to(state.food_level > 0, (len(state.place), len(state.food_level)))
    if rules.sight is None:
        return there
    away = jnp.abs(state.food_place[None] - state.place[:, None])
    return there & jnp.all(away <= rules.sight, axis=-1)


def _packed(place: jax.Array, level: jax.Array) -> jax.Array:
    """Row, column (each plus one, so that nothing is (-1, -1)) and level in one integer."""
    return ((place[..., 0] + 1) << (2 * _BITS)) | ((place[..., 1] + 1) << _BITS) | level


def _unpacked(code: jax.Array) -> jax.Array:
    """(row, column, level) of packed entries; an empty entry is (-1, -1, 0); int32 [..., 3]."""
    mask = (1 << _BITS) - 1
    parts = ((code >> (2 * _BITS)) - 1, ((code >> _BITS) & mask) - 1, code & mask)
    return jnp.stack(parts, axis=-1)


def _in_order(code: jax.Array, rank: jax.Array, chosen: jax.Array) -> jax.Array:
    """Puts the chosen entries at their ranks and nothing in the places behind; [..., entry]."""
    slots = np.arange(code.shape[-1])
    at_slot = chosen[..., None, :] & (rank[..., None, :] == slots[:, None])
    return jnp.sum(jnp.where(at_slot, code[..., None, :], 0), axis=-1)


def _window_start(rules: Rules, state: State) -> jax.Array:
    """The first row and column that each player sees, int32 [player, 2]."""
    if rules.sight is None:
        return jnp.zeros_like(state.place)
    return jnp.maximum(state.place - rules.sight, 0)


def flat(rules: Rules, state: State) -> jax.Array:
    """Returns each player's flat observation, int32 [player, 3 * (food + player)].

    (row, column, level) of each food in sight, from the top left row by row, then of the player
    itself, then of the others in sight; places that are left over hold (-1, -1, 0). Rows and
    columns count from the first that the player sees. As in the reference, a player less than
    `sight` from the upper or left border sees other players up to 2 * sight from that border.
    """
    num_players = len(state.place)
    start = _window_start(rules, state)
    key = state.food_place[:, 0] * rules.columns + state.food_place[:, 1]
    earlier = key[None, :] < key[:, None]
    seen = foods_in_sight(rules, state)
    if rules.sight is None:  # all see the same
        seen, start = seen[:1], start[:1]
    rank = jnp.sum(seen[:, None, :] & earlier, axis=-1)
    code = _packed(state.food_place[None] - start[:, None], state.food_level)
    foods = _in_order(code, rank, seen)
    foods = jnp.broadcast_to(foods, (num_players, foods.shape[1]))

    # The player itself comes first, the others follow in their own order.
    order = np.array(
        [[p, *(q for q in range(num_players) if q != p)] for p in range(num_players)], np.int32
    )
    place = jnp.stack([jnp.stack([state.place[q] for q in row]) for row in order])
    level = jnp.stack([jnp.stack([state.level[q] for q in row]) for row in order])
    place -= start[:, None]
    code = _packed(place, level)
    if rules.sight is not None:
        visible = jnp.all((place >= 0) & (place <= 2 * rules.sight), axis=-1)
        rank = jnp.cumsum(visible, axis=1) - visible
        code = _in_order(code, rank, visible)
    entries = _unpacked(jnp.concatenate([foods, code], axis=1))
    return entries.reshape(num_players, -1)


def grid(rules: Rules, state: State) -> jax.Array:
    """Returns each player's grid observation, int8 [player, 3, 2 * reach + 1, 2 * reach + 1].

    Layers are named by `GRID_LAYERS`: levels of players, levels of foods, 1 where a cell can be
    entered; the player itself is in the centre, and what lies outside the field is 0. Two
    players on one cell show the level of the later one, as in the reference.
    """
    # The barriers keep XLA on a CPU from computing what is small anew for every cell.
    barrier = jax.lax.optimization_barrier
    window = np.arange(2 * rules.reach + 1) - rules.reach

    def bands(place: jax.Array, level: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of each thing in each player's window: its row, all bits set, and its column, its level.

        Where both are, their bitwise and is the level: int8 [player, thing, side] twice.
        """
        away = place - state.place[:, None]
        row = -(away[..., :1] == window).astype(jnp.int8)
        return row, jnp.where(away[..., 1:] == window, level[:, None], 0).astype(jnp.int8)

    def layer(row: jax.Array, column: jax.Array) -> jax.Array:
        """All things in the window, which lie on different cells, int8 [player, side, side]."""
        things = (row[:, k, :, None] & column[:, k, None, :] for k in range(row.shape[1]))
        return functools.reduce(jnp.bitwise_or, things)

    same_cell = jnp.all(state.place[:, None] == state.place, axis=-1)
    covered = jnp.any(jnp.triu(same_cell, 1), axis=1)
    of_players = bands(state.place, jnp.where(covered, 0, state.level))
    of_foods = bands(state.food_place, state.food_level)
    of_players, of_foods = barrier((of_players, of_foods))
    players, foods = barrier((layer(*of_players), layer(*of_foods)))
    row, column = (state.place[:, axis, None] + window for axis in (0, 1))
    row_inside = -((row >= 0) & (row < rules.rows)).astype(jnp.int8)
    column_inside = ((column >= 0) & (column < rules.columns)).astype(jnp.int8)
    row_inside, column_inside = barrier((row_inside, column_inside))
    field = row_inside[:, :, None] & column_inside[:, None, :]
    free = field & jnp.equal(players | foods, 0).astype(jnp.int8)
    return jnp.stack([players, foods, free], axis=1)
