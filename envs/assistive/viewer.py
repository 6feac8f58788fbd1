"""Pictures of a game with the arm: one state as SVG, PNG or array, an episode as GIF or page.

scene = draw_state(env, state, style=style, score=0, title="feed left", caption="I turn left.")
save_png("moment.png", scene, scale=2)
save_gif("episode.gif", env, states, style=style, scores=scores, title="feed left")
save_html("episode.html", env, states)  # Brax's viewer: turn and zoom in a browser
"""

# MuJoCo's compiled classes have no types for a checker.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from envs.assistive import model
from envs.assistive.scene import draw_state
from envs.drawing import to_array, to_image, to_svg
from envs.pictures import save_gif, save_png, save_svg

if TYPE_CHECKING:
    from envs.assistive.env import Assistive

__all__ = [
    "FPS",
    "draw_state",
    "render",
    "save_gif",
    "save_html",
    "save_png",
    "save_svg",
    "to_array",
    "to_image",
    "to_svg",
]

FPS = 20.0
"""Steps of a game that an episode's picture shows in a second: twice as fast as it happens."""


def save_html(path: str | Path, env: Assistive, states: Any, *, height: int = 600) -> None:
    """Writes an episode as a page with Brax's viewer, which can be turned and zoomed.

    The page loads the viewer's script from the network when it is opened.

    Args:
        path: the file.
        env: the environment.
        states: the moments, with the leading axis [T].
        height: of the picture, pixels.
    """
    del env
    from brax import base
    from brax.io import html, mjcf

    system = mjcf.load_model(model.mujoco_model())
    trajectory = []
    for moment in zip(np.asarray(states.body.angles), np.asarray(states.body.seat), strict=True):
        data = model.posed(*moment)
        place = base.Transform(pos=data.xpos[1:].copy(), rot=data.xquat[1:].copy())
        trajectory.append(
            base.State(q=data.qpos, qd=data.qvel, x=place, xd=None, contact=None)  # pyright: ignore
        )
    Path(path).write_text(html.render(system, trajectory, height=height), encoding="utf-8")


def render(state: Any, *, width: int = 640, height: int = 480, camera: str = "front") -> np.ndarray:
    """Renders a moment with MuJoCo, uint8 [height, width, 3].

    Args:
        state: the moment, unbatched.
        width: pixels, at most 960.
        height: pixels, at most 720.
        camera: name of a camera of the model.

    Raises:
        RuntimeError: there is no OpenGL; without a screen set `MUJOCO_GL` to `egl` or `osmesa`.
    """
    data = model.posed(np.asarray(state.body.angles), np.asarray(state.body.seat))
    try:
        renderer = mujoco.Renderer(model.mujoco_model(), height, width)
    except Exception as error:
        raise RuntimeError(
            "MuJoCo found no OpenGL; without a screen set MUJOCO_GL to egl or osmesa, or use "
            "draw_state, which needs none"
        ) from error
    with renderer:
        renderer.update_scene(data, camera=camera)
        return renderer.render()
