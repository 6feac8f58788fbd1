"""Fig. 5 and 12: what both players do in a game, in a strip of its moments."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import envs
from experiments.figures.style import new_figure, words
from experiments.gallery import STRIP, state_of

WIDTH = 1.75
"""Of a picture, inches."""

_environment = functools.lru_cache(maxsize=8)(envs.make)
"""The same one for both figures of an environment, so that its states are traced once."""


def strip_of_two(results: Mapping[str, Any]) -> Figure:
    """Fig. 5: strips of the first and the last style."""
    styles = results["styles"]
    return strips(results, [styles[0], styles[-1]])


def strip_of_all(results: Mapping[str, Any]) -> Figure:
    """Fig. 12: strips of all styles."""
    return strips(results, results["styles"])


def strips(results: Mapping[str, Any], styles: Sequence[str]) -> Figure:
    """A row of pictures a style, each with its step and the skill that was just shown.

    Args:
        results: the content of results.json, with `episodes`.
        styles: which of its styles.
    """
    env = _environment(results["environment"])
    pictures = {style: _pictures(env, style, results["episodes"][style]) for style in styles}
    height, width = next(iter(pictures.values()))[0].shape[:2]
    row = WIDTH * height / width + 0.8
    figure = new_figure(WIDTH * STRIP, row * len(styles))
    rows = figure.subfigures(len(styles), 1, squeeze=False)[:, 0]
    for part, (style, shown) in zip(rows, pictures.items(), strict=True):
        episode = results["episodes"][style]
        said = f"{words(style)}: “{episode['sentence']}” Return {episode['return']:.0f}."
        part.suptitle(said, x=0.01, ha="left", fontsize=8.5)
        strip = part.subplots(1, STRIP)
        for axes in strip:
            axes.set_axis_off()
        for axes, picture, moment in zip(strip, shown, episode["moments"], strict=False):
            axes.imshow(picture)
            axes.set_title(f"step {moment['step']}\n{moment['skill']}", fontsize=7, pad=3)
    return figure


def _pictures(env: Any, style: str, episode: Mapping[str, Any]) -> list[np.ndarray]:
    return [
        env.viewer.to_array(
            env.viewer.draw_state(
                env,
                state_of(env, moment["state"]),
                style=env.style(style),
                score=moment["score"],
            )
        )
        for moment in episode["moments"]
    ]
