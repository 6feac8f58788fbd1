"""Pictures of an Overcooked game: one state as SVG, PNG or array, an episode as GIF.

scene = draw_state(env, state, style=style, score=40, title="left", caption="I stay left.")
save_png("kitchen.png", scene, scale=2)
save_gif("episode.gif", env, states, style=style, scores=scores, title="left")
"""

from envs.drawing import to_array, to_image, to_svg
from envs.overcooked.scene import draw_board, draw_state
from envs.pictures import save_gif, save_png, save_svg

__all__ = [
    "FPS",
    "draw_board",
    "draw_state",
    "save_gif",
    "save_png",
    "save_svg",
    "to_array",
    "to_image",
    "to_svg",
]

FPS = 8.0
"""Steps of a game that an episode's picture shows in a second."""
