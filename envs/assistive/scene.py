"""One moment of a game with the arm as a picture, drawn from the model's own primitives.

No OpenGL is needed: every primitive is projected through the model's camera and painted from far
to near, as capsules, discs and boxes with an outline.
"""

# MuJoCo's compiled classes have no types for a checker.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, NamedTuple

import jax
import mujoco
import numpy as np

from envs.assistive import model, physics, tasks
from envs.assistive.styles import TASKS, Style
from envs.drawing import Ellipse, Line, Panel, Polygon, Scene, Shape, Text, circle
from envs.framing import INK, PROGRESS, Legend, frame

if TYPE_CHECKING:
    from envs.assistive.env import Assistive, State

WIDTH, HEIGHT = 560.0, 440.0
_CAMERA = "front"
_FLOOR, _SHADOW = "#ece7da", "#d6cfbf"
_OUTLINE = 0.55
"""Brightness of an outline, as a share of its shape's."""
_WANTED_SYMBOL = (circle(0, 0, 4.5, stroke=PROGRESS, stroke_width=2.5),)
_WANTED: Legend = ("wanted: only the partner knows", _WANTED_SYMBOL)
_COUNTED = {
    "scratch": "strokes",
    "bathe": "points wiped",
    "feed": "portions eaten",
    "drink": "units drunk",
}


class _Camera(NamedTuple):
    """Where the picture is taken from: a place, axes to the right, up and backwards, a length."""

    place: np.ndarray
    axes: np.ndarray
    focal: float

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where world points [n, 3] are in the picture [n, 2], and how far away, m [n]."""
        right, up, back = (self.axes.T @ (points - self.place).T).reshape(3, -1)
        scale = self.focal / -back
        return np.stack([WIDTH / 2 + right * scale, HEIGHT / 2 - up * scale], axis=1), -back


def draw_state(
    env: Assistive,
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
        style: the partner's style; its target has a ring, and what is done is counted.
        score: sum of rewards so far, for the header.
        title: the style's name, or any short title; the environment's name by default.
        caption: a sentence to print below the picture, wrapped to its width.
        max_steps: length of a game in steps, for the header; the environment's by default.

    Raises:
        ValueError: the state is a batch, or has angles that are not finite.
    """
    angles = np.asarray(state.body.angles)
    if angles.shape != (len(model.JOINTS),) or not np.isfinite(angles).all():
        raise ValueError(
            f"the state has joint angles of shape {angles.shape}, the smallest "
            f"{angles.min() if angles.size else None}; expected {len(model.JOINTS)} finite numbers "
            "of one moment"
        )
    data = model.posed(angles, np.asarray(state.body.seat))
    board = (*_floor(), *_bodies(data))
    if style is not None:
        board += _wish(data, state, style)
    return frame(
        [Panel(0, 0, WIDTH, HEIGHT, board)],
        WIDTH,
        HEIGHT,
        title=env.name if title is None else title,
        score=None if score is None else round(score, 1),
        time=int(state.time),
        max_steps=max_steps or env.max_steps,
        caption=caption,
        legend=() if style is None else (_WANTED,),
    )


@functools.cache
def _camera() -> _Camera:
    data = mujoco.MjData(model.mujoco_model())
    mujoco.mj_forward(model.mujoco_model(), data)
    number = model.mujoco_model().camera(_CAMERA).id
    opening = math.radians(float(model.mujoco_model().cam_fovy[number]))
    return _Camera(
        data.cam_xpos[number].copy(),
        data.cam_xmat[number].reshape(3, 3).copy(),
        HEIGHT / (2 * math.tan(opening / 2)),
    )


@functools.cache
def _floor() -> tuple[Shape, ...]:
    """The floor and the chair's shadow."""
    around = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([0.55 * np.cos(around), 0.5 * np.sin(around) - 0.1, 0 * around], axis=1)
    shadow, _ = _camera().seen(ring)
    return (
        Polygon(((0.0, 0.0), (WIDTH, 0.0), (WIDTH, HEIGHT), (0.0, HEIGHT)), fill=_FLOOR),
        Polygon(tuple(map(tuple, shadow.tolist())), fill=_SHADOW),
    )


def _bodies(data: mujoco.MjData) -> tuple[Shape, ...]:
    """All primitives, the far ones first."""
    found = []
    for number in range(model.mujoco_model().ngeom):
        drawn = _primitive(data, number)
        if drawn is not None:
            found.append(drawn)
    found.sort(key=lambda one: -one[0])
    return tuple(shape for _, shapes in found for shape in shapes)


def _primitive(data: mujoco.MjData, number: int) -> tuple[float, tuple[Shape, ...]] | None:
    """A geom's distance and shapes; None for the floor."""
    known = model.mujoco_model()
    kind, size = mujoco.mjtGeom(int(known.geom_type[number])), known.geom_size[number]
    place, rotation = data.geom_xpos[number], data.geom_xmat[number].reshape(3, 3)
    fill = _colour(known.geom_rgba[number])
    edge = _colour(known.geom_rgba[number] * [_OUTLINE, _OUTLINE, _OUTLINE, 1])
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return None
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE):
        half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        ends, away = _camera().seen(place + np.outer([-half, half], rotation[:, 2]))
        width = float(2 * size[0] * _camera().focal / away.mean())
        points = tuple(map(tuple, ends.tolist()))
        if np.linalg.norm(ends[0] - ends[1]) < 1.0:
            (x, y), radius = ends.mean(axis=0).tolist(), width / 2
            shapes = (Ellipse(x, y, radius, radius, fill, stroke=edge, stroke_width=1.2),)
        else:
            shapes = (Line(points, edge, width + 2.4), Line(points, fill, width))
        return float(away.mean()), shapes
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = signs * size
    else:
        around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        rim = np.stack([size[0] * np.cos(around), size[0] * np.sin(around), 0 * around], axis=1)
        up = np.array([0.0, 0.0, size[1]])
        corners = np.concatenate([rim + up, rim - up])
    seen, away = _camera().seen(place + corners @ rotation.T)
    outline = tuple(map(tuple, _hull(seen).tolist()))
    return float(away.mean()), (Polygon(outline, fill, stroke=edge, stroke_width=1.2),)


_find_target = jax.jit(tasks.find_target)


def _wish(data: mujoco.MjData, state: State, style: Style) -> tuple[Shape, ...]:
    """A ring around the target, filled while it is presented, and what is done of the task."""
    target = _find_target(physics.read_poses(data), style, state.aim, state.progress)
    (spot,), _ = _camera().seen(np.asarray(target.place)[None])
    x, y = spot.tolist()
    ring = circle(x, y, 8.0, stroke=PROGRESS, stroke_width=3.0)
    dot = (circle(x, y, 4.0, fill=PROGRESS),) if bool(target.presented) else ()
    task = TASKS[int(style.task)]
    done = f"{_COUNTED[task]} {int(state.progress.done)}, success from {tasks.SUCCESS[task]}"
    return (ring, *dot, Text(12.0, HEIGHT - 14.0, done, 15.0, INK, bold=True))


def _hull(points: np.ndarray) -> np.ndarray:
    """The convex hull of points [n, 2], in order around it (Andrew's monotone chain)."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]

    def half(these: np.ndarray) -> list[np.ndarray]:
        kept: list[np.ndarray] = []
        for point in these:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], point) <= 0:
                kept.pop()
            kept.append(point)
        return kept[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _colour(rgba: np.ndarray) -> str:
    red, green, blue = (round(255 * float(part)) for part in rgba[:3])
    return f"#{red:02x}{green:02x}{blue:02x}"
