"""The rules of lbforaging 2.0.0: moving, colliding, loading, rewards.

A field is held as short lists of players and foods and compared pairwise; there is no array of
cells. Any number of players and foods. Reference: `ForagingEnv.step` of lbforaging 2.0.0.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

NONE, NORTH, SOUTH, WEST, EAST, LOAD = range(6)
NUM_ACTIONS = 6
ACTION_NAMES = ("none", "north", "south", "west", "east", "load")
LARGEST = 1000
"""Most rows, columns and steps; observations rely on it."""


@dataclasses.dataclass(frozen=True)
class Rules:
    """A field's size and what loading takes and pays.

    Attributes:
        rows: rows of the field.
        columns: columns of the field.
        max_steps: steps of a game.
        sight: cells that a player sees in each direction; None sees the whole field.
        penalty: what each loading player loses where their levels do not suffice.
        normalize_reward: whether all foods together pay 1; else a food pays each of its loaders
            its level times theirs.
        all_must_load: a food is taken only by all players at once, whatever its level, in the
            place of the rule that its loaders' levels add up to its own or more.
    """

    rows: int
    columns: int
    max_steps: int = 50
    sight: int | None = None
    penalty: float = 0.0
    normalize_reward: bool = True
    all_must_load: bool = False

    def __post_init__(self):
        for name in ("rows", "columns", "max_steps"):
            _expect_count(name, getattr(self, name))
        if self.sight is not None:
            _expect_count("sight", self.sight, "None or ")
        if self.penalty < 0:
            raise ValueError(f"penalty is {self.penalty}; expected 0 or more")

    @property
    def reach(self) -> int:
        """Cells that a player sees in each direction; the whole field's size without a limit."""
        return max(self.rows, self.columns) if self.sight is None else self.sight


def _expect_count(name: str, value: Any, other: str = "") -> None:
    integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not integer or not 1 <= value <= LARGEST:
        raise ValueError(f"{name} is {value!r}; expected {other}an integer from 1 to {LARGEST}")


class State(PyTreeNode):
    """A moment of a game.

    Attributes:
        place: (row, column) of each player, int32 [player, 2].
        level: level of each player, 1 or more, int32 [player].
        food_place: (row, column) of each food, the same all game long, int32 [food, 2].
        food_level: level of each food, 0 when it was taken, int32 [food].
        time: steps taken, int32 [].
        food_total: sum of the foods' levels at the start, int32 []; normalised rewards need it.
    """

    place: jax.Array
    level: jax.Array
    food_place: jax.Array
    food_level: jax.Array
    time: jax.Array
    food_total: jax.Array | None = None


class Transition(PyTreeNode):
    """A step with what rewards and events are computed from.

    Attributes:
        before: the state when the step began.
        after: the state when the step ended.
        loading: which food each player tried to load, bool [player, food].
        taken: which foods were taken, bool [food].
        reward: the reference's reward of each player, float32 [player].
    """

    before: State
    after: State
    loading: jax.Array
    taken: jax.Array
    reward: jax.Array


def offsets(state: State) -> tuple[jax.Array, jax.Array]:
    """Returns how far south and east of each player each food lies, int32 [player, food] twice."""
    away = state.food_place[None] - state.place[:, None]
    return away[..., 0], away[..., 1]


def beside(state: State) -> jax.Array:
    """Returns which foods that are still there each player stands beside, bool [player, food]."""
    south, east = offsets(state)
    return (jnp.abs(south) + jnp.abs(east) == 1) & (state.food_level > 0)


def load(rules: Rules, state: State, actions: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Resolves all loading at once.

    A player beside several foods loads the first of north, south, west and east, as in the
    reference; there it never happens, since no two spawned foods share a neighbouring cell.

    Args:
        rules: the rules.
        state: the state before the step; loading players do not move.
        actions: int32 [player].

    Returns:
        `loading` and `taken` as in `Transition`, and each player's reward, float32 [player].

    Raises:
        ValueError: a normalised reward without `state.food_total`.
    """
    south, east = offsets(state)
    near = beside(state)
    order = jnp.where(south != 0, (south > 0).astype(jnp.int32), 2 + (east > 0))
    first = jnp.min(jnp.where(near, order, 4), axis=1, keepdims=True)
    loading = near & (order == first) & (actions == LOAD)[:, None]
    strength = jnp.sum(jnp.where(loading, state.level[:, None], 0), axis=0)
    tried = strength > 0
    enough = jnp.all(loading, axis=0) if rules.all_must_load else strength >= state.food_level
    taken = tried & enough
    worth = (state.level[:, None] * state.food_level).astype(jnp.float32)
    if rules.normalize_reward:
        if state.food_total is None:
            raise ValueError("food_total is None; expected the sum of the food levels at the start")
        worth /= jnp.maximum(strength * state.food_total, 1)
    paid = jnp.where(taken, worth, -rules.penalty)
    return loading, taken, jnp.sum(jnp.where(loading, paid, 0.0), axis=1)


def move(rules: Rules, state: State, actions: jax.Array) -> jax.Array:
    """Returns where each player stands after moving, int32 [player, 2].

    The border and foods stop a player. Players that want the same cell all stay, and one that
    stays wants its own. As in the reference, two players may swap; and a player may enter the
    cell of another that was about to leave it but is kept from it, so that both stand there.

    Args:
        rules: the rules.
        state: the state before the step.
        actions: int32 [player].
    """
    row = state.place[:, 0] + (actions == SOUTH) - (actions == NORTH)
    column = state.place[:, 1] + (actions == EAST) - (actions == WEST)
    inside = (row >= 0) & (row < rules.rows) & (column >= 0) & (column < rules.columns)
    food_row, food_column = state.food_place[:, 0], state.food_place[:, 1]
    on_food = (row[:, None] == food_row) & (column[:, None] == food_column)
    free = inside & ~jnp.any(on_food & (state.food_level > 0), axis=1)
    row = jnp.where(free, row, state.place[:, 0])
    column = jnp.where(free, column, state.place[:, 1])
    others = ~np.eye(len(state.place), dtype=bool)
    clash = jnp.any((row[:, None] == row) & (column[:, None] == column) & others, axis=1)
    return jnp.where(clash[:, None], state.place, jnp.stack([row, column], axis=1))


def step(rules: Rules, state: State, actions: jax.Array) -> Transition:
    """Plays one step.

    Args:
        rules: the rules.
        state: the state before.
        actions: int32 [player], 0 to 5: none, north, south, west, east, load.

    Raises:
        ValueError: a normalised reward without `state.food_total`.
    """
    loading, taken, reward = load(rules, state, actions)
    after = state.replace(
        place=move(rules, state, actions),
        food_level=jnp.where(taken, 0, state.food_level),
        time=state.time + 1,
    )
    return Transition(before=state, after=after, loading=loading, taken=taken, reward=reward)


def nothing_left(state: State) -> jax.Array:
    """Returns whether all foods were taken, which ends the reference's game, bool []."""
    return jnp.all(state.food_level == 0)


def time_is_up(rules: Rules, state: State) -> jax.Array:
    """Returns whether the last step was played, which ends every game, bool []."""
    return state.time >= rules.max_steps
