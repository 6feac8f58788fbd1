"""The Overcooked viewer: what is seen, where, and in which file."""

import xml.etree.ElementTree as ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageColor

from envs import drawing, registry
from envs.overcooked import chefs, dynamics, scene, sprites, viewer
from envs.overcooked.layouts import CLASSIC, STYLED

TILE = int(sprites.TILE)
NORTH, SOUTH, EAST, WEST = range(4)
SOUPS = [4 + 4 * o + t for o in range(4) for t in range(4) if 1 <= o + t <= 3]


def make(name):
    return registry.make(f"overcooked/{name}")


@pytest.fixture(scope="module")
def kitchen():
    return make("center_pots")


@pytest.fixture(scope="module")
def layout(kitchen):
    return kitchen.layout


@pytest.fixture(scope="module")
def state(layout):
    return jax.tree.map(np.asarray, dynamics.start_state(layout))


def tile(env, picture, x, y):
    """The pixels of one tile, found from the picture's width and its (caption-free) bottom."""
    top = picture.shape[0] - env.layout.height * TILE + y * TILE
    return picture[top : top + TILE, x * TILE : (x + 1) * TILE]


def share_of(pixels, colour):
    return np.mean((pixels == ImageColor.getrgb(colour)).all(axis=-1))


def render(env, state, **options):
    return viewer.to_array(viewer.draw_state(env, state, **options))


def changed_tiles(env, before, after):
    return {
        (x, y)
        for y in range(env.layout.height)
        for x in range(env.layout.width)
        if (tile(env, before, x, y) != tile(env, after, x, y)).any()
    }


@pytest.mark.parametrize("name", STYLED + CLASSIC)
def test_each_chef_is_seen_on_its_own_tile_only(name):
    env = make(name)
    layout = env.layout
    picture = render(env, dynamics.start_state(layout))
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (layout.width * TILE, 3)
    positions = [tuple(layout.floor[cell]) for cell in layout.start]
    for y in range(layout.height):
        for x in range(layout.width):
            for agent, colours in enumerate((chefs.EGO, chefs.PARTNER)):
                share = share_of(tile(env, picture, x, y), colours.main)
                assert (share > 0.05) == ((x, y) == positions[agent]), (x, y, agent)


@pytest.mark.parametrize("agent", [0, 1])
def test_a_turn_changes_that_chef_only_and_each_direction_looks_different(kitchen, state, agent):
    pictures = [
        render(kitchen, state.replace(orientation=np.where(np.arange(2) == agent, way, SOUTH)))
        for way in range(4)
    ]
    place = {tuple(kitchen.layout.floor[kitchen.layout.start[agent]])}
    for i in range(4):
        for j in range(i):
            assert changed_tiles(kitchen, pictures[i], pictures[j]) == place


def test_a_held_item_is_on_the_side_that_the_chef_faces(kitchen, state):
    x, y = kitchen.layout.floor[kitchen.layout.start[0]]
    centres = {}
    for way in range(4):
        turned = state.replace(orientation=np.array([way, SOUTH]))
        empty, full = (
            tile(kitchen, render(kitchen, turned.replace(held=np.array(held))), x, y).astype(int)
            for held in ([0, 0], [2, 0])
        )
        red = (full[..., 0] - full[..., 1] > 110) & (empty != full).any(axis=-1)
        rows, columns = np.nonzero(red)
        assert len(rows) > 50
        centres[way] = (columns.mean(), rows.mean())
    assert centres[EAST][0] > 44
    assert centres[WEST][0] < 20
    assert centres[NORTH][1] < 24
    assert centres[SOUTH][1] > 42


