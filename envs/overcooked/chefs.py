"""The two chefs of an Overcooked kitchen, drawn as shapes on a tile.

A chef's face, hands and held item point where it faces; the ego wears blue and a tall hat, the
partner green and a flat beret, so that they differ in outline as well as in colour.
"""

from __future__ import annotations

import functools

from envs.drawing import Ellipse, Line, Polygon, Rect, Shape, circle, place
from envs.framing import EGO, INK, PARTNER, PlayerColours
from envs.overcooked.sprites import item_shapes

NORTH, SOUTH, EAST, WEST = range(4)

_SKIN, _SKIN_EDGE, _CHEEK = "#f7d3ae", "#c98f5f", "#f0a58a"
_HEAD_X, _HEAD_Y = 32.0, 29.0
_ITEM_PLACE = {NORTH: (32, 12.5), SOUTH: (32, 50), EAST: (52, 47), WEST: (12, 47)}
_SLEEVES_AND_HANDS = {
    NORTH: (((19, 44), (17.5, 16)), ((45, 44), (46.5, 16))),
    SOUTH: (((20, 43), (22.5, 52)), ((44, 43), (41.5, 52))),
    EAST: (((34, 44), (44, 50)), ((36, 46), (46, 52))),
    WEST: (((30, 44), (20, 50)), ((28, 46), (18, 52))),
}


@functools.cache
def chef_shapes(agent: int, orientation: int, held: int) -> tuple[Shape, ...]:
    """A chef on its tile, with the item it holds.

    Args:
        agent: 0 the ego, 1 the partner.
        orientation: 0 north, 1 south, 2 east, 3 west.
        held: the item's code.
    """
    colours = (EGO, PARTNER)[agent]
    shadow = Ellipse(32, 58.5, 17, 4, "#000000", opacity=0.16)
    torso = _torso(colours, orientation)
    head = (*_head(colours, orientation), *_hat(agent, colours))
    arms, hands = _arms(colours, orientation, held != 0)
    x, y = _ITEM_PLACE[orientation]
    item = place(item_shapes(held), x, y, 0.85)
    if orientation == NORTH:
        # The arms reach away from us, and the head bows below what they lift.
        return (shadow, *torso, *arms, *place(head, 0, 5 if held else 0), *item, *hands)
    return (shadow, *torso, *head, *arms, *item, *hands)


def _torso(colours: PlayerColours, orientation: int) -> tuple[Shape, ...]:
    feet = (Ellipse(25.5, 57.5, 5, 3.2, INK), Ellipse(38.5, 57.5, 5, 3.2, INK))
    jacket = Rect(19, 37, 26, 20, colours.main, 9, colours.dark, 1.8)
    if orientation == NORTH:
        bow = (
            Line(((20, 48), (44, 48)), colours.light, 2.2),
            Polygon(((32, 48), (26.5, 44.5), (26.5, 51.5)), colours.light),
            Polygon(((32, 48), (37.5, 44.5), (37.5, 51.5)), colours.light),
        )
        return (*feet, jacket, *bow)
    shift = {SOUTH: 0.0, EAST: 5.0, WEST: -5.0}[orientation]
    apron = Rect(25 + shift, 41, 14, 15, colours.light, 3.5)
    return (*feet, jacket, apron)


def _head(colours: PlayerColours, orientation: int) -> tuple[Shape, ...]:
    x, y = _HEAD_X, _HEAD_Y
    if orientation == NORTH:
        ears = (circle(x - 12.5, y + 1, 3, _SKIN), circle(x + 12.5, y + 1, 3, _SKIN))
        return (*ears, circle(x, y, 12.5, colours.hair))
    face = circle(x, y, 12.5, _SKIN, _SKIN_EDGE, 1.4)
    if orientation == SOUTH:
        return (
            circle(x - 12.5, y + 1, 3, _SKIN, _SKIN_EDGE, 1.2),
            circle(x + 12.5, y + 1, 3, _SKIN, _SKIN_EDGE, 1.2),
            face,
            Ellipse(x - 4.8, y - 0.5, 1.9, 2.5, INK),
            Ellipse(x + 4.8, y - 0.5, 1.9, 2.5, INK),
            circle(x - 8, y + 4.4, 2.1, _CHEEK, opacity=0.75),
            circle(x + 8, y + 4.4, 2.1, _CHEEK, opacity=0.75),
            Line(
                ((x - 3, y + 5.2), (x - 1, y + 6.6), (x + 1, y + 6.6), (x + 3, y + 5.2)), INK, 1.5
            ),
        )
    side = 1.0 if orientation == EAST else -1.0
    return (
        face,
        Ellipse(x - side * 8.3, y + 0.5, 4.6, 9, colours.hair),
        circle(x - side * 3.2, y + 1.5, 2.8, _SKIN, _SKIN_EDGE, 1.2),
        circle(x + side * 13, y + 1.4, 2.7, _SKIN, _SKIN_EDGE, 1.2),
        Ellipse(x + side * 6.6, y - 0.8, 1.9, 2.5, INK),
        circle(x + side * 2.6, y + 6, 2.1, _CHEEK, opacity=0.75),
        Line(
            ((x + side * 6.5, y + 7), (x + side * 8.5, y + 7.6), (x + side * 10, y + 6.4)), INK, 1.5
        ),
    )


def _hat(agent: int, colours: PlayerColours) -> tuple[Shape, ...]:
    x, y = _HEAD_X, _HEAD_Y
    if agent == 0:
        puff = tuple(
            circle(x + dx, y + dy, radius, colours.main, colours.dark, 1.8)
            for dx, dy, radius in ((-7.5, -17, 6.5), (7.5, -17, 6.5), (0, -19.5, 7))
        )
        crown = Rect(x - 9, y - 18, 18, 9, colours.main)
        band = Rect(x - 11.5, y - 12, 23, 6.5, colours.light, 2.5, colours.dark, 1.8)
        return (*puff, crown, band)
    beret = Ellipse(x, y - 12.5, 17, 7.5, colours.main, colours.dark, 1.8)
    stalk = Line(((x, y - 19.5), (x + 2, y - 23)), colours.dark, 3)
    band = Rect(x - 11.5, y - 10.5, 23, 5, colours.light, 2.5, colours.dark, 1.8)
    return (stalk, beret, band)


def _arms(
    colours: PlayerColours, orientation: int, holding: bool
) -> tuple[tuple[Shape, ...], tuple[Shape, ...]]:
    if orientation == NORTH and not holding:
        ends = (((20, 42), (15.5, 36.5)), ((44, 42), (48.5, 36.5)))
    else:
        ends = _SLEEVES_AND_HANDS[orientation]
    arms = tuple(Line(end, colours.dark, 6.5) for end in ends)
    hands = tuple(circle(x, y, 3.8, _SKIN, _SKIN_EDGE, 1.2) for _, (x, y) in ends)
    return arms, hands
