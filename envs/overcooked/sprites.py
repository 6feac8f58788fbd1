"""What is seen in an Overcooked kitchen but for its chefs, drawn as shapes: tiles, items, pots.

A tile is `TILE` x `TILE` units with its origin at the top left. Items are drawn around (0, 0) and
are some 20 units wide; `place` moves and scales them. Onions and tomatoes differ in outline as well
as in colour.
"""

from __future__ import annotations

import functools

from envs.drawing import Arc, Ellipse, Line, Polygon, Rect, Shape, Text, circle, place
from envs.framing import INK, PROGRESS

TILE = 64.0

FLOOR = ("#f3ecdf", "#ece3d2")
COUNTER_TOP, COUNTER_EDGE, COUNTER_FRONT = "#dcb98d", "#c99f6e", "#a97d4e"
STEEL, STEEL_EDGE = "#aeb7c2", "#7d8896"
READY = "#2f9e57"
FORBIDDEN = "#c8364a"


def split_content(content: int) -> tuple[int, int]:
    """Onions and tomatoes of `4 * onions + tomatoes`.

    Raises:
        ValueError: the content is not that of one to three ingredients.
    """
    onions, tomatoes = divmod(content, 4)
    if content < 0 or not 1 <= onions + tomatoes <= 3:
        raise ValueError(
            f"content {content} is not 4 * onions + tomatoes with one to three ingredients"
        )
    return onions, tomatoes


# --- Items ---------------------------------------------------------------------------------------

_ONION_BULB = (
    (0.0, -11.0), (1.6, -7.0), (5.5, -4.6), (8.6, -1.0), (9.4, 3.0), (8.0, 7.0), (4.8, 9.6),
    (0.0, 10.4), (-4.8, 9.6), (-8.0, 7.0), (-9.4, 3.0), (-8.6, -1.0), (-5.5, -4.6), (-1.6, -7.0),
)  # fmt: skip
ONION: tuple[Shape, ...] = (
    Polygon(_ONION_BULB, "#f6dc9c", "#96661f", 1.8),
    Line(((-0.6, -6.5), (-4.2, -1.5), (-4.6, 3.5), (-2.6, 8.4)), "#cf9a41", 1.3),
    Line(((0.6, -6.5), (4.2, -1.5), (4.6, 3.5), (2.6, 8.4)), "#cf9a41", 1.3),
    Line(((0.0, -11.0), (-2.2, -13.4)), "#7f9a3b", 1.8),
    Line(((0.0, -11.0), (2.0, -13.8)), "#7f9a3b", 1.8),
)
TOMATO: tuple[Shape, ...] = (
    Ellipse(0, 1.2, 10, 9, "#e24b35", "#8f2417", 1.8),
    Ellipse(-4.4, -0.8, 2.2, 2.8, "#f59a86"),
    Polygon(
        ((0, -4.4), (4.8, -2.2), (3.4, -6.2), (6.6, -8.8), (1.8, -8.4), (0, -12.2),
         (-1.8, -8.4), (-6.6, -8.8), (-3.4, -6.2), (-4.8, -2.2)),
        "#3f7f33",
    ),
)  # fmt: skip
DISH: tuple[Shape, ...] = (
    circle(0, 0, 11, "#ffffff", "#8c97a5", 1.6),
    circle(0, 0, 6.8, "#f2f5f8", "#c3cbd5", 1.2),
)
# Where one, two or three ingredients lie, in units of their spacing.
_HEAPS = {
    1: ((0.0, 0.0),),
    2: ((-0.58, 0.0), (0.58, 0.0)),
    3: ((-0.62, 0.45), (0.62, 0.45), (0.0, -0.62)),
}


def _broth(onions: int, tomatoes: int) -> str:
    if tomatoes == 0:
        return "#f3c95f"
    return "#ef8d6c" if onions == 0 else "#f2ab63"


def _ingredients(onions: int, tomatoes: int, spacing: float, scale: float) -> tuple[Shape, ...]:
    kinds = (ONION,) * onions + (TOMATO,) * tomatoes
    return tuple(
        shape
        for kind, (x, y) in zip(kinds, _HEAPS[len(kinds)], strict=True)
        for shape in place(kind, x * spacing, y * spacing + 1.2 * scale, scale)
    )