def test_every_item_looks_different_in_hand_and_on_a_counter(kitchen, state):
    seen_on_counter, seen_in_hand = set(), set()
    chef = kitchen.layout.floor[kitchen.layout.start[0]]
    for code in [0, 1, 2, 3, *SOUPS]:
        counters = np.zeros(kitchen.layout.num_counters, int)
        counters[0] = code
        picture = render(kitchen, state.replace(counters=counters))
        seen_on_counter.add(tile(kitchen, picture, *kitchen.layout.stations[0]).tobytes())
        picture = render(kitchen, state.replace(held=np.array([code, 0])))
        seen_in_hand.add(tile(kitchen, picture, *chef).tobytes())
    assert len(seen_on_counter) == len(seen_in_hand) == 4 + len(SOUPS)


def test_a_pot_shows_its_content_the_remaining_steps_and_when_it_is_ready(kitchen, state):
    pot = kitchen.layout.stations[kitchen.layout.num_counters]

    def pot_tile(content, timer):
        contents, timers = np.array([content, 0]), np.array([timer, -1])
        picture = render(kitchen, state.replace(pot_content=contents, pot_timer=timers))
        return tile(kitchen, picture, *pot)

    onion, two, mixed = (pot_tile(content, -1) for content in (4, 8, 5))
    assert len({t.tobytes() for t in (pot_tile(0, -1), onion, two, mixed)}) == 4
    progress = [share_of(pot_tile(12, timer), sprites.PROGRESS) for timer in (-1, 0, 5, 10, 19, 20)]
    assert progress[0] == progress[5] == 0
    assert 0 < progress[1] < progress[2] < progress[3] < progress[4]
    ready = [share_of(pot_tile(12, timer), sprites.READY) for timer in (-1, 0, 19, 20)]
    assert ready[:3] == [0, 0, 0]
    assert ready[3] > 0.05
    texts = [s.text for s in sprites.pot_shapes(12, 13, 20) if isinstance(s, drawing.Text)]
    assert texts == ["7"]


@pytest.mark.parametrize(
    ("kitchen_name", "style_name"),
    [("center_pots", "upper_left"), ("crossway", "deliver_left"), ("crossway", "upper_no_dish")],
)
def test_exactly_what_a_style_forbids_is_marked(kitchen_name, style_name):
    env = make(kitchen_name)
    layout, style = env.layout, env.style(style_name)
    state = dynamics.start_state(layout, style.start)
    marked = changed_tiles(env, render(env, state), render(env, state, style=style))
    floor = layout.floor[~np.asarray(style.cells[1])]
    stations = layout.stations[~np.asarray(style.targets[1])]
    assert len(floor)
    assert marked == {tuple(place) for place in (*floor, *stations)}
    picture = render(env, state, style=style)
    for place in marked:
        share = share_of(tile(env, picture, *place), sprites.FORBIDDEN)
        assert (share > 0.01) == (place in {tuple(s) for s in stations})


def test_a_room_closed_to_the_partner_by_its_walls_has_no_marks():
    env = make("diverse_coordination")
    style = env.style("left_no_onion")
    state = dynamics.start_state(env.layout, style.start)
    marked = changed_tiles(env, render(env, state), render(env, state, style=style))
    assert {(5, 3), (6, 3), (7, 3)} < marked  # the partner's room, right half
    assert (1, 4) in marked  # its onions
    assert not any(y < 2 for _, y in marked)


def test_header_and_caption_say_what_was_given(kitchen, state):
    picture = viewer.draw_state(
        kitchen,
        state.replace(time=np.array(123)),
        score=60,
        title="upper_left",
        caption="a & b <c>",
    )
    svg = viewer.to_svg(picture)
    texts = [e.text for e in ElementTree.fromstring(svg).iter() if e.tag.endswith("}text")]
    for expected in ("upper left", "score", "60", "step 123/400", "a & b <c>", "ego", "partner"):
        assert expected in texts
    without = viewer.to_svg(viewer.draw_state(kitchen, state))
    assert "score" not in without
    assert "center pots" in without


def test_captions_wrap_to_the_width_and_lose_no_word():
    sentence = "I will stay on the upper side and put onions into both pots, " * 4
    lines = drawing.wrap_text(sentence, 13, 300)
    assert len(lines) > 3
    assert all(drawing.text_width(line, 13) <= 300 for line in lines)
    assert " ".join(lines).split() == sentence.split()


