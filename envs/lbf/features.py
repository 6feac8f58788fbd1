"""What a player of Spread sees as a flat vector that small MLPs learn from.

Own things first, then the other player's, then one entry for each food, from level 1 to 8, so
that one network can play either side.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from envs.lbf import dynamics, observation
from envs.lbf.dynamics import Rules, State


@functools.cache
def feature_slices(num_foods: int) -> dict[str, slice]:
    """Names every slice of the feature vector.

    `own_place`: row and column, -1 at the upper and left border, 1 at the lower and right one.
    `blocked`: whether the border, a food or the other player is in the next cell north, south,
    west, east. `other_away`: rows and columns to the other player, as shares of the field's
    (positive: south, east); `other_side`: their signs; `other_seen`: whether it is in sight.
    `same_food`: whether both stand beside the same food.

    By food: `food_there` (there and in sight), `food_away` and `food_side` (rows of all foods,
    then columns of all foods, as for the other player), `own_steps` and `other_steps` (steps to
    the food's nearest side as a share of the field's rows and columns together), `own_beside`
    and `other_beside`. `time_left`: share of the game, 1 at the start.

    Everything about what is taken or out of sight is 0.
    """
    sizes = {"own_place": 2, "blocked": 4, "other_away": 2, "other_side": 2, "other_seen": 1}
    sizes |= {"same_food": 1, "food_there": num_foods}
    sizes |= {"food_away": 2 * num_foods, "food_side": 2 * num_foods}
    names = ("own_steps", "other_steps", "own_beside", "other_beside")
    sizes |= dict.fromkeys(names, num_foods)
    sizes |= {"time_left": 1}
    ends = np.cumsum(list(sizes.values()))
    starts = [0, *ends[:-1]]
    return {name: slice(int(a), int(b)) for name, a, b in zip(sizes, starts, ends, strict=True)}


def num_features(num_foods: int) -> int:
    """Returns the length of the feature vector."""
    return feature_slices(num_foods)["time_left"].stop


def features(rules: Rules, state: State, partner_sight: int | None = None) -> jax.Array:
    """Returns both players' feature vectors, float32 [2, O]; slices in `feature_slices`.

    Args:
        rules: of the game.
        state: the state.
        partner_sight: rows and columns up to which the first player sees the second, where
            that is nearer than the rules' sight.
    """
    size = np.array([rules.rows - 1, rules.columns - 1], np.float32)
    south, east = dynamics.offsets(state)
    seen = observation.foods_in_sight(rules, state)
    beside = dynamics.beside(state)
    steps = jnp.maximum(jnp.abs(south) + jnp.abs(east) - 1, 0) / size.sum()
    other_away = state.place[::-1] - state.place
    everywhere = max(rules.rows, rules.columns)
    sight = everywhere if rules.sight is None else rules.sight
    nearer = sight if partner_sight is None else min(partner_sight, sight)
    other_seen = jnp.all(jnp.abs(other_away) <= np.array([[nearer], [sight]]), axis=1)
    other_away = jnp.where(other_seen[:, None], other_away, 0)
    both_seen = seen & other_seen[:, None]
    other_beside = both_seen & beside[::-1]
    parts = (
        2 * state.place / size - 1,
        _blocked(rules, state, other_away, other_seen),
        other_away / size,
        jnp.sign(other_away),
        other_seen[:, None],
        jnp.any(beside & other_beside, axis=1, keepdims=True),
        seen,
        jnp.where(seen, south / size[0], 0),
        jnp.where(seen, east / size[1], 0),
        jnp.where(seen, jnp.sign(south), 0),
        jnp.where(seen, jnp.sign(east), 0),
        jnp.where(seen, steps, 0),
        jnp.where(both_seen, steps[::-1], 0),
        beside,
        other_beside,
        jnp.ones((2, 1)) * (1 - state.time / rules.max_steps),
    )
    return jnp.concatenate([jnp.asarray(part, jnp.float32) for part in parts], axis=1)


def _blocked(rules: Rules, state: State, other_away: jax.Array, other_seen: jax.Array) -> jax.Array:
    """Whether each next cell north, south, west, east cannot be entered, bool [2, 4]."""
    south, east = dynamics.offsets(state)
    there = state.food_level > 0
    row, column = state.place[:, 0], state.place[:, 1]
    at_border = (row == 0, row == rules.rows - 1, column == 0, column == rules.columns - 1)
    blocked = []
    for border, (down, right) in zip(at_border, ((-1, 0), (1, 0), (0, -1), (0, 1)), strict=True):
        food = jnp.any((south == down) & (east == right) & there, axis=1)
        other = (other_away[:, 0] == down) & (other_away[:, 1] == right) & other_seen
        blocked.append(border | food | other)
    return jnp.stack(blocked, axis=1)