@functools.cache
def item_shapes(code: int) -> tuple[Shape, ...]:
    """An item around (0, 0), by its code: 0 nothing, 1 onion, 2 tomato, 3 dish, 4 + content a soup.

    Raises:
        ValueError: there is no item with this code.
    """
    simple: dict[int, tuple[Shape, ...]] = {0: (), 1: ONION, 2: TOMATO, 3: DISH}
    if code in simple:
        return simple[code]
    try:
        onions, tomatoes = split_content(code - 4)
    except ValueError as error:
        raise ValueError(f"there is no item with code {code}: as a soup, {error}") from None
    return (
        circle(0, 0, 12, "#ffffff", "#8c97a5", 1.6),
        circle(0, 0, 9, _broth(onions, tomatoes), "#b5793a", 1.0),
        *_ingredients(onions, tomatoes, 6.4, 0.4),
    )


# --- Tiles ---------------------------------------------------------------------------------------


def floor_shapes(x: int, y: int) -> tuple[Shape, ...]:
    """A floor tile of the chequered floor at column `x` and row `y`."""
    return (Rect(0, 0, TILE, TILE, FLOOR[(x + y) % 2]),)


def counter_shapes(front: bool) -> tuple[Shape, ...]:
    """A counter's top; with its `front` side where a floor cell lies below it."""
    top = (
        Rect(0, 0, TILE, TILE, COUNTER_EDGE),
        Rect(1.5, 1.5, TILE - 3, TILE - 3, COUNTER_TOP, 5),
    )
    if not front:
        return top
    return (
        Rect(0, 0, TILE, TILE, COUNTER_EDGE),
        Rect(1.5, 1.5, TILE - 3, TILE - 11, COUNTER_TOP, 5),
        Rect(0, TILE - 8, TILE, 8, COUNTER_FRONT),
    )


def _crate(items: tuple[Shape, ...]) -> tuple[Shape, ...]:
    return (
        Rect(9, 10, 46, 42, "#7d5430", 5, "#4f321a", 2),
        Rect(13, 14, 38, 34, "#5b3a1f", 3),
        *place(items, 24, 25, 0.86),
        *place(items, 41, 26, 0.86),
        *place(items, 32.5, 38, 0.98),
    )


_DISH_STACK: tuple[Shape, ...] = (
    *place(DISH, 33, 37, 1.55),
    *place(DISH, 32, 33, 1.55),
    *place(DISH, 31, 29, 1.55),
)


def _serving(number: int | None) -> tuple[Shape, ...]:
    """The hatch: a steel ledge with a bell cover; numbered where a kitchen has several."""
    hatch: tuple[Shape, ...] = (
        Rect(3, 3, TILE - 6, TILE - 6, "#5a6675", 7, "#3d4754", 2),
        Rect(8, 8, TILE - 16, TILE - 16, "#e9edf2", 5),
        Ellipse(32, 45, 19, 4.5, STEEL, STEEL_EDGE, 1.6),
        Polygon(
            ((16, 43), (17, 36), (20.5, 29.5), (26, 25), (32, 23.5), (38, 25), (43.5, 29.5),
             (47, 36), (48, 43)),
            "#d7dde5", STEEL_EDGE, 2,
        ),
        Line(((21.5, 37), (24, 32), (28, 29)), "#ffffff", 2.4),
        circle(32, 20, 3.4, "#f0b429", "#a87410", 1.4),
    )  # fmt: skip
    if number is None:
        return hatch
    label = Text(14.5, 19.5, str(number), 12, "#ffffff", "middle", bold=True)
    return (*hatch, circle(14.5, 15, 8.5, INK), label)


