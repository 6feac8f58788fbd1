"""Games for a browser: a board is a list of numbers, one a tile, each standing for a picture.

What a tile looks like is sent once to each browser; after that a step costs a few numbers. The
shapes are those of `envs.drawing`, so that the page shows what GIFs and reports show.
"""

import threading
from typing import Any

from envs.drawing import Arc, Ellipse, Line, Polygon, Rect, Scene, Shape, Text

Picture = list[list[Any]]
"""Shapes as lists that begin with a letter; `static/board.js` draws them."""


class Pictures:
    """Numbers the pictures of tiles; equal ones have equal numbers. Safe to share by threads."""

    def __init__(self):
        self._numbers: dict[tuple[Shape, ...], int] = {}
        self._pictures: list[Picture] = []
        self._lock = threading.Lock()

    def board(self, scene: Scene) -> list[int]:
        """The numbers of a scene's tiles, in the order of its panels."""
        return [self._number(panel.shapes) for panel in scene.panels]

    def __getitem__(self, number: int) -> Picture:
        return self._pictures[number]

    def _number(self, shapes: tuple[Shape, ...]) -> int:
        found = self._numbers.get(shapes)
        if found is None:
            with self._lock:
                found = self._numbers.get(shapes)
                if found is None:
                    found = len(self._pictures)
                    self._pictures.append([_as_list(shape) for shape in shapes])
                    self._numbers[shapes] = found
        return found


def changes(before: list[int] | None, after: list[int]) -> list[list[int]]:
    """The tiles that changed: [tile, picture]; all of them where nothing was shown before."""
    return [
        [tile, picture]
        for tile, picture in enumerate(after)
        if before is None or before[tile] != picture
    ]


def tiles_of(scene: Scene) -> dict[str, Any]:
    """Where a board's tiles are: its size, its background and [x, y, width, height] of each."""
    return {
        "width": scene.width,
        "height": scene.height,
        "background": scene.background,
        "tiles": [[p.x, p.y, p.width, p.height] for p in scene.panels],
    }


def _as_list(shape: Shape) -> list[Any]:
    match shape:
        case Rect():
            box = (shape.x, shape.y, shape.width, shape.height, shape.radius)
            return ["r", *_rounded(box), *_paint(shape)]
        case Ellipse():
            return ["e", *_rounded((shape.x, shape.y, shape.rx, shape.ry)), *_paint(shape)]
        case Polygon():
            return ["p", _points(shape.points), *_paint(shape)]
        case Line():
            return ["l", _points(shape.points), shape.stroke, shape.width, shape.opacity]
        case Arc():
            place = _rounded((shape.x, shape.y, shape.radius, shape.start, shape.end))
            return ["a", *place, shape.stroke, shape.width]
        case Text():
            place = _rounded((shape.x, shape.y, shape.size))
            return ["t", *place, shape.text, shape.fill, shape.anchor, shape.bold]


def _paint(shape: Rect | Ellipse | Polygon) -> list[Any]:
    return [shape.fill, shape.stroke, shape.stroke_width, shape.opacity]


def _points(points: tuple[tuple[float, float], ...]) -> list[float]:
    return [value for point in points for value in _rounded(point)]


def _rounded(values: tuple[float, ...]) -> list[float]:
    return [round(value, 2) for value in values]
