"""One moment of an Overcooked game as a picture: the state and the style, checked and composed."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from envs.drawing import Panel, Scene, Shape, place
from envs.framing import PAGE, Legend, frame
from envs.overcooked import chefs, sprites
from envs.overcooked.dynamics import State
from envs.overcooked.layouts import Layout
from envs.overcooked.sprites import TILE
from envs.overcooked.styles import Style

if TYPE_CHECKING:
    from envs.overcooked.env import Overcooked

_CLOSED: Legend = ("closed to partner", sprites.FORBIDDEN_SYMBOL)


class _View(NamedTuple):
    """A checked state in plain integers: for each player, counter and pot in turn."""

    positions: tuple[tuple[int, int], ...]
    orientations: tuple[int, ...]
    held: tuple[int, ...]
    counters: tuple[int, ...]
    pots: tuple[tuple[int, int], ...]  # (content, timer)


def draw_state(
    env: Overcooked,
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
        style: the partner's style; in the partner's room, the cells forbidden to it are hatched,
            and the stations forbidden to it are paler and have a "no" mark.
        score: sum of rewards so far, for the header.
        title: the style's name, or any short title; the kitchen's name by default.
        caption: a sentence to print below the kitchen, wrapped to its width.
        max_steps: length of a game in steps, for the header; the environment's by default.

    Raises:
        ValueError: the state or the style does not belong to the layout, or has impossible values.
    """
    board = draw_board(env, state, style=style)
    closed = style is not None and any(_forbidden(env.layout, style, state))
    return frame(
        board.panels,
        board.width,
        board.height,
        title=env.layout.name if title is None else title,
        score=score,
        time=int(np.asarray(state.time)),
        max_steps=max_steps or env.max_steps,
        caption=caption,
        legend=(_CLOSED,) if closed else (),
    )


def draw_board(env: Overcooked, state: State, *, style: Style | None = None) -> Scene:
    """Draw the kitchen alone, a panel a tile, row by row; arguments and errors as `draw_state`."""
    layout = env.layout
    view = _read_state(layout, state)
    forbidden_cells, forbidden_stations = _forbidden(layout, style, state)
    closed = forbidden_cells | forbidden_stations
    contents = _contents(layout, view, forbidden_stations)
    panels = []
    for y, row in enumerate(layout.terrain):
        for x, kind in enumerate(row):
            fixed = _fixed_tile(layout, x, y, kind, (x, y) in closed)
            shapes = fixed + contents.get((x, y), ())
            panels.append(Panel(x * TILE, y * TILE, TILE, TILE, shapes))
    return Scene(layout.width * TILE, layout.height * TILE, PAGE, tuple(panels))


# --- Reading states ------------------------------------------------------------------------------


def _integers(name: str, values: object, size: int, low: int, high: int) -> tuple[int, ...]:
    array = np.asarray(values)
    if array.shape != (size,):
        raise ValueError(
            f"state.{name} must have shape ({size},) in this layout, got {array.shape}; "
            "draw_state takes one unbatched state"
        )
    if array.size and not (low <= array.min() and array.max() <= high):
        raise ValueError(f"state.{name} must be in [{low}, {high}], got {array.tolist()}")
    return tuple(array.astype(int).tolist())


def _read_state(layout: Layout, state: State) -> _View:
    cells = _integers("cell", state.cell, 2, 0, len(layout.floor) - 1)
    if cells[0] == cells[1]:
        raise ValueError(f"both players stand on floor cell {cells[0]}")
    held = _integers("held", state.held, 2, 0, 19)
    counters = _integers("counters", state.counters, layout.num_counters, 0, 19)
    for code in (*held, *counters):
        sprites.item_shapes(code)  # raises for an unknown item
    pots = layout.num_pots
    contents = _integers("pot_content", state.pot_content, pots, 0, 15)
    timers = _integers("pot_timer", state.pot_timer, pots, -1, layout.cook_time)
    for content, timer in zip(contents, timers, strict=True):
        if content:
            sprites.split_content(content)
        elif timer >= 0:
            raise ValueError(f"an empty pot can not have a timer of {timer}; expected -1")
    return _View(
        positions=tuple((int(x), int(y)) for x, y in (layout.floor[cell] for cell in cells)),
        orientations=_integers("orientation", state.orientation, 2, 0, 3),
        held=held,
        counters=counters,
        pots=tuple(zip(contents, timers, strict=True)),
    )


