"""A tiny scene description with two back ends: SVG text and Pillow images.

A picture is a `Scene` of non-overlapping rectangular `Panel`s, each holding shapes in its own
coordinates. Both back ends read the same shapes, so that the two can not drift apart. Equal panels
are rendered once: that makes the frames of an episode cheap.

Lengths are in scene units (one unit is one pixel at scale 1), x to the right, y downwards, angles
in degrees clockwise from twelve o'clock, colours "#rrggbb", opacities in [0, 1].
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

SUPERSAMPLING = 4
# The outline that stands for bold type, as a fraction of the type's size; the bundled font has one
# weight only.
_BOLD_STROKE = 0.025


@dataclass(frozen=True)
class Rect:
    """A rectangle with its top left corner at (x, y), corners rounded by `radius`."""

    x: float
    y: float
    width: float
    height: float
    fill: str | None = None
    radius: float = 0.0
    stroke: str | None = None
    stroke_width: float = 0.0
    opacity: float = 1.0


@dataclass(frozen=True)
class Ellipse:
    """An ellipse around (x, y) with radii `rx` and `ry`."""

    x: float
    y: float
    rx: float
    ry: float
    fill: str | None = None
    stroke: str | None = None
    stroke_width: float = 0.0
    opacity: float = 1.0


@dataclass(frozen=True)
class Polygon:
    """A closed polygon through `points`."""

    points: tuple[tuple[float, float], ...]
    fill: str | None = None
    stroke: str | None = None
    stroke_width: float = 0.0
    opacity: float = 1.0


@dataclass(frozen=True)
class Line:
    """An open line through `points`, with round caps and joints unless it is translucent."""

    points: tuple[tuple[float, float], ...]
    stroke: str
    width: float
    opacity: float = 1.0


@dataclass(frozen=True)
class Arc:
    """A part of the circle of radius `radius` around (x, y), from `start` clockwise to `end`."""

    x: float
    y: float
    radius: float
    start: float
    end: float
    stroke: str
    width: float


@dataclass(frozen=True)
class Text:
    """One line of text whose baseline starts, is centred or ends at (x, y)."""

    x: float
    y: float
    text: str
    size: float
    fill: str
    anchor: str = "start"  # start, middle, end
    bold: bool = False


Shape = Rect | Ellipse | Polygon | Line | Arc | Text


@dataclass(frozen=True)
class Panel:
    """A rectangle of the scene; its shapes are in its own coordinates and clipped to it."""

    x: float
    y: float
    width: float
    height: float
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class Scene:
    """A picture of `width` x `height` units: a background colour and panels that do not overlap."""

    width: float
    height: float
    background: str
    panels: tuple[Panel, ...]


def circle(
    x: float,
    y: float,
    radius: float,
    fill: str | None = None,
    stroke: str | None = None,
    stroke_width: float = 0.0,
    opacity: float = 1.0,
) -> Ellipse:
    """An ellipse with equal radii."""
    return Ellipse(x, y, radius, radius, fill, stroke, stroke_width, opacity)


_LENGTHS = ("width", "height", "radius", "stroke_width", "rx", "ry", "size")


def place(shapes: Iterable[Shape], x: float, y: float, scale: float = 1.0) -> tuple[Shape, ...]:
    """The shapes scaled about the origin, then moved by (x, y)."""
    placed = []
    for shape in shapes:
        change: dict[str, object] = {
            name: getattr(shape, name) * scale for name in _LENGTHS if hasattr(shape, name)
        }
        if isinstance(shape, Polygon | Line):
            change["points"] = tuple((x + px * scale, y + py * scale) for px, py in shape.points)
        else:
            change["x"], change["y"] = x + shape.x * scale, y + shape.y * scale
        placed.append(dataclasses.replace(shape, **change))
    return tuple(placed)


def text_width(text: str, size: float, bold: bool = False) -> float:
    """The width of `text` in units, in the bundled font at `size`."""
    return _font(100.0).getlength(text) * size / 100.0 + (bold * 2 * _BOLD_STROKE * size)


def wrap_text(text: str, size: float, width: float) -> tuple[str, ...]:
    """Break `text` at spaces into lines no wider than `width`; a longer word has its own line."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_width(f"{lines[-1]} {word}", size) <= width:
            lines[-1] = f"{lines[-1]} {word}"
        else:
            lines.append(word)
    return tuple(lines)


@functools.lru_cache(maxsize=64)
def _font(size: float) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("Pillow was built without FreeType, which text of any size needs.")
    return font


