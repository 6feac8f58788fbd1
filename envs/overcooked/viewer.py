"""Pictures of an Overcooked game: one state as SVG, PNG or array, an episode as GIF.

scene = draw_state(layout, state, style=style, score=40, title="left", caption="I stay left.")
save_png("kitchen.png", scene, scale=2)
save_gif("episode.gif", layout, states, style=style, scores=scores, title="left")
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from envs.overcooked import chefs, sprites
from envs.overcooked.drawing import (
    Panel,
    Rect,
    Scene,
    Shape,
    Text,
    circle,
    panel_box,
    panel_image,
    place,
    text_width,
    to_array,
    to_image,
    to_svg,
    wrap_text,
)
from envs.overcooked.dynamics import State
from envs.overcooked.layouts import Layout
from envs.overcooked.sprites import INK, TILE
from envs.overcooked.styles import Style

__all__ = ["draw_state", "save_gif", "save_png", "save_svg", "to_array", "to_image", "to_svg"]

_PAGE, _MUTED, _TRACK = "#fffdf8", "#6b7280", "#e6e0d4"
_MARGIN, _HEADER_HEIGHT = 10.0, 52.0
_CAPTION_SIZE, _CAPTION_LEADING = 13.0, 18.0
# Flat art needs few colours, and fewer compress better.
_GIF_COLOURS = 128
_PALETTE_SCENES = 24


class _View(NamedTuple):
    """A checked state in plain integers: for each player, counter and pot in turn."""

    positions: tuple[tuple[int, int], ...]
    orientations: tuple[int, ...]
    held: tuple[int, ...]
    counters: tuple[int, ...]
    pots: tuple[tuple[int, int], ...]  # (content, timer)
    time: int


def draw_state(
    layout: Layout,
    state: State,
    *,
    style: Style | None = None,
    score: float | None = None,
    title: str | None = None,
    caption: str | None = None,
    max_steps: int = 400,
) -> Scene:
    """Draw one moment of a game.

    Args:
        layout: the kitchen.
        state: the moment, unbatched.
        style: the partner's style; the cells forbidden to the partner are hatched, the stations
            forbidden to it are paler and have a "no" mark.
        score: sum of rewards so far, for the header.
        title: the style's name, or any short title; the kitchen's name by default.
        caption: a sentence to print below the kitchen, wrapped to its width.
        max_steps: length of a game in steps, for the header.

    Raises:
        ValueError: the state or the style does not belong to the layout, or holds impossible values.
    """
    view = _read_state(layout, state)
    forbidden_cells, forbidden_stations = _forbidden(layout, style)
    width = layout.width * TILE
    top = _HEADER_HEIGHT
    header = Panel(0, 0, width, top, _header(layout, width, view.time, max_steps, score, title))
    contents = _contents(layout, view, forbidden_stations)
    panels = [header]
    for y, row in enumerate(layout.terrain):
        for x, kind in enumerate(row):
            fixed = _fixed_tile(layout, x, y, kind, (x, y) in forbidden_cells | forbidden_stations)
            shapes = fixed + contents.get((x, y), ())
            panels.append(Panel(x * TILE, top + y * TILE, TILE, TILE, shapes))
    height = top + layout.height * TILE
    if caption:
        footer = _caption(caption, width)
        footer_height = _MARGIN * 2 + _CAPTION_LEADING * (len(footer) - 1)
        panels.append(Panel(0, height, width, footer_height, footer))
        height += footer_height
    return Scene(width, height, _PAGE, tuple(panels))


def save_svg(path: str | Path, scene: Scene) -> None:
    """Write the scene as an SVG file."""
    Path(path).write_text(to_svg(scene), encoding="utf-8")


def save_png(path: str | Path, scene: Scene, scale: float = 1.0) -> None:
    """Write the scene as a PNG file, `scale` pixels a unit (a tile is 64 units)."""
    to_image(scene, scale).save(path, format="PNG", optimize=True)


def save_gif(
    path: str | Path,
    layout: Layout,
    states: State | Sequence[State],
    *,
    style: Style | None = None,
    scores: Sequence[float] | np.ndarray | None = None,
    title: str | None = None,
    caption: str | None = None,
    max_steps: int = 400,
    fps: float = 8.0,
    scale: float = 0.75,
) -> None:
    """Write an episode as an endlessly repeating GIF file.

    Args:
        path: the file.
        layout: the kitchen.
        states: the moments, as one `State` with a leading axis [T] or as a sequence of T states.
        style, title, caption, max_steps: as in `draw_state`.
        scores: sum of rewards so far at each moment, [T].
        fps: moments a second, at most 50 (viewers slow down faster files).
        scale: pixels a unit (a tile is 64 units).

    Raises:
        ValueError: no states, not as many scores as states, `fps` out of range, or what
            `draw_state` raises.
    """
    if not 0 < fps <= 50:
        raise ValueError(f"fps must be in (0, 50], got {fps}")
    moments = _split_time(states)
    if scores is not None and len(scores) != len(moments):
        raise ValueError(f"got {len(scores)} scores for {len(moments)} states")
    scenes = [
        draw_state(
            layout,
            moment,
            style=style,
            score=None if scores is None else float(scores[t]),
            title=title,
            caption=caption,
            max_steps=max_steps,
        )
        for t, moment in enumerate(moments)
    ]
    frames = _shared_palette_frames(scenes, scale)
    # GIF counts in hundredths of a second: rounding the moments, not the steps, keeps the tempo.
    ticks = [round(100 * t / fps) for t in range(len(scenes) + 1)]
    durations = [10 * (after - before) for before, after in zip(ticks, ticks[1:], strict=False)]
    frames[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=False,
    )


# --- Reading states ------------------------------------------------------------------------------


def _split_time(states: State | Sequence[State]) -> list[State]:
    if not isinstance(states, State):
        moments = [jax.tree.map(np.asarray, state) for state in states]
    else:
        arrays = jax.tree.map(np.asarray, states)
        if arrays.time.ndim != 1:
            raise ValueError(
                f"states need one leading axis [T], got time of shape {arrays.time.shape}; "
                "for a single state, use draw_state"
            )
        moments = [jax.tree.map(lambda leaf: leaf[t], arrays) for t in range(len(arrays.time))]
    if not moments:
        raise ValueError("an episode needs at least one state, got none")
    return moments


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
        time=int(np.asarray(state.time)),
    )


_Places = frozenset[tuple[int, int]]


def _forbidden(layout: Layout, style: Style | None) -> tuple[_Places, _Places]:
    """The floor cells and the stations forbidden to the partner, as (x, y)."""
    if style is None:
        return frozenset(), frozenset()
    places = []
    for name, mask, cells in (
        ("cells", style.cells, layout.floor),
        ("targets", style.targets, layout.stations),
    ):
        allowed = np.asarray(mask, bool)
        if allowed.shape != (2, len(cells)):
            raise ValueError(
                f"style.{name} must have shape (2, {len(cells)}) in this layout, "
                f"got {allowed.shape}; draw_state takes one style, not the stack of all"
            )
        places.append(frozenset((int(x), int(y)) for x, y in cells[~allowed[1]]))
    return places[0], places[1]


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


def _header(
    layout: Layout,
    width: float,
    time: int,
    max_steps: int,
    score: float | None,
    title: str | None,
) -> tuple[Shape, ...]:
    name = layout.name if title is None else title
    points = "" if score is None else f"{score:g}"
    points_width = text_width(points, 17, bold=True)
    label_width = text_width("score", 11) + 5 if points else 0.0
    room = width - 3 * _MARGIN - points_width - label_width
    size = min(15.0, 15.0 * room / max(text_width(name, 15, bold=True), 1.0))
    right = width - _MARGIN
    shapes: list[Shape] = [Text(_MARGIN, 21, name, size, INK, bold=True)]
    if points:
        shapes.append(Text(right, 21.5, points, 17, INK, "end", bold=True))
        shapes.append(Text(right - points_width - 5, 21, "score", 11, _MUTED, "end"))
    x = _MARGIN
    for label, colours in (("ego", chefs.EGO), ("partner", chefs.PARTNER)):
        shapes.append(circle(x + 4.5, 36.5, 4.5, colours.main, colours.dark, 1.2))
        shapes.append(Text(x + 13, 40.5, label, 11, _MUTED))
        x += 13 + text_width(label, 11) + 12
    shapes.append(Text(right, 40.5, f"step {time}/{max_steps}", 11, _MUTED, "end"))
    shapes.append(Rect(0, _HEADER_HEIGHT - 3, width, 3, _TRACK))
    done = width * min(max(time / max_steps, 0.0), 1.0)
    if done > 0:
        shapes.append(Rect(0, _HEADER_HEIGHT - 3, done, 3, sprites.PROGRESS))
    return tuple(shapes)


def _caption(caption: str, width: float) -> tuple[Shape, ...]:
    lines = wrap_text(caption, _CAPTION_SIZE, width - 2 * _MARGIN - 8)
    bar = Rect(_MARGIN, 10, 3, _CAPTION_LEADING * len(lines), chefs.PARTNER.main, 1.5)
    rows = (
        Text(_MARGIN + 11, 23.5 + _CAPTION_LEADING * k, line, _CAPTION_SIZE, INK)
        for k, line in enumerate(lines)
    )
    return (bar, *rows)


def _shared_palette_frames(scenes: list[Scene], scale: float) -> list[Image.Image]:
    """Render scenes of one size and arrangement with one adaptive palette."""
    palette = _palette(scenes, scale)
    width, height = to_image(scenes[0], scale).size
    indices = np.zeros((height, width), np.uint8)
    quantized: dict[tuple, np.ndarray] = {}
    drawn: list[tuple[Shape, ...] | None] = [None] * len(scenes[0].panels)
    frames = []
    for scene in scenes:
        for k, panel in enumerate(scene.panels):
            if panel.shapes == drawn[k]:
                continue
            image = panel_image(panel, scale, scene.background)
            left, top, right, bottom = panel_box(panel, scale)
            key = (panel.shapes, image.size)
            if key not in quantized:
                plain = image.quantize(palette=palette, dither=Image.Dither.NONE)
                quantized[key] = np.asarray(plain)
            indices[top:bottom, left:right] = quantized[key]
            drawn[k] = panel.shapes
        frame = Image.fromarray(indices, "P")
        frame.putpalette(palette.getpalette() or [])
        frames.append(frame)
    return frames


def _palette(scenes: list[Scene], scale: float) -> Image.Image:
    """A palette for the colours of a sample of the scenes."""
    sample = scenes[:: max(1, len(scenes) // _PALETTE_SCENES)]
    panels = {panel.shapes: panel for scene in sample for panel in scene.panels}
    images = [panel_image(panel, scale, sample[0].background) for panel in panels.values()]
    pixels = np.concatenate([np.asarray(image).reshape(-1, 3) for image in images])
    return Image.fromarray(pixels[None]).quantize(_GIF_COLOURS, Image.Quantize.MEDIANCUT, kmeans=1)