_Places = frozenset[tuple[int, int]]


def _forbidden(layout: Layout, style: Style | None, state: State) -> tuple[_Places, _Places]:
    """The floor cells and the stations in the partner's room that its style forbids, as (x, y).

    Marks in a room that the partner can not enter would read as if they concerned the ego.
    """
    if style is None:
        return frozenset(), frozenset()
    room = _room(layout, int(np.asarray(state.cell)[1]))
    places = []
    for name, mask, cells, near in (
        ("cells", style.cells, layout.floor, room),
        ("targets", style.targets, layout.stations, layout.stations_beside(room)),
    ):
        allowed = np.asarray(mask, bool)
        if allowed.shape != (2, len(cells)):
            raise ValueError(
                f"style.{name} must have shape (2, {len(cells)}) in this layout, "
                f"got {allowed.shape}; draw_state takes one style, not the stack of all"
            )
        places.append(frozenset((int(x), int(y)) for x, y in cells[near & ~allowed[1]]))
    return places[0], places[1]


@functools.lru_cache(maxsize=1024)
def _room(layout: Layout, cell: int) -> np.ndarray:
    """The floor cells that can be walked to from a cell, bool [F]."""
    room = np.arange(len(layout.floor)) == cell
    while True:
        wider = room.copy()
        wider[layout.neighbour[room].ravel()] = True
        if (wider == room).all():
            return room
        room = wider


# --- Composing the picture -----------------------------------------------------------------------


@functools.lru_cache(maxsize=1024)
def _fixed_tile(layout: Layout, x: int, y: int, kind: str, forbidden: bool) -> tuple[Shape, ...]:
    """What never changes on a tile during an episode."""
    if kind == " ":
        hatching = sprites.forbidden_floor_shapes() if forbidden else ()
        return sprites.floor_shapes(x, y) + hatching
    front = y + 1 < layout.height and layout.terrain[y + 1][x] == " "
    number = _serving_numbers(layout).get((x, y)) if kind == "S" else None
    veil = sprites.FORBIDDEN_VEIL if forbidden else ()
    return sprites.station_shapes(kind, front, number) + veil


def _serving_numbers(layout: Layout) -> dict[tuple[int, int], int]:
    """Number the hatches from left to right where there are more than two to confuse."""
    hatches = [
        (int(x), int(y))
        for (x, y), kind in zip(layout.stations, layout.station_kinds, strict=True)
        if kind == "S"
    ]
    return {place: k + 1 for k, place in enumerate(sorted(hatches))} if len(hatches) > 2 else {}


def _contents(
    layout: Layout, view: _View, forbidden: _Places
) -> dict[tuple[int, int], tuple[Shape, ...]]:
    """What lies, cooks and stands on each tile, and the "no" marks over it."""
    contents: dict[tuple[int, int], tuple[Shape, ...]] = {}
    stations = [(int(x), int(y)) for x, y in layout.stations]
    for station, item in zip(stations, view.counters, strict=False):
        if item:
            contents[station] = place(sprites.item_shapes(item), TILE / 2, TILE / 2, 1.3)
    for station, (content, timer) in zip(stations[len(view.counters) :], view.pots, strict=False):
        contents[station] = sprites.pot_shapes(content, timer, layout.cook_time)
    for station in forbidden:
        contents[station] = contents.get(station, ()) + sprites.FORBIDDEN_MARK
    for agent, position in enumerate(view.positions):
        contents[position] = chefs.chef_shapes(agent, view.orientations[agent], view.held[agent])
    return contents
