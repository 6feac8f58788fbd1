"""Pictures of a Spread game: one state as SVG, PNG or array, an episode as GIF.

scene = draw_state(env, state, style=style, score=0, title="level 3", caption="The third smallest.")
save_png("field.png", scene, scale=2)
save_gif("episode.gif", env, states, style=style, scores=scores, title="level 3")
"""

from envs.drawing import to_array, to_image, to_svg
from envs.lbf.scene import draw_board, draw_state
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

FPS = 4.0
"""Steps of a game that an episode's picture shows in a second; games are short."""