def test_svg_holds_the_same_shapes_as_the_image(kitchen, state):
    picture = viewer.draw_state(kitchen, state, style=kitchen.style("left"), caption="Hello")
    root = ElementTree.fromstring(viewer.to_svg(picture))
    name = "{http://www.w3.org/2000/svg}"
    panels = root.findall(f"{name}svg")
    assert [len(panel) for panel in panels] == [len(panel.shapes) for panel in picture.panels]
    assert float(root.attrib["width"]) == picture.width
    assert root.attrib["viewBox"] == f"0 0 {picture.width:g} {picture.height:g}"


def test_pictures_are_deterministic_and_scale(kitchen, state):
    picture = viewer.draw_state(kitchen, state, score=20)
    drawing._render.cache_clear()
    first = viewer.to_array(picture)
    drawing._render.cache_clear()
    np.testing.assert_array_equal(first, viewer.to_array(picture))
    assert viewer.to_svg(picture) == viewer.to_svg(viewer.draw_state(kitchen, state, score=20))
    for scale in (0.5, 1.3, 2.0):
        size = (round(picture.width * scale), round(picture.height * scale))
        assert viewer.to_image(picture, scale).size == size
    with pytest.raises(ValueError, match="scale must be positive"):
        viewer.to_image(picture, 0)


@pytest.mark.parametrize("scale", [0.05, 0.2, 1.0])
def test_lines_thinner_than_a_pixel_are_drawn(scale):
    across = drawing.Line(((2.0, 10.0), (18.0, 10.0)), stroke="#ff0000", width=0.8)
    paper = drawing.Panel(0, 0, 20, 20, (across,))
    image = viewer.to_image(drawing.Scene(20, 20, "#ffffff", (paper,)), scale)
    assert (np.asarray(image) != 255).any()


def test_png_and_svg_files_hold_the_picture(tmp_path, kitchen, state):
    picture = viewer.draw_state(kitchen, state)
    viewer.save_png(tmp_path / "a.png", picture)
    viewer.save_svg(tmp_path / "a.svg", picture)
    saved = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    np.testing.assert_array_equal(saved, viewer.to_array(picture))
    assert (tmp_path / "a.svg").read_text(encoding="utf-8") == viewer.to_svg(picture)


@pytest.fixture(scope="module")
def episode():
    """Forty random steps in the two rooms: environment, states [T]."""
    env = make("diverse_coordination")
    layout = env.layout
    actions = jax.random.randint(jax.random.key(0), (40, 2), 0, 6)

    def play(state, pair):
        transition = dynamics.step(
            layout,
            state,
            pair,
            cells=jnp.ones((2, len(layout.floor)), bool),
            targets=jnp.ones((2, len(layout.stations)), bool),
        )
        return transition.after, transition.after

    start = dynamics.start_state(layout)
    return env, jax.jit(lambda: jax.lax.scan(play, start, actions))()[1]


@pytest.mark.parametrize("fps", [8.0, 10.0])
def test_gif_has_every_frame_the_right_duration_and_the_right_colours(tmp_path, episode, fps):
    env, states = episode
    scores = np.arange(40.0)
    path = tmp_path / "episode.gif"
    viewer.save_gif(path, env, states, scores=scores, caption="Hello", fps=fps, scale=0.5)
    gif = Image.open(path)
    assert gif.n_frames == 40
    assert gif.info["loop"] == 0
    duration = 0
    for t in range(40):
        gif.seek(t)
        duration += gif.info["duration"]
        if t in (0, 17, 39):
            moment = jax.tree.map(lambda leaf, t=t: leaf[t], states)
            picture = viewer.draw_state(env, moment, score=scores[t], caption="Hello")
            wanted = viewer.to_array(picture, 0.5).astype(int)
            shown = np.asarray(gif.convert("RGB")).astype(int)
            assert np.abs(shown - wanted).mean() < 2.0
            assert np.mean(np.abs(shown - wanted).max(axis=-1) > 48) < 0.003
    assert duration == pytest.approx(1000 * 40 / fps, abs=10)


