"""Spread's viewer: what is seen, where, and in which file."""

import itertools
import xml.etree.ElementTree as ElementTree

import jax
import numpy as np
import pytest
from PIL import Image, ImageColor

import envs
from envs import framing
from envs.lbf import spread, sprites, viewer
from envs.lbf.dynamics import State

TILE = int(sprites.TILE)
ORDER = np.array([3, 7, 0, 5, 1, 6, 2, 4])


@pytest.fixture(scope="module")
def env():
    return envs.make("lbf/spread")


@pytest.fixture(scope="module")
def state():
    """Food k has level k + 1 and lies at the k-th place of `ORDER`; the players stand inside."""
    return State(
        place=np.array([[4, 3], [5, 5]]),
        level=np.array([4, 4]),
        food_place=spread.PLACES[ORDER],
        food_level=np.arange(1, 9),
        time=np.array(7),
    )


def render(env, state, **options):
    return viewer.to_array(viewer.draw_state(env, state, **options))


def tile(env, picture, cell):
    """The pixels of one cell, found from the (caption-free) bottom."""
    row, column = cell
    top = picture.shape[0] - (env.rows - row) * TILE
    return picture[top : top + TILE, column * TILE : (column + 1) * TILE]


def share_of(pixels, colour):
    return np.mean((pixels == ImageColor.getrgb(colour)).all(axis=-1))


def changed_cells(env, before, after):
    return {
        cell
        for cell in np.ndindex(env.rows, env.columns)
        if (tile(env, before, cell) != tile(env, after, cell)).any()
    }


def place_of(level):
    row, column = spread.PLACES[ORDER[level - 1]]
    return int(row), int(column)


def texts_of(scene):
    root = ElementTree.fromstring(viewer.to_svg(scene))
    return [element.text for element in root.iter() if element.tag.endswith("}text")]


def test_the_viewer_comes_with_the_environment(env):
    assert env.viewer is viewer


def test_players_and_foods_are_seen_on_their_own_cells_only(env, state):
    picture = render(env, state)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (env.columns * TILE, 3)
    foods = {place_of(level) for level in range(1, 9)}
    for cell in np.ndindex(env.rows, env.columns):
        pixels = tile(env, picture, cell)
        assert (share_of(pixels, sprites.APPLE) > 0.05) == (cell in foods), cell
        assert (share_of(pixels, framing.EGO.main) > 0.05) == (cell == (4, 3)), cell
        assert (share_of(pixels, framing.PARTNER.main) > 0.05) == (cell == (5, 5)), cell


def test_a_food_of_a_higher_level_is_larger_and_says_its_level(env, state):
    picture = render(env, state)
    heights = []
    for level in range(1, 9):
        red = tile(env, picture, place_of(level)) == ImageColor.getrgb(sprites.APPLE)
        rows = np.flatnonzero(red.all(axis=-1).any(axis=1))
        heights.append(rows[-1] - rows[0])
    assert heights == sorted(heights)
    assert heights[-1] > 1.4 * heights[0]
    levels = [text for text in texts_of(viewer.draw_state(env, state)) if text in "12345678"]
    assert sorted(levels) == list("12345678")


@pytest.mark.parametrize("level", [1, 5, 8])
def test_a_taken_food_is_gone_and_nothing_else_changes(env, state, level):
    left = np.where(np.arange(1, 9) == level, 0, np.arange(1, 9))
    before, after = render(env, state), render(env, state.replace(food_level=left))
    assert changed_cells(env, before, after) == {place_of(level)}
    assert share_of(tile(env, after, place_of(level)), sprites.APPLE) == 0


@pytest.mark.parametrize("level", [1, 8])
def test_only_the_partner_and_the_food_that_it_wants_are_marked(env, state, level):
    style = env.style(f"level_{level}")
    plain, marked = render(env, state), render(env, state, style=style)
    assert changed_cells(env, plain, marked) == {place_of(level), (5, 5)}
    texts = texts_of(viewer.draw_state(env, state, style=style))
    assert "wanted: only the partner knows" in texts
    assert texts.count(str(level)) == 2  # on the food and in the partner's thoughts
    assert "wanted: only the partner knows" not in texts_of(viewer.draw_state(env, state))


