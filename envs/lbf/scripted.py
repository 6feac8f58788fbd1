"""A pair of players written by hand that takes the target in every game of Spread.

Both are told the target, so their return, 1, is the upper bound of every style's.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Pair
from envs.lbf import dynamics, spread
from envs.lbf.dynamics import State

_LAST = spread.SIZE - 1


def _cells_beside(row: int, column: int) -> list[tuple[int, int]]:
    """Two cells of the border beside a place: both sides of an edge's centre or of a corner."""
    candidates = [(row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column)]
    return [
        (r, c)
        for r, c in candidates
        if 0 <= r <= _LAST and 0 <= c <= _LAST and (r in (0, _LAST) or c in (0, _LAST))
    ]


_GOALS = np.array([_cells_beside(row, column) for row, column in spread.PLACES.tolist()], np.int32)
"""Where the two players load what lies at each place, int32 [place, player, 2]."""


def choose_actions(state: State, target: jax.Array) -> Pair:
    """Returns the next actions of two players on their way from the centre, int32 [] each.

    Each heads for one of two border cells beside the target, along the border first and
    towards it last, so that no other food is in the way; where both want the same cell the
    partner lets the ego pass.

    Args:
        state: a moment of a game in which these two have played so far.
        target: level that pays, int32 []; food k is the one of level k + 1.
    """
    is_target = jnp.arange(1, spread.NUM_FOODS + 1) == target
    place = jnp.sum(jnp.where(is_target[:, None], state.food_place, 0), axis=0)
    here = jnp.all(place == spread.PLACES, axis=1)
    goals = jnp.sum(jnp.where(here[:, None, None], _GOALS, 0), axis=0)
    straight, crossed = (jnp.sum(jnp.abs(g - state.place)) for g in (goals, goals[::-1]))
    goals = jnp.where(straight <= crossed, goals, goals[::-1])

    south, east = (goals - state.place).T
    vertical = jnp.where(south > 0, dynamics.SOUTH, dynamics.NORTH)
    horizontal = jnp.where(east > 0, dynamics.EAST, dynamics.WEST)
    on_upper_or_lower_border = (goals[:, 0] == 0) | (goals[:, 0] == _LAST)
    go_across = (east != 0) & (on_upper_or_lower_border | (south == 0))
    action = jnp.where(go_across, horizontal, vertical)
    arrived = (south == 0) & (east == 0)
    action = jnp.where(arrived, dynamics.LOAD, action)

    wanted_row = state.place[:, 0] + (action == dynamics.SOUTH) - (action == dynamics.NORTH)
    wanted_column = state.place[:, 1] + (action == dynamics.EAST) - (action == dynamics.WEST)
    clash = (wanted_row[0] == wanted_row[1]) & (wanted_column[0] == wanted_column[1])
    return Pair(action[0], jnp.where(clash, dynamics.NONE, action[1]))
