"""Random fields as lbforaging 2.0.0 spawns them, as a pure function of a key.

The reference tries random cells until one is allowed; here a cell is drawn from those allowed,
which has the same distribution. Reference: `spawn_players` and `spawn_food` of `ForagingEnv`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs.lbf.dynamics import Rules, State


@dataclasses.dataclass(frozen=True)
class Spawning:
    """How many players and foods a random field has, and of which levels.

    Attributes:
        num_players: players.
        num_foods: foods; fewer where no more have room.
        max_player_level: players' levels are drawn from 1 to this.
        max_food_level: foods' levels are drawn from 1 to this; None: to the sum of the three
            lowest players' levels.
        force_coop: all foods have the greatest level.
    """

    num_players: int = 2
    num_foods: int = 3
    max_player_level: int = 2
    max_food_level: int | None = None
    force_coop: bool = False

    def __post_init__(self):
        for name in ("num_players", "num_foods", "max_player_level", "max_food_level"):
            value = getattr(self, name)
            if not (name == "max_food_level" and value is None) and value < 1:
                raise ValueError(f"{name} is {value!r}; expected an integer of at least 1")


def random_field(key: jax.Array, rules: Rules, spawning: Spawning) -> State:
    """Draws the start of a game.

    Players stand on different cells. Foods lie off the border, not where a player stands, and
    no two touch (not by a corner either) or have only one cell between them in a row or column:
    so no cell is beside two foods.

    Args:
        key: consumed.
        rules: the field's size.
        spawning: what is on it.

    Returns:
        The state; a food that found no room has level 0 and lies outside, at (-1, -1).

    Raises:
        ValueError: more players than cells.
    """
    if spawning.num_players > rules.rows * rules.columns:
        raise ValueError(
            f"num_players is {spawning.num_players}; expected at most one a cell, "
            f"{rules.rows * rules.columns}"
        )
    place_key, player_key, food_key = jax.random.split(key, 3)
    cells = np.array(list(np.ndindex(rules.rows, rules.columns)), np.int32)
    last = np.array([rules.rows - 1, rules.columns - 1])
    numbers = jax.random.uniform(place_key, (spawning.num_players + spawning.num_foods,))

    def put_player(free: jax.Array, number: jax.Array):
        place, _ = _draw_cell(number, free, cells)
        return free & jnp.any(cells != place, axis=1), place

    def put_food(free: jax.Array, number: jax.Array):
        place, found = _draw_cell(number, free, cells)
        away = jnp.abs(cells - place)
        in_line = (jnp.min(away, axis=1) == 0) & (jnp.max(away, axis=1) == 2)
        return free & (jnp.max(away, axis=1) > 1) & ~in_line, (place, found)

    free = jnp.ones(len(cells), bool)
    free, place = jax.lax.scan(put_player, free, numbers[: spawning.num_players])
    free &= ((cells > 0) & (cells < last)).all(axis=1)
    _, (food_place, found) = jax.lax.scan(put_food, free, numbers[spawning.num_players :])

    level = jax.random.randint(
        player_key, (spawning.num_players,), 1, spawning.max_player_level + 1
    )
    greatest = jnp.sum(jnp.sort(level)[:3])
    if spawning.max_food_level is not None:
        greatest = jnp.asarray(spawning.max_food_level)
    least = greatest if spawning.force_coop else 1
    food_level = jax.random.randint(food_key, (spawning.num_foods,), least, greatest + 1)
    food_level = jnp.where(found, food_level, 0)
    return State(
        place=place,
        level=level,
        food_place=food_place,
        food_level=food_level,
        time=jnp.zeros((), jnp.int32),
        food_total=jnp.sum(food_level),
    )


def _draw_cell(
    number: jax.Array, free: jax.Array, cells: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """The free cell that a number from 0 to 1 stands for, (-1, -1) without one, and whether
    there is one; int32 [2], bool []."""
    many = jnp.sum(free)
    chosen = jnp.minimum((number * many).astype(jnp.int32), many - 1)
    here = free & (jnp.cumsum(free) - 1 == chosen)
    place = jnp.sum(jnp.where(here[:, None], cells + 1, 0), axis=0) - 1
    return place.astype(jnp.int32), many > 0