def test_two_players_in_one_cell_are_both_seen(env, state):
    picture = render(env, state.replace(place=np.array([[4, 3], [4, 3]])))
    shared = tile(env, picture, (4, 3))
    assert share_of(shared[:, : TILE // 2], framing.EGO.main) > 0.03
    assert share_of(shared[:, TILE // 2 :], framing.PARTNER.main) > 0.03
    assert share_of(shared[:, TILE // 2 :], framing.EGO.main) == 0


def test_header_and_caption_say_what_was_given(env, state):
    scene = viewer.draw_state(env, state, score=1, title="level_3", caption="a & b <c>")
    texts = texts_of(scene)
    for expected in ("level 3", "score", "1", "step 7/50", "a & b <c>", "ego", "partner"):
        assert expected in texts
    assert "step 7/20" in texts_of(viewer.draw_state(env, state, max_steps=20))
    assert "lbf/spread" in texts_of(viewer.draw_state(env, state))


def test_no_two_texts_of_the_header_overlap(env, state):
    scene = viewer.draw_state(env, state, style=env.style("level_3"), score=1, title="level 3")
    root = ElementTree.fromstring(viewer.to_svg(scene))
    header = next(element for element in root if element.tag.endswith("}svg"))
    lines: dict[float, list[tuple[float, float]]] = {}
    for text in (element for element in header if element.tag.endswith("}text")):
        start, length = float(text.attrib["x"]), float(text.attrib["textLength"])
        if text.attrib["text-anchor"] == "end":
            start -= length
        lines.setdefault(round(float(text.attrib["y"]) / 10), []).append((start, start + length))
    assert sorted(len(spans) for spans in lines.values()) == [3, 4]
    for spans in lines.values():
        ordered = sorted(spans)
        assert ordered[0][0] >= 0
        assert ordered[-1][1] <= scene.width
        for (_, end), (start, _) in itertools.pairwise(ordered):
            assert end < start


def test_png_and_svg_files_hold_the_picture(tmp_path, env, state):
    scene = viewer.draw_state(env, state, caption="Hello")
    viewer.save_png(tmp_path / "a.png", scene)
    viewer.save_svg(tmp_path / "a.svg", scene)
    saved = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    np.testing.assert_array_equal(saved, viewer.to_array(scene))
    assert (tmp_path / "a.svg").read_text(encoding="utf-8") == viewer.to_svg(scene)


def test_gif_shows_every_moment_in_its_colours_and_holds_the_last(tmp_path, env, state):
    walk = [state.replace(place=np.array([[4, 3 + t], [5, 5]]), time=np.array(t)) for t in (0, 1)]
    left = np.where(np.arange(1, 9) == 3, 0, np.arange(1, 9))
    moments = [*walk, walk[1].replace(food_level=left, time=np.array(2))]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *moments)
    options = {"style": env.style("level_3"), "caption": "Number 3, please."}
    path = tmp_path / "a.gif"
    viewer.save_gif(path, env, stacked, scores=[0, 0, 1], hold=1.0, scale=0.5, **options)
    gif = Image.open(path)
    assert gif.n_frames == 3
    durations = []
    for t, moment in enumerate(moments):
        gif.seek(t)
        durations.append(gif.info["duration"])
        scene = viewer.draw_state(env, moment, score=float(t == 2), **options)
        wanted = viewer.to_array(scene, 0.5).astype(int)
        shown = np.asarray(gif.convert("RGB")).astype(int)
        assert np.abs(shown - wanted).mean() < 2.0
    assert durations == [1000 / viewer.FPS, 1000 / viewer.FPS, 1000 + 1000 / viewer.FPS]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"place": np.array([[4, 9], [5, 5]])}, r"state\.place must be in"),
        ({"place": np.array([[-1, 0], [5, 5]])}, r"state\.place must be in"),
        ({"place": np.zeros((3, 2, 2), int)}, "one unbatched state"),
        ({"place": np.array([[0, 0], [5, 5]])}, r"stands on the food at \(row, column\) \(0, 0\)"),
        ({"food_level": np.full(8, 9)}, r"food_level must be in \[0, 9\)"),
        ({"food_level": np.ones(3, int)}, r"food_level must have shape \(8,\)"),
        ({"food_place": np.zeros((8, 2), int)}, "two foods lie in one cell"),
    ],
)
def test_impossible_states_are_refused(env, state, change, message):
    with pytest.raises(ValueError, match=message):
        viewer.draw_state(env, state.replace(**change))


def test_wrong_styles_are_refused(env, state):
    with pytest.raises(ValueError, match="not the stack of all"):
        viewer.draw_state(env, state, style=env.styles)
    with pytest.raises(ValueError, match=r"style\.target must be in \[1, 8\], got 9"):
        viewer.draw_state(env, state, style=env.style("level_8").replace(target=np.array(9)))
