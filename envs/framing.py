"""What the pictures of all environments share: the players' colours, a header and a caption."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

from envs.drawing import Panel, Rect, Scene, Shape, Text, circle, place, text_width, wrap_text

INK = "#2b2f38"
PROGRESS = "#f28c28"
PAGE = "#fffdf8"
_MUTED, _TRACK = "#6b7280", "#e6e0d4"
_MARGIN, _HEADER_HEIGHT = 10.0, 52.0
_CAPTION_SIZE, _CAPTION_LEADING = 13.0, 18.0

Legend = tuple[str, tuple[Shape, ...]]
"""A label and its symbol, drawn around (0, 0) and some 9 units wide."""


@dataclass(frozen=True)
class PlayerColours:
    """A player's main colour, its darker trim, a lighter shade, and the hair."""

    main: str
    dark: str
    light: str
    hair: str


# The two main colours differ in lightness too, for readers who can not tell blue from green.
EGO = PlayerColours(main="#2a62c8", dark="#173f8a", light="#c9dcfb", hair="#4a2f1d")
PARTNER = PlayerColours(main="#35b57c", dark="#147a4d", light="#d5f5e4", hair="#1f1b1a")


def frame(
    board: Iterable[Panel],
    width: float,
    height: float,
    *,
    title: str,
    score: float | None,
    time: int,
    max_steps: int,
    caption: str | None,
    legend: Iterable[Legend] = (),
) -> Scene:
    """Put a header above a board and a caption below it.

    Args:
        board: what is seen of the game, its origin at the top left.
        width: the board's width in units.
        height: the board's height in units.
        title: a short title; underscores are shown as spaces.
        score: sum of rewards so far, if it is to be shown.
        time: steps taken.
        max_steps: length of a game in steps.
        caption: a sentence to print below the board, wrapped to its width.
        legend: what else than the two players needs a word.
    """
    header = _header(width, title.replace("_", " "), score, f"step {time}/{max_steps}", legend)
    progress = _progress_bar(width, time / max_steps)
    panels = [Panel(0, 0, width, _HEADER_HEIGHT, header + progress)]
    panels += [dataclasses.replace(panel, y=panel.y + _HEADER_HEIGHT) for panel in board]
    bottom = _HEADER_HEIGHT + height
    if caption:
        footer = _caption(caption, width)
        footer_height = _MARGIN * 2 + _CAPTION_LEADING * (len(footer) - 1)
        panels.append(Panel(0, bottom, width, footer_height, footer))
        bottom += footer_height
    return Scene(width, bottom, PAGE, tuple(panels))


def _header(
    width: float, name: str, score: float | None, step: str, legend: Iterable[Legend]
) -> tuple[Shape, ...]:
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
    for label, symbol in (
        ("ego", (circle(0, 0, 4.5, EGO.main, EGO.dark, 1.2),)),
        ("partner", (circle(0, 0, 4.5, PARTNER.main, PARTNER.dark, 1.2),)),
        *legend,
    ):
        shapes.extend(place(symbol, x + 4.5, 36.5))
        shapes.append(Text(x + 13, 40.5, label, 11, _MUTED))
        x += 13 + text_width(label, 11) + 12
    return (*shapes, Text(right, 40.5, step, 11, _MUTED, "end"))


def _progress_bar(width: float, share: float) -> tuple[Shape, ...]:
    done = width * min(max(share, 0.0), 1.0)
    return (
        Rect(0, _HEADER_HEIGHT - 3, width, 3, _TRACK),
        Rect(0, _HEADER_HEIGHT - 3, done, 3, PROGRESS),
    )


def _caption(caption: str, width: float) -> tuple[Shape, ...]:
    lines = wrap_text(caption, _CAPTION_SIZE, width - 2 * _MARGIN - 8)
    bar = Rect(_MARGIN, 10, 3, _CAPTION_LEADING * len(lines), PARTNER.main, 1.5)
    rows = (
        Text(_MARGIN + 11, 23.5 + _CAPTION_LEADING * k, line, _CAPTION_SIZE, INK)
        for k, line in enumerate(lines)
    )
    return (bar, *rows)
