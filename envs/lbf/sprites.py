"""What is seen in a foraging field, drawn as shapes: ground, foods, players.

A tile is `TILE` x `TILE` units with its origin at the top left. Foods are apples, the larger the
higher their level. The players' colours are Overcooked's; they differ in their hats too.
"""

from __future__ import annotations

import functools

from envs.drawing import Arc, Ellipse, Line, Polygon, Rect, Shape, Text, circle, place
from envs.framing import EGO, INK, PARTNER, PlayerColours

TILE = 64.0

GROUND = ("#f1f4e6", "#e9eedb")
GRID = "#d5ddc2"
APPLE, APPLE_EDGE, APPLE_SHINE = "#c23a2e", "#7c1d15", "#e58c7f"
_LEAF, _LEAF_EDGE, _STALK = "#5c8f3a", "#3c6424", "#5b3a1f"
_SKIN, _SKIN_EDGE, _STRAW, _STRAW_EDGE = "#f7d3ae", "#c98f5f", "#f0d58c", "#a8842f"

_APPLE_BODY = (
    (0.0, -9.0), (3.5, -11.2), (8.0, -11.0), (11.4, -8.0), (12.6, -3.2), (11.8, 2.4), (9.4, 7.4),
    (6.0, 11.0), (2.6, 11.8), (0.0, 10.8), (-2.6, 11.8), (-6.0, 11.0), (-9.4, 7.4), (-11.8, 2.4),
    (-12.6, -3.2), (-11.4, -8.0), (-8.0, -11.0), (-3.5, -11.2),
)  # fmt: skip


def ground_shapes(row: int, column: int) -> tuple[Shape, ...]:
    """The ground of the chequered field, with a thin line at its upper and left edge."""
    return (
        Rect(0, 0, TILE, TILE, GRID),
        Rect(1, 1, TILE - 1, TILE - 1, GROUND[(row + column) % 2]),
    )


@functools.cache
def food_shapes(level: int, highest: int) -> tuple[Shape, ...]:
    """An apple on its tile with its level, 1 to `highest`."""
    scale = 1.15 + 0.75 * (level - 1) / max(highest - 1, 1)
    apple = (
        Line(((0, -9), (1.2, -14.5)), _STALK, 2.2),
        Polygon(((1.2, -11.5), (5, -16), (10.5, -15.5), (7, -11.2)), _LEAF, _LEAF_EDGE, 0.8),
        Polygon(_APPLE_BODY, APPLE, APPLE_EDGE, 1.4),
        Ellipse(-7.6, -5.2, 1.8, 2.8, APPLE_SHINE),
    )
    shadow = Ellipse(TILE / 2, 34 + 12 * scale, 9 * scale, 2.6, "#000000", opacity=0.14)
    size = 14 + 6 * (scale - 1.15) / 0.75
    label = Text(TILE / 2, 35 + 0.36 * size, str(level), size, "#ffffff", "middle", bold=True)
    return (shadow, *place(apple, TILE / 2, 35, scale), label)


def _ring(x: float, y: float, radius: float, width: float) -> tuple[Shape, ...]:
    """A dashed ring in the partner's colour."""
    return tuple(
        Arc(x, y, radius, start, start + 27, PARTNER.dark, width) for start in range(-13, 347, 45)
    )


WANTED = _ring(TILE / 2, TILE / 2, 28.5, 3.2)
"""What marks the food that the partner wants, on its tile."""
WANTED_SYMBOL = _ring(0, 0, 4.4, 1.5)


def thought_shapes(level: int) -> tuple[Shape, ...]:
    """The bubble beside the partner's head with the level that it thinks of."""
    white, edge = "#ffffff", PARTNER.dark
    return (
        circle(45.5, 21.5, 2.2, white, edge, 1.2),
        circle(52, 12, 10, white, edge, 1.8),
        Text(52, 17.2, str(level), 14.5, INK, "middle", bold=True),
    )


@functools.cache
def player_shapes(agent: int) -> tuple[Shape, ...]:
    """A player on its tile, seen from the front; `agent` is 0 for the ego, 1 for the partner."""
    colours = (EGO, PARTNER)[agent]
    arms = tuple(
        shape
        for side in (-1, 1)
        for shape in (
            Line(((32 + side * 11, 44), (32 + side * 14.5, 51)), colours.dark, 6.5),
            circle(32 + side * 15, 53, 3.6, _SKIN, _SKIN_EDGE, 1.2),
        )
    )
    return (
        Ellipse(32, 59.5, 17, 3.6, "#000000", opacity=0.16),
        Ellipse(26, 58.5, 5, 3, INK),
        Ellipse(38, 58.5, 5, 3, INK),
        Rect(20, 38, 24, 20, colours.main, 9, colours.dark, 1.8),
        Line(((26, 40), (26, 56)), colours.light, 2.6),
        Line(((38, 40), (38, 56)), colours.light, 2.6),
        *arms,
        circle(32, 29, 12, _SKIN, _SKIN_EDGE, 1.4),
        Ellipse(27.4, 30.5, 1.8, 2.4, INK),
        Ellipse(36.6, 30.5, 1.8, 2.4, INK),
        Line(((29.2, 35.6), (31, 36.8), (33, 36.8), (34.8, 35.6)), INK, 1.5),
        *(_cap(colours) if agent else _straw_hat(colours)),
    )


def _straw_hat(colours: PlayerColours) -> tuple[Shape, ...]:
    crown = ((23.5, 21), (25, 10.5), (28, 8), (36, 8), (39, 10.5), (40.5, 21))
    return (
        Polygon(crown, colours.main, colours.dark, 1.8),
        Rect(23.6, 15.6, 16.8, 4.4, colours.light),
        Ellipse(32, 21.5, 17.5, 3.8, _STRAW, _STRAW_EDGE, 1.6),
    )


def _cap(colours: PlayerColours) -> tuple[Shape, ...]:
    dome = ((19.6, 24), (20.6, 19), (24, 15.8), (28.6, 14.4), (33.4, 14.4), (38, 15.8),
            (41.4, 19), (42.4, 24))  # fmt: skip
    return (
        Polygon(dome, colours.main, colours.dark, 1.8),
        Line(((13.5, 25), (40, 25)), colours.dark, 4.4),
        circle(31, 14, 2.2, colours.dark),
    )