def station_shapes(kind: str, front: bool, number: int | None = None) -> tuple[Shape, ...]:
    """A cell that no one stands on: 'X' counter, 'P' pot (its stove only), 'O', 'T', 'D', 'S'.

    Raises:
        ValueError: the kind is unknown.
    """
    base = counter_shapes(front)
    if kind == "X":
        return base
    if kind == "O":
        return (*base, *_crate(ONION))
    if kind == "T":
        return (*base, *_crate(TOMATO))
    if kind == "D":
        return (*base, *_DISH_STACK)
    if kind == "S":
        return (*base, *_serving(number))
    if kind == "P":
        stove = Rect(3, 3, TILE - 6, TILE - 6, "#8b95a1", 7, "#626c78", 2)
        return (*base, stove, circle(32, 32, 26, "#767f8b"))
    raise ValueError(f"unknown terrain {kind!r}; expected one of 'XPOTDS' or a space")


def pot_shapes(content: int, timer: int, cook_time: int) -> tuple[Shape, ...]:
    """A pot with its ingredients, and from the first cooking step on a ring of progress.

    Args:
        content: 0 for an empty pot, else 4 * onions + tomatoes.
        timer: -1 before cooking, then the steps cooked; at `cook_time` the soup is ready.
        cook_time: steps from start to ready.
    """
    pot: tuple[Shape, ...] = (
        Rect(1.5, 27, 10, 10, "#3b414a", 4),
        Rect(52.5, 27, 10, 10, "#3b414a", 4),
        circle(32, 32, 22.5, "#4d545f", "#2f343c", 2),
        circle(32, 32, 17.5, "#262a31"),
    )
    if content == 0:
        return (*pot, Arc(32, 32, 14, 200, 250, "#3f4650", 2))
    onions, tomatoes = split_content(content)
    cooking = timer >= 0
    broth = _broth(onions, tomatoes) if cooking else "#5d7f99"
    heap = _ingredients(onions, tomatoes, spacing=10.6, scale=0.66)
    inside = (circle(32, 32, 16.5, broth), *place(heap, 32, 32))
    return (*pot, *inside, *_timer_shapes(timer, cook_time)) if cooking else (*pot, *inside)


def _timer_shapes(timer: int, cook_time: int) -> tuple[Shape, ...]:
    if timer >= cook_time:
        return (
            Arc(32, 32, 20, 0, 360, READY, 5),
            *(
                Line(((x + 1.8, 13), (x - 1.8, 9.5), (x + 1.8, 6), (x - 1.8, 2.5)), "#ffffff", 2.2)
                for x in (22, 33)
            ),
            circle(51, 51, 10.5, READY, "#ffffff", 2.4),
            Line(((46, 51.2), (49.8, 55), (56.2, 47.4)), "#ffffff", 3),
        )
    ring: tuple[Shape, ...] = (Arc(32, 32, 20, 0, 360, "#39404a", 5),)
    if timer > 0:
        ring = (*ring, Arc(32, 32, 20, 0, 360 * timer / cook_time, PROGRESS, 5))
    return (
        *ring,
        circle(51, 51, 10.5, "#ffffff", PROGRESS, 2.4),
        Text(51, 55.3, str(cook_time - timer), 12, INK, "middle", bold=True),
    )


# --- What a style forbids the partner ------------------------------------------------------------


def forbidden_floor_shapes() -> tuple[Shape, ...]:
    """Hatching for a floor cell that the partner may not enter."""
    stripes = tuple(
        Line(((x, TILE + 2), (x + TILE + 4, -2)), "#8d7f6a", 3, 0.22)
        for x in (-50.0, -34.0, -18.0, -2.0, 14.0, 30.0, 46.0)
    )
    return (Rect(0, 0, TILE, TILE, "#8d7f6a", opacity=0.13), *stripes)


# A station that the partner may not use has a veil under its content and a "no" mark above it.
FORBIDDEN_VEIL: tuple[Shape, ...] = (Rect(0, 0, TILE, TILE, "#f4efe6", opacity=0.55),)
FORBIDDEN_SYMBOL: tuple[Shape, ...] = (
    circle(0, 0, 4.2, "#ffffff", FORBIDDEN, 1.5),
    Line(((-2.9, 2.9), (2.9, -2.9)), FORBIDDEN, 1.5),
)
FORBIDDEN_MARK = place(FORBIDDEN_SYMBOL, 52, 12, 1.9)
