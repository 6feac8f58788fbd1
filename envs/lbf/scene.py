"""One moment of a Spread game as a picture: the state and the style, checked and composed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from envs.drawing import Panel, Scene, Shape, place
from envs.framing import PAGE, Legend, frame
from envs.lbf import sprites
from envs.lbf.dynamics import State
from envs.lbf.sprites import TILE
from envs.lbf.styles import Style

if TYPE_CHECKING:
    from envs.lbf.env import Spread

_WANTED: Legend = ("wanted: only the partner knows", sprites.WANTED_SYMBOL)
_TOGETHER = 0.62


class _View(NamedTuple):
    """A checked state in plain integers; places are (row, column)."""

    players: tuple[tuple[int, int], ...]
    foods: dict[tuple[int, int], int]  # levels of those still there


def draw_state(
    env: Spread,
    state: State,
    *,
    style: Style | None = None,
    score: float | None = None,
    title: str | None = None,
    caption: str | None = None,
    max_steps: int | None = None,
) -> Scene:
    """Draw one moment of a game.

    Args:
        env: the environment.
        state: the moment, unbatched.
        style: the partner's style; its food has a ring, and the partner thinks of its level.
        score: sum of rewards so far, for the header.
        title: the style's name, or any short title; the environment's name by default.
        caption: a sentence to print below the field, wrapped to its width.
        max_steps: length of a game in steps, for the header; the environment's by default.

    Raises:
        ValueError: the state does not belong to the environment, or has impossible values; or the
            style is not a single one.
    """
    board = draw_board(env, state, style=style)
    return frame(
        board.panels,
        board.width,
        board.height,
        title=env.name if title is None else title,
        score=score,
        time=int(np.asarray(state.time)),
        max_steps=max_steps or env.max_steps,
        caption=caption,
        legend=() if style is None else (_WANTED,),
    )


def draw_board(env: Spread, state: State, *, style: Style | None = None) -> Scene:
    """Draw the field alone, a panel a cell, row by row; arguments and errors as `draw_state`."""
    view = _read_state(env, state)
    target = None if style is None else _target(style, len(env.style_names))
    contents = _contents(view, target, len(env.style_names))
    panels = tuple(
        Panel(
            column * TILE,
            row * TILE,
            TILE,
            TILE,
            sprites.ground_shapes(row, column) + contents.get((row, column), ()),
        )
        for row in range(env.rows)
        for column in range(env.columns)
    )
    return Scene(env.columns * TILE, env.rows * TILE, PAGE, panels)


def _read_state(env: Spread, state: State) -> _View:
    foods = len(env.style_names)
    places = _integers("food_place", state.food_place, (foods, 2), (env.rows, env.columns))
    levels = _integers("food_level", state.food_level, (foods,), foods + 1)
    players = _integers("place", state.place, (2, 2), (env.rows, env.columns))
    present = {
        (int(row), int(column)): int(level)
        for (row, column), level in zip(places, levels, strict=True)
        if level
    }
    if len(present) < np.count_nonzero(levels):
        raise ValueError(f"two foods lie in one cell: state.food_place is {places.tolist()}")
    standing = tuple((int(row), int(column)) for row, column in players)
    for cell in standing:
        if cell in present:
            raise ValueError(f"a player stands on the food at (row, column) {cell}")
    return _View(standing, present)


def _integers(
    name: str, values: object, shape: tuple[int, ...], limit: int | tuple[int, int]
) -> np.ndarray:
    """The values as an array, each at least 0 and below the limit (of its column)."""
    array = np.asarray(values)
    if array.shape != shape:
        raise ValueError(
            f"state.{name} must have shape {shape}, got {array.shape}; "
            "draw_state takes one unbatched state"
        )
    if not ((array >= 0) & (array < np.asarray(limit))).all():
        raise ValueError(f"state.{name} must be in [0, {limit}), got {array.tolist()}")
    return array


def _target(style: Style, highest: int) -> int:
    target = np.asarray(style.target)
    if target.shape != ():
        raise ValueError(
            f"style.target must be one number, got shape {target.shape}; "
            "draw_state takes one style, not the stack of all"
        )
    if not 1 <= target <= highest:
        raise ValueError(f"style.target must be in [1, {highest}], got {target}")
    return int(target)


def _contents(
    view: _View, target: int | None, highest: int
) -> dict[tuple[int, int], tuple[Shape, ...]]:
    """What lies and stands on each cell."""
    contents: dict[tuple[int, int], tuple[Shape, ...]] = {
        cell: (sprites.WANTED if level == target else ()) + sprites.food_shapes(level, highest)
        for cell, level in view.foods.items()
    }
    ego, partner = (sprites.player_shapes(agent) for agent in (0, 1))
    if target is not None:
        partner += sprites.thought_shapes(target)
    if view.players[0] == view.players[1]:
        # The rules let two players share a cell where one was kept from leaving it.
        ego = place(ego, -4, 16, _TOGETHER)
        partner = place(partner, 26, 16, _TOGETHER)
        contents[view.players[0]] = ego + partner
    else:
        contents[view.players[0]], contents[view.players[1]] = ego, partner
    return contents