# --- SVG -----------------------------------------------------------------------------------------


def to_svg(scene: Scene) -> str:
    """The scene as a stand-alone SVG document."""
    size = f'width="{_number(scene.width)}" height="{_number(scene.height)}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} '
        f'viewBox="0 0 {_number(scene.width)} {_number(scene.height)}" '
        'font-family="Aileron, Helvetica, Arial, sans-serif">',
        f'<rect {size} fill="{scene.background}"/>',
    ]
    for panel in scene.panels:
        # A nested svg element clips its content, as pasting an image does.
        box = _attributes(x=panel.x, y=panel.y, width=panel.width, height=panel.height)
        lines.append(f"<svg {box}>")
        lines.extend(_svg_element(shape) for shape in panel.shapes)
        lines.append("</svg>")
    lines.append("</svg>")
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")


def _attributes(**values: str | float | None) -> str:
    pairs = (
        (name.replace("_", "-"), _number(value) if isinstance(value, int | float) else value)
        for name, value in values.items()
        if value is not None
    )
    return " ".join(f'{name}="{value}"' for name, value in pairs)


def _paint(shape: Rect | Ellipse | Polygon) -> str:
    return _attributes(
        fill=shape.fill or "none",
        stroke=shape.stroke,
        stroke_width=shape.stroke_width if shape.stroke else None,
        opacity=shape.opacity if shape.opacity < 1 else None,
        stroke_linejoin="round" if shape.stroke and isinstance(shape, Polygon) else None,
    )


def _svg_points(points: tuple[tuple[float, float], ...]) -> str:
    return " ".join(f"{_number(x)},{_number(y)}" for x, y in points)


def _svg_element(shape: Shape) -> str:
    if isinstance(shape, Rect):
        box = _attributes(x=shape.x, y=shape.y, width=shape.width, height=shape.height)
        return f"<rect {box} {_attributes(rx=shape.radius or None)} {_paint(shape)}/>"
    if isinstance(shape, Ellipse):
        box = _attributes(cx=shape.x, cy=shape.y, rx=shape.rx, ry=shape.ry)
        return f"<ellipse {box} {_paint(shape)}/>"
    if isinstance(shape, Polygon):
        return f'<polygon points="{_svg_points(shape.points)}" {_paint(shape)}/>'
    if isinstance(shape, Text):
        return _svg_text(shape)
    points = shape.points if isinstance(shape, Line) else _arc_points(shape)
    opacity = shape.opacity if isinstance(shape, Line) and shape.opacity < 1 else None
    cap = "butt" if opacity is not None else "round"
    paint = _attributes(
        stroke=shape.stroke,
        stroke_width=shape.width,
        stroke_linecap=cap,
        stroke_linejoin="round",
        opacity=opacity,
    )
    return f'<polyline points="{_svg_points(points)}" fill="none" {paint}/>'


def _svg_text(shape: Text) -> str:
    # textLength keeps the layout when the reader's machine lacks the font.
    place_and_size = _attributes(
        x=shape.x,
        y=shape.y,
        font_size=shape.size,
        fill=shape.fill,
        text_anchor=shape.anchor,
        textLength=text_width(shape.text, shape.size),
        lengthAdjust="spacingAndGlyphs",
        stroke=shape.fill if shape.bold else None,
        stroke_width=2 * _BOLD_STROKE * shape.size if shape.bold else None,
    )
    return f"<text {place_and_size}>{escape(shape.text)}</text>"


def _arc_points(arc: Arc) -> tuple[tuple[float, float], ...]:
    steps = max(2, math.ceil(abs(arc.end - arc.start) / 6))
    angles = (math.radians(arc.start + (arc.end - arc.start) * k / steps) for k in range(steps + 1))
    return tuple(
        (arc.x + arc.radius * math.sin(a), arc.y - arc.radius * math.cos(a)) for a in angles
    )


# --- Pillow --------------------------------------------------------------------------------------


def to_image(scene: Scene, scale: float = 1.0) -> Image.Image:
    """Render the scene in RGB, `scale` pixels a unit, smoothed by supersampling.

    Raises:
        ValueError: `scale` is not positive.
    """
    if not scale > 0:
        raise ValueError(f"scale must be positive, got {scale}")
    size = (round(scene.width * scale), round(scene.height * scale))
    image = Image.new("RGB", size, scene.background)
    for panel in scene.panels:
        left, top, right, bottom = panel_box(panel, scale)
        image.paste(panel_image(panel, scale, scene.background), (left, top, right, bottom))
    return image