def test_a_held_gif_shows_its_last_moment_longer(tmp_path, episode):
    env, states = episode
    few = jax.tree.map(lambda leaf: leaf[:4], states)
    viewer.save_gif(tmp_path / "a.gif", env, few, hold=1.0, scale=0.5)
    gif = Image.open(tmp_path / "a.gif")
    shown = []
    for t in range(gif.n_frames):
        gif.seek(t)
        shown.append(gif.info["duration"])
    assert len(shown) == 4
    assert shown[:3] == pytest.approx([1000 / viewer.FPS] * 3, abs=10)
    assert shown[3] == pytest.approx(1000 + 1000 / viewer.FPS, abs=10)


def test_the_viewer_comes_with_the_environment(kitchen):
    assert kitchen.viewer is viewer


def test_gif_from_a_list_equals_gif_from_a_stacked_state(tmp_path, episode):
    env, states = episode
    few = jax.tree.map(lambda leaf: leaf[:5], states)
    listed = [jax.tree.map(lambda leaf, t=t: leaf[t], states) for t in range(5)]
    viewer.save_gif(tmp_path / "a.gif", env, few, scale=0.5)
    viewer.save_gif(tmp_path / "b.gif", env, listed, scale=0.5)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_a_long_gif_is_small(tmp_path, episode):
    env, states = episode
    ten_times = jax.tree.map(lambda leaf: np.concatenate([leaf] * 10), states)
    ten_times = ten_times.replace(time=np.arange(1, 401))
    viewer.save_gif(tmp_path / "a.gif", env, ten_times, title="left", caption="Hello")
    assert Image.open(tmp_path / "a.gif").n_frames == 400
    assert (tmp_path / "a.gif").stat().st_size < 1.5e6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"held": np.array([20, 0])}, r"held must be in \[0, 19\]"),
        ({"held": np.array([4, 0])}, "no item with code 4"),
        ({"held": np.array([11, 0])}, "no item with code 11"),
        ({"orientation": np.array([0, 4])}, "orientation must be in"),
        ({"cell": np.array([0, 99])}, "cell must be in"),
        ({"cell": np.array([3, 3])}, "both players stand on floor cell 3"),
        ({"counters": np.zeros(3, int)}, "counters must have shape"),
        ({"pot_content": np.array([7, 0])}, "content 7 is not"),
        ({"pot_timer": np.array([5, -1])}, "empty pot"),
        ({"pot_timer": np.array([21, -1]), "pot_content": np.array([12, 0])}, "pot_timer must be"),
        ({"cell": np.zeros((3, 2), int)}, "one unbatched state"),
    ],
)
def test_impossible_states_are_refused(kitchen, state, change, message):
    with pytest.raises(ValueError, match=message):
        viewer.draw_state(kitchen, state.replace(**change))


def test_wrong_arguments_are_refused(tmp_path, kitchen, state):
    with pytest.raises(ValueError, match=r"style\.cells must have shape"):
        viewer.draw_state(kitchen, state, style=make("crossway").style("upper_left"))
    path = tmp_path / "a.gif"
    with pytest.raises(ValueError, match="2 scores for 1 states"):
        viewer.save_gif(path, kitchen, [state], scores=[0, 1])
    with pytest.raises(ValueError, match="fps must be in"):
        viewer.save_gif(path, kitchen, [state], fps=0)
    with pytest.raises(ValueError, match="hold must be"):
        viewer.save_gif(path, kitchen, [state], hold=-1)
    with pytest.raises(ValueError, match="at least one state"):
        viewer.save_gif(path, kitchen, [])
    with pytest.raises(ValueError, match="one leading axis"):
        viewer.save_gif(path, kitchen, state)
    with pytest.raises(ValueError, match="unknown terrain"):
        sprites.station_shapes("Z", front=False)
    assert not path.exists()
    assert scene.draw_state is viewer.draw_state
