"""Files of pictures: a scene as SVG or PNG, an episode of any environment as GIF."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from envs.drawing import Scene, Shape, panel_box, panel_image, to_image, to_svg

_GIF_COLOURS = 255
# The palette's last entry is transparent: "as in the frame before", which compresses to nothing.
_UNCHANGED = 255
_PALETTE_SCENES = 24


def save_svg(path: str | Path, scene: Scene) -> None:
    """Write the scene as an SVG file."""
    Path(path).write_text(to_svg(scene), encoding="utf-8")


def save_png(path: str | Path, scene: Scene, scale: float = 1.0) -> None:
    """Write the scene as a PNG file, `scale` pixels a unit (a tile is 64 units)."""
    to_image(scene, scale).save(path, format="PNG", optimize=True)


def save_gif(
    path: str | Path,
    env: Any,
    states: Any,
    *,
    style: Any = None,
    scores: Sequence[float] | np.ndarray | None = None,
    title: str | None = None,
    caption: str | None = None,
    max_steps: int | None = None,
    fps: float | None = None,
    hold: float = 0.0,
    scale: float = 0.75,
) -> None:
    """Write an episode as an endlessly repeating GIF file.

    Args:
        path: the file.
        env: the environment; its `viewer.draw_state` draws the moments.
        states: the moments, as one state with a leading axis [T] or as a sequence of T states.
        style, title, caption, max_steps: as in the environment's `draw_state`.
        scores: sum of rewards so far at each moment, [T].
        fps: moments a second, at most 50 (viewers slow down faster files); the environment's
            `viewer.FPS` by default.
        hold: how much longer the last moment stays than the others, in seconds, 0 or more.
        scale: pixels a unit (a tile is 64 units).

    Raises:
        ValueError: no states, not as many scores as states, `fps` or `hold` out of range, or what
            `draw_state` raises.
    """
    speed = env.viewer.FPS if fps is None else fps
    if not 0 < speed <= 50:
        raise ValueError(f"fps must be in (0, 50], got {speed}")
    if not hold >= 0:
        raise ValueError(f"hold must be 0 seconds or more, got {hold}")
    moments = _split_time(states)
    if scores is not None and len(scores) != len(moments):
        raise ValueError(f"got {len(scores)} scores for {len(moments)} states")
    scenes = [
        env.viewer.draw_state(
            env,
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
    ticks = [round(100 * t / speed) for t in range(len(scenes) + 1)]
    ticks[-1] += round(100 * hold)
    durations = [10 * (after - before) for before, after in itertools.pairwise(ticks)]
    frames[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        transparency=_UNCHANGED,
        disposal=1,  # each frame stays under the next
        optimize=False,
    )


def _split_time(states: Any) -> list[Any]:
    if not hasattr(states, "time"):
        moments = [jax.tree.map(np.asarray, state) for state in states]
    else:
        arrays = jax.tree.map(np.asarray, states)
        if arrays.time.ndim != 1:
            raise ValueError(
                f"states need one leading axis [T], got time of shape {arrays.time.shape}; "
                "for a single state, use draw_state"
            )
        moments = [jax.tree.map(lambda leaf, t=t: leaf[t], arrays) for t in range(len(arrays.time))]
    if not moments:
        raise ValueError("an episode needs at least one state, got none")
    return moments


def _shared_palette_frames(scenes: Sequence[Scene], scale: float) -> list[Image.Image]:
    """Render scenes of one size and arrangement; from the second on, only what has changed."""
    palette = _palette(scenes, scale)
    colours = palette.getpalette() or []
    width, height = to_image(scenes[0], scale).size
    current = np.zeros((height, width), np.uint8)
    quantized: dict[tuple, np.ndarray] = {}
    drawn: list[tuple[Shape, ...] | None] = [None] * len(scenes[0].panels)
    frames = []
    for t, scene in enumerate(scenes):
        before = current.copy()
        for k, panel in enumerate(scene.panels):
            if panel.shapes == drawn[k]:
                continue
            image = panel_image(panel, scale, scene.background)
            key = (panel.shapes, image.size)
            if key not in quantized:
                plain = image.quantize(palette=palette, dither=Image.Dither.NONE)
                quantized[key] = np.asarray(plain)
            left, top, right, bottom = panel_box(panel, scale)
            current[top:bottom, left:right] = quantized[key]
            drawn[k] = panel.shapes
        indices = current.copy() if t == 0 else np.where(current == before, _UNCHANGED, current)
        frame = Image.fromarray(indices.astype(np.uint8), "P")
        frame.putpalette([*colours, *(0,) * (3 * (_UNCHANGED + 1) - len(colours))])
        frames.append(frame)
    return frames


def _palette(scenes: Sequence[Scene], scale: float) -> Image.Image:
    """A palette for the colours of a sample of the scenes."""
    sample = scenes[:: max(1, len(scenes) // _PALETTE_SCENES)]
    panels = {panel.shapes: panel for scene in sample for panel in scene.panels}
    images = [panel_image(panel, scale, sample[0].background) for panel in panels.values()]
    pixels = np.concatenate([np.asarray(image).reshape(-1, 3) for image in images])
    return Image.fromarray(pixels[None]).quantize(_GIF_COLOURS, Image.Quantize.MEDIANCUT, kmeans=1)
