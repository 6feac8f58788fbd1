"""Spread's field: where foods and players start, and random moments to train from."""

import jax
import jax.numpy as jnp
import numpy as np

from envs.lbf.dynamics import State

SIZE = 9
"""Rows and columns of the field."""
NUM_FOODS = 8
PLAYER_LEVEL = 4
PLACES = np.array([(0, 0), (0, 4), (0, 8), (4, 0), (4, 8), (8, 0), (8, 4), (8, 8)], np.int32)
"""Where the foods lie: corners and edge centres, row by row, int32 [place, 2]."""
PLACE_NAMES = (
    *("north_west", "north", "north_east", "west"),
    *("east", "south_west", "south", "south_east"),
)
LEAST_TIME_LEFT = 10
"""Steps that a random moment leaves at least."""
TAKEN_SHARE = 0.3
"""Share of the foods other than the target that are gone in a random moment."""

_CENTRE = np.array([(row, column) for row in (3, 4, 5) for column in (3, 4, 5)], np.int32)
_FREE = np.array(
    [cell for cell in np.ndindex(SIZE, SIZE) if list(cell) not in PLACES.tolist()], np.int32
)


def start_state(key: jax.Array) -> State:
    """Returns the start of a game; food k is the one of level k + 1; consumes `key`."""
    place_key, player_key = jax.random.split(key)
    return State(
        place=_two_cells(player_key, _CENTRE),
        level=jnp.full(2, PLAYER_LEVEL, jnp.int32),
        food_place=jnp.asarray(PLACES)[_shuffled(place_key, NUM_FOODS)],
        food_level=jnp.arange(1, NUM_FOODS + 1, dtype=jnp.int32),
        time=jnp.zeros((), jnp.int32),
    )


def random_moment(key: jax.Array, start: State, target: jax.Array, max_steps: int) -> State:
    """Returns a random moment of a game: players anywhere, some foods gone, some time gone.

    Args:
        key: consumed.
        start: the game's start, whose foods stay where they are.
        target: level of the food that is never gone, int32 [].
        max_steps: steps of a game, at least `LEAST_TIME_LEFT`.
    """
    player_key, food_key, time_key = jax.random.split(key, 3)
    gone = jax.random.bernoulli(food_key, TAKEN_SHARE, (NUM_FOODS,))
    gone &= start.food_level != target
    return start.replace(
        place=_two_cells(player_key, _FREE),
        food_level=jnp.where(gone, 0, start.food_level),
        time=jax.random.randint(time_key, (), 0, max_steps - LEAST_TIME_LEFT + 1),
    )


def _two_cells(key: jax.Array, cells: np.ndarray) -> jax.Array:
    """Draws two different cells, all pairs equally likely, int32 [2, 2]; consumes `key`."""
    number = len(cells)
    drawn = jax.random.randint(key, (), 0, number * (number - 1))
    first, step = drawn // (number - 1), drawn % (number - 1)
    second = (first + 1 + step) % number
    return jnp.asarray(cells)[jnp.stack([first, second])]


def _shuffled(key: jax.Array, number: int) -> jax.Array:
    """Draws an order of `number` things, int32 [number]; consumes `key`.

    The rank of each of as many random numbers: a few comparisons, where a sort is slow under
    `vmap` on a CPU.
    """
    drawn = jax.random.bits(key, (number,))
    index = np.arange(number)
    earlier = (drawn < drawn[:, None]) | ((drawn == drawn[:, None]) & (index < index[:, None]))
    return jnp.sum(earlier, axis=1)