def to_array(scene: Scene, scale: float = 1.0) -> np.ndarray:
    """Render the scene as an RGB array, uint8 [height, width, 3]."""
    return np.asarray(to_image(scene, scale))


def panel_box(panel: Panel, scale: float) -> tuple[int, int, int, int]:
    """The panel's left, top, right and bottom in pixels; neighbours share their edges."""
    edges = (panel.x, panel.y, panel.x + panel.width, panel.y + panel.height)
    left, top, right, bottom = (round(edge * scale) for edge in edges)
    return left, top, right, bottom


def panel_image(panel: Panel, scale: float, background: str) -> Image.Image:
    """The panel in RGB over `background`. Equal panels share one image: do not change it."""
    left, top, right, bottom = panel_box(panel, scale)
    units = (panel.width, panel.height)
    return _render(panel.shapes, units, (right - left, bottom - top), background)


@functools.lru_cache(maxsize=4096)
def _render(
    shapes: tuple[Shape, ...], units: tuple[float, float], size: tuple[int, int], background: str
) -> Image.Image:
    width, height = size
    image = Image.new("RGB", (width * SUPERSAMPLING, height * SUPERSAMPLING), background)
    scale = image.width / units[0]
    # In this mode a translucent colour is blended into the opaque image.
    pencil = ImageDraw.Draw(image, "RGBA")
    for shape in shapes:
        _draw(pencil, place((shape,), 0.0, 0.0, scale)[0])
    return image.reduce(SUPERSAMPLING)


def _rgba(colour: str | None, opacity: float = 1.0) -> tuple[int, ...] | None:
    return None if colour is None else (*ImageColor.getrgb(colour)[:3], round(255 * opacity))


def _draw(pencil: ImageDraw.ImageDraw, shape: Shape) -> None:
    """Draw one shape, given in pixels of the supersampled image."""
    if isinstance(shape, Text):
        _draw_text(pencil, shape)
    elif isinstance(shape, Line):
        _draw_line(pencil, shape)
    elif isinstance(shape, Arc):
        _draw_line(pencil, Line(_arc_points(shape), shape.stroke, shape.width))
    elif isinstance(shape, Polygon):
        if shape.fill:
            pencil.polygon(shape.points, fill=_rgba(shape.fill, shape.opacity))
        if shape.stroke:
            outline = (*shape.points, *shape.points[:2])
            _draw_line(pencil, Line(outline, shape.stroke, shape.stroke_width, shape.opacity))
    else:
        _draw_box(pencil, shape)


def _draw_box(pencil: ImageDraw.ImageDraw, shape: Rect | Ellipse) -> None:
    # SVG centres an outline on the edge, Pillow keeps it inside: hence `half`.
    half = shape.stroke_width / 2 if shape.stroke else 0.0
    paint = {
        "fill": _rgba(shape.fill, shape.opacity),
        "outline": _rgba(shape.stroke, shape.opacity),
        "width": round(shape.stroke_width) if shape.stroke else 0,
    }
    if isinstance(shape, Ellipse):
        left, top = shape.x - shape.rx - half, shape.y - shape.ry - half
        right, bottom = shape.x + shape.rx + half - 1, shape.y + shape.ry + half - 1
        if right >= left and bottom >= top:
            pencil.ellipse((left, top, right, bottom), **paint)
        return
    left, top = shape.x - half, shape.y - half
    right, bottom = shape.x + shape.width + half - 1, shape.y + shape.height + half - 1
    if right >= left and bottom >= top:
        pencil.rounded_rectangle((left, top, right, bottom), shape.radius + half, **paint)


def _draw_line(pencil: ImageDraw.ImageDraw, line: Line) -> None:
    colour = _rgba(line.stroke, line.opacity)
    pencil.line(line.points, fill=colour, width=max(1, round(line.width)), joint="curve")
    if line.opacity < 1 or line.width < 1:  # a cap thinner than a pixel has no box to fill
        return
    radius = line.width / 2
    for x, y in (line.points[0], line.points[-1]):
        pencil.ellipse((x - radius, y - radius, x + radius - 1, y + radius - 1), fill=colour)


def _draw_text(pencil: ImageDraw.ImageDraw, text: Text) -> None:
    pencil.text(
        (text.x, text.y),
        text.text,
        fill=text.fill,
        font=_font(round(text.size, 2)),
        anchor={"start": "ls", "middle": "ms", "end": "rs"}[text.anchor],
        stroke_width=_BOLD_STROKE * text.size if text.bold else 0,
    )
