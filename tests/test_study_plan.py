"""Orders are balanced, recordings are whole, pictures are what the reports show."""

import collections
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.drawing import Arc, Ellipse, Line, Panel, Polygon, Rect, Scene, Text
from experiments.study import pictures, recording
from experiments.study.plan import plan, williams

NAMES = ("haland", "oracle", "universal", "self-play", "other")


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_a_williams_design_is_balanced(count):
    rows = williams(count)
    for place in rows.T:
        assert len(set(collections.Counter(place.tolist()).values())) == 1
    assert all(sorted(row) == list(range(count)) for row in rows.tolist())
    followed = collections.Counter(
        pair for row in rows.tolist() for pair in itertools.pairwise(row)
    )
    assert len(followed) == count * (count - 1)
    assert len(set(followed.values())) <= 1


def test_a_williams_design_by_hand():
    assert williams(4).tolist() == [[0, 1, 3, 2], [1, 2, 0, 3], [2, 3, 1, 0], [3, 0, 2, 1]]
    with pytest.raises(ValueError, match="count is 0; expected at least one"):
        williams(0)


@given(st.integers(0, 200), st.integers(1, 5), st.integers(1, 3), st.integers(1, 8))
def test_everybody_meets_every_agent_equally_often(participant, count, blocks, styles):
    planned = plan(participant, NAMES[:count], blocks, styles, seed=1)
    assert len(planned) == count * blocks
    met = collections.Counter(one.condition for one in planned)
    assert met == dict.fromkeys(NAMES[:count], blocks)
    tasks = [one.style for one in planned]
    for start in range(0, len(tasks), styles):
        block = tasks[start : start + styles]
        assert len(set(block)) == len(block), "no task twice before all have come"
    assert planned == plan(participant, NAMES[:count], blocks, styles, seed=1)


def test_first_places_are_shared_by_all_agents():
    firsts = [plan(p, NAMES[:3], 2, 8, seed=0)[0].condition for p in range(12)]
    assert set(collections.Counter(firsts).values()) == {4}
    tasks = {tuple(one.style for one in plan(p, NAMES[:3], 2, 8, seed=0)) for p in range(12)}
    assert len(tasks) > 6


def test_plans_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="a condition stands twice in haland, haland"):
        plan(0, ("haland", "haland"), 1, 8, 0)
    with pytest.raises(ValueError, match="blocks is 0 and styles 8"):
        plan(0, ("haland",), 0, 8, 0)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 5),
            st.integers(0, 5),
            st.sampled_from([0.0, 20.0, -0.5]),
            st.floats(-5, 1e6),
        ),
        max_size=30,
    ),
    st.integers(1, 7),
)
def test_steps_come_back_as_they_were(steps, size):
    starts = range(0, len(steps), size)
    chunks = [(start, recording.pack(steps[start : start + size])) for start in starts]
    found = recording.unpack(reversed(chunks))
    assert [(int(a), int(b), float(r)) for a, b, r, _ in found] == [s[:3] for s in steps]
    late = [min(max(round(step[3]), 0), recording.MOST_LATE) for step in steps]
    assert found["late"].tolist() == late
    assert recording.actions_of(found).partner.tolist() == [step[1] for step in steps]


def test_damaged_recordings_are_noticed():
    whole = recording.pack([(1, 2, 0.0, 3.0)] * 4)
    with pytest.raises(ValueError, match="step 4 should come next, but step 6 does"):
        recording.unpack([(0, whole), (6, whole)])
    with pytest.raises(ValueError, match="step 4 should come next, but step 0 does"):
        recording.unpack([(0, whole), (0, whole)])
    with pytest.raises(ValueError, match="the steps from 0 on are 31 bytes, no whole steps"):
        recording.unpack([(0, whole[:-1])])
    chunks = [(6, whole), (0, whole), (4, whole[:9])]
    assert len(recording.sound_part(chunks)) == 4
    assert len(recording.sound_part([(0, whole), (6, whole)])) == 4
    assert len(recording.sound_part([])) == 0


def test_boards_share_pictures_and_tell_what_changed():
    def scene(*fills):
        panels = tuple(
            Panel(8.0 * i, 0.0, 8.0, 8.0, (Rect(0, 0, 8, 8, fill),)) for i, fill in enumerate(fills)
        )
        return Scene(8.0 * len(fills), 8.0, "#ffffff", panels)

    found = pictures.Pictures()
    first, second = (
        found.board(scene("#000", "#111", "#000")),
        found.board(scene("#000", "#000", "#222")),
    )
    assert (first, second) == ([0, 1, 0], [0, 0, 2])
    assert pictures.changes(first, second) == [[1, 0], [2, 2]]
    assert pictures.changes(None, second) == [[0, 0], [1, 0], [2, 2]]
    assert found[2] == [["r", 0, 0, 8, 8, 0.0, "#222", None, 0.0, 1.0]]
    assert pictures.tiles_of(scene("#000"))["tiles"] == [[0.0, 0.0, 8.0, 8.0]]


def test_every_kind_of_shape_can_be_sent():
    shapes = (
        Ellipse(1, 2, 3, 4, "#000"),
        Polygon(((0, 0), (1, 0.123), (1, 1)), "#000", "#111", 2.0),
        Line(((0, 0), (5, 5)), "#000", 1.5),
        Arc(1, 2, 3, 0, 90, "#000", 2),
        Text(1, 2, "three", 12, "#000", "middle", True),
    )
    found = pictures.Pictures()
    (number,) = found.board(Scene(9, 9, "#fff", (Panel(0, 0, 9, 9, shapes),)))
    assert found[number] == [
        ["e", 1, 2, 3, 4, "#000", None, 0.0, 1.0],
        ["p", [0, 0, 1, 0.12, 1, 1], "#000", "#111", 2.0, 1.0],
        ["l", [0, 0, 5, 5], "#000", 1.5, 1.0],
        ["a", 1, 2, 3, 0, 90, "#000", 2],
        ["t", 1, 2, 12, "three", "#000", "middle", True],
    ]


@pytest.mark.parametrize("name", ["overcooked/diverse_orders", "lbf/spread"])
def test_a_step_changes_few_tiles(name):
    import jax

    env = envs.make(name)
    style = env.style(env.style_names[0])
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state, _ = reset(jax.random.key(0), style)
    found, before = pictures.Pictures(), None
    sizes = []
    for index in range(20):
        board = found.board(env.viewer.draw_board(env, state, style=style))
        sizes.append(len(pictures.changes(before, board)))
        before = board
        actions = envs.Pair(np.int32(index % 4), np.int32((index + 1) % 4))
        state, _ = step(jax.random.key(index), state, actions, style)
    assert sizes[0] == len(env.viewer.draw_board(env, state).panels)
    assert max(sizes[1:]) <= 6
