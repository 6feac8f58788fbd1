"""The four tasks on hand-made poses: targets, presenting, strokes, points, portions, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.assistive import events, reward, styles, tasks
from envs.assistive.physics import Physics, Poses

pytestmark = pytest.mark.full_compilation

ALL = styles.all_styles()


def style(name: str) -> styles.Style:
    """One style by name."""
    return jax.tree.map(lambda leaf: leaf[styles.style_names().index(name)], ALL)


def turned(degrees: float, axis: str) -> np.ndarray:
    """A rotation matrix about one axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def poses(*, tool=(0.0, 0.0, 0.0), tilt=0.0, lift=0.0, turn=0.0) -> Poses:
    """A person with a straight arm lifted sideways and the head turned, and a tool (degrees)."""
    shoulder, head = np.array([-0.179, 0.03, 1.03]), np.array([0.0, 0.03, 1.18])
    limb = turned(lift, "y")
    down = limb @ np.array([0.0, 0.0, -1.0])
    looks = turned(turn, "z")
    return Poses(
        tool=jnp.asarray(tool, jnp.float32),
        tool_rotation=jnp.asarray(turned(tilt, "x")),
        shoulder=jnp.asarray(shoulder),
        elbow=jnp.asarray(shoulder + tasks.UPPER_ARM * down),
        wrist=jnp.asarray(shoulder + (tasks.UPPER_ARM + tasks.FOREARM) * down),
        upper_arm_rotation=jnp.asarray(limb),
        forearm_rotation=jnp.asarray(limb),
        head=jnp.asarray(head),
        head_rotation=jnp.asarray(looks),
        mouth=jnp.asarray(head + looks @ np.array([0.0, -0.11, 0.03])),
    )


def pressing(upper_arm=0.0, forearm=0.0, head=0.0, hand=0.0) -> Physics:
    """A body at rest whose contacts press with some newtons."""
    rest = jnp.zeros(13)
    return Physics(jnp.zeros(3), rest, rest, rest, jnp.array([upper_arm, forearm, head, hand]))


def aim(along=0.5, around=45.0) -> tasks.Aim:
    """An itch or a line to bathe."""
    return tasks.Aim(jnp.asarray(along), jnp.radians(around))


def test_an_itch_lies_on_the_skin_where_it_was_drawn():
    hanging = poses()
    upper = tasks.find_target(
        hanging, style("scratch_upper_arm"), aim(0.5, 0.0), tasks.first_progress(ALL)
    )
    # Half-way down the upper arm, on the person's right: 0.043 beside its axis.
    np.testing.assert_allclose(upper.place, [-0.179 - 0.043, 0.03, 1.03 - 0.1395], atol=1e-6)
    front = tasks.find_target(
        hanging, style("scratch_forearm"), aim(0.25, 90.0), tasks.first_progress(ALL)
    )
    below = 1.03 - 0.279 - 0.25 * 0.257
    np.testing.assert_allclose(front.place, [-0.179, 0.03 - 0.033, below], atol=1e-6)


@pytest.mark.parametrize(("lift", "presented"), [(0.0, False), (29.0, False), (45.0, True)])
def test_an_arm_is_presented_when_it_is_lifted(lift, presented):
    found = tasks.find_target(
        poses(lift=lift), style("scratch_upper_arm"), aim(0.5, 110.0), tasks.first_progress(ALL)
    )
    assert bool(found.presented) is presented
    assert (float(found.effort) > 0) is not presented


@pytest.mark.parametrize(
    ("around", "effort"), [(116.0, 0.0), (102.0, 0.0), (130.0, 0.0), (66.0, 29.6), (-90.0, 134.4)]
)
def test_a_place_is_presented_on_the_side_of_the_robot(around, effort):
    """The robot is 116 degrees around an upper arm lifted by 45, seen from its middle."""
    found = tasks.find_target(
        poses(lift=45.0), style("scratch_upper_arm"), aim(0.5, around), tasks.first_progress(ALL)
    )
    assert bool(found.presented) is (effort == 0.0)
    assert np.degrees(found.effort) == pytest.approx(effort, abs=0.5)


@pytest.mark.parametrize("name", ["bathe_down", "bathe_up"])
def test_an_arm_is_bathed_on_the_side_of_the_robot(name):
    """Wherever an itch would be: lifted is presented, and the place is 116 degrees around."""
    at = poses(lift=45.0)
    for around in (45.0, 135.0):
        found = tasks.find_target(at, style(name), aim(0.5, around), tasks.first_progress(ALL))
        assert found.presented
        upper_end = at.shoulder if name == "bathe_down" else at.elbow
        x, y, _ = np.asarray(at.upper_arm_rotation.T @ (found.place - upper_end))
        assert np.degrees(np.arctan2(-y, -x)) == pytest.approx(115.6, abs=0.5)


@pytest.mark.parametrize(
    ("name", "turn", "presented"),
    [
        ("feed_left", 35.0, True),
        ("feed_left", 26.0, True),
        ("feed_left", 0.0, False),
        ("feed_left", -35.0, False),
        ("drink_right", -35.0, True),
        ("drink_right", 35.0, False),
    ],
)
def test_a_mouth_is_presented_when_the_head_is_turned_as_the_style_wants(name, turn, presented):
    found = tasks.find_target(poses(turn=turn), style(name), aim(), tasks.first_progress(ALL))
    assert bool(found.presented) is presented


def test_a_head_turned_left_looks_to_the_persons_left():
    assert float(tasks.head_turn(poses(turn=35.0))) == pytest.approx(np.radians(35.0))
    # The person faces -y, so its left is +x.
    assert float(poses(turn=35.0).mouth[0]) > 0.05


def scratched(*, press: float, offset=(0.0, 0.0, 0.0), last=(10.0, 10.0, 10.0), lift=45.0):
    """One step of scratching with the tool near the itch."""
    own, drawn = style("scratch_upper_arm"), aim(0.5, 110.0)
    progress = tasks.first_progress(own)
    place = tasks.find_target(poses(lift=lift), own, drawn, progress).place
    now = poses(lift=lift, tool=np.asarray(place) + np.array(offset))
    found = tasks.find_target(now, own, drawn, progress)
    if last is None:
        progress = progress.replace(stroke=found.tip)
    return tasks.advance(own, now, pressing(upper_arm=press), found, progress)


def test_a_gentle_touch_at_the_itch_is_a_stroke():
    outcome = scratched(press=3.0)
    assert int(outcome.gained) == 1
    assert int(outcome.progress.done) == 1


@pytest.mark.parametrize(
    "case",
    [
        {"press": 0.0},  # it does not touch
        {"press": 12.0},  # it hurts
        {"press": 3.0, "offset": (0.0, 0.0, 0.03)},  # it is beside the itch
        {"press": 3.0, "last": None},  # it has not moved since the last stroke
        {"press": 3.0, "lift": 10.0},  # the arm is not lifted
    ],
)
def test_no_stroke(case):
    assert int(scratched(**case).gained) == 0


@pytest.mark.parametrize(("name", "first"), [("bathe_down", 0.5), ("bathe_up", 19.5)])
def test_bathing_goes_along_the_arm_point_by_point(name, first):
    own, drawn, lifted = style(name), aim(0.5, 110.0), poses(lift=45.0)
    progress = tasks.first_progress(own)
    ways = []
    for _ in range(4):
        found = tasks.find_target(lifted, own, drawn, progress)
        now = poses(lift=45.0, tool=found.place)
        found = tasks.find_target(now, own, drawn, progress)
        ways.append(float(-found.tip[2]))
        outcome = tasks.advance(own, now, pressing(forearm=1.0), found, progress)
        assert int(outcome.gained) == 1
        progress = outcome.progress
    step = (tasks.UPPER_ARM + tasks.FOREARM) / 20
    expected = first * step - (tasks.UPPER_ARM if name == "bathe_up" else 0.0)
    assert ways[0] == pytest.approx(expected, abs=1e-5)
    np.testing.assert_allclose(np.diff(ways), step if name == "bathe_down" else -step, atol=1e-5)


@pytest.mark.parametrize("name", ["bathe_down", "bathe_up"])
def test_points_that_were_passed_by_are_lost(name):
    own, drawn, progress = style(name), aim(0.5, 110.0), tasks.first_progress(style(name))

    def touch(point, progress):
        """A touch at one of the points, counted in the style's order."""
        there = progress.replace(reached=jnp.array(point))
        place = tasks.find_target(poses(lift=45.0), own, drawn, there).place
        now = poses(lift=45.0, tool=place)
        found = tasks.find_target(now, own, drawn, progress)
        return tasks.advance(own, now, pressing(upper_arm=1.0), found, progress)

    ahead = touch(5, progress)
    assert (int(ahead.gained), int(ahead.progress.done), int(ahead.progress.reached)) == (1, 1, 6)
    behind = touch(3, ahead.progress)
    assert (int(behind.gained), int(behind.progress.reached)) == (0, 6)
    again = touch(5, ahead.progress)
    assert int(again.gained) == 0
    last = touch(19, ahead.progress)
    assert (int(last.gained), int(last.progress.done), int(last.progress.reached)) == (1, 2, 20)
    assert int(touch(19, last.progress).gained) == 0


def eaten(name: str, *, tilt: float, away: float = 0.0, turn: float = 35.0, left: int = 8):
    """One step with the tool at (or away from) the mouth."""
    own = style(name)
    mouth = np.asarray(poses(turn=turn).mouth)
    now = poses(turn=turn, tilt=tilt, tool=mouth - np.array([0.0, away, 0.0]))
    progress = tasks.first_progress(own).replace(left=jnp.asarray(left, jnp.int32))
    found = tasks.find_target(now, own, aim(), progress)
    return tasks.advance(own, now, pressing(), found, progress)


def test_a_level_spoon_at_the_mouth_gives_a_portion():
    outcome = eaten("feed_left", tilt=10.0)
    assert (int(outcome.gained), int(outcome.spilt), int(outcome.progress.left)) == (1, 0, 7)
    assert float(tasks.bonus(style("feed_left"), outcome)) == 20.0


def test_a_tilted_spoon_spills_wherever_it_is():
    for away in (0.0, 0.3):
        outcome = eaten("feed_left", tilt=31.0, away=away)
        assert (int(outcome.gained), int(outcome.spilt), int(outcome.progress.left)) == (0, 1, 7)
        assert float(tasks.bonus(style("feed_left"), outcome)) == -5.0


@pytest.mark.parametrize(
    "case",
    [{"tilt": 0.0, "away": 0.031}, {"tilt": 0.0, "turn": 0.0}, {"tilt": 0.0, "left": 0}],
)
def test_no_portion(case):
    outcome = eaten("feed_left", **case)
    assert int(outcome.gained) == 0
    assert int(outcome.spilt) == 0


@pytest.mark.parametrize(("tilt", "units"), [(30.0, 0), (50.0, 1), (95.0, 1), (105.0, 0)])
def test_a_cup_is_drunk_from_when_it_is_tilted(tilt, units):
    outcome = eaten("drink_left", tilt=tilt, left=64)
    assert (int(outcome.gained), int(outcome.progress.left)) == (units, 64 - units)
    assert float(tasks.bonus(style("drink_left"), outcome)) == 10.0 * units


def test_each_term_of_the_reward_on_hand_worked_numbers():
    own, progress = style("feed_left"), tasks.first_progress(style("feed_left"))
    mouth = np.asarray(poses(turn=35.0).mouth)
    now = poses(turn=35.0, tool=mouth - np.array([0.0, 0.2, 0.0]))
    found = tasks.find_target(now, own, aim(), progress)
    outcome = tasks.advance(own, now, pressing(), found, progress)

    def terms(body, at=now):
        target = tasks.find_target(at, own, aim(), progress)
        return reward.reward_terms(
            weights=reward.RewardWeights(),
            style=own,
            body=body,
            poses=at,
            target=target,
            outcome=outcome,
            actions=jnp.array([3.0, 4.0] + [0.0] * 11),
            tool_speed=jnp.asarray(0.5),
        )

    plain = terms(pressing())
    assert float(plain["distance"]) == pytest.approx(-0.2, abs=1e-6)
    assert float(plain["action"]) == pytest.approx(-0.05)
    assert float(plain["velocity"]) == pytest.approx(-0.125)
    assert float(plain["task"]) == 0.0
    assert float(plain["force_elsewhere"]) == float(plain["high_force"]) == 0.0
    # The tool presses the head far from the mouth, the hand the forearm: 4 + 2 N elsewhere.
    assert float(terms(pressing(head=4.0, hand=2.0))["force_elsewhere"]) == pytest.approx(-0.06)
    near = poses(turn=35.0, tool=mouth - np.array([0.0, 0.02, 0.0]))
    pressed = terms(pressing(head=12.0, hand=2.0), at=near)
    assert float(pressed["high_force"]) == pytest.approx(-0.6)
    assert float(pressed["force_elsewhere"]) == pytest.approx(-0.02)


@pytest.mark.parametrize(
    ("done", "gained", "happens"), [(5, 1, 0), (6, 1, 1), (6, 0, 0), (7, 1, 0)]
)
def test_success_happens_once_with_the_point_that_makes_it(done, gained, happens):
    progress = tasks.first_progress(style("bathe_up")).replace(done=jnp.array(done))
    outcome = tasks.Outcome(progress, jnp.array(gained), jnp.zeros((), jnp.int32))
    at = poses()
    target = tasks.find_target(at, style("bathe_up"), aim(), progress)
    counts = events.count_events(style("bathe_up"), pressing(), at, target, outcome)
    np.testing.assert_array_equal(counts[:, events.NAMES.index(events.SUCCESS)], [happens] * 2)


def happened(name: str, at: Poses, body: Physics) -> list[set[str]]:
    """Names of the ego's and the partner's events in a step in which nothing was done."""
    own, progress = style(name), tasks.first_progress(style(name))
    target = tasks.find_target(at, own, aim(0.5, 116.0), progress)
    outcome = tasks.Outcome(progress, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
    counts = np.asarray(events.count_events(own, body, at, target, outcome))
    assert set(np.unique(counts)) <= {0.0, 1.0}
    return [{events.NAMES[i] for i in np.flatnonzero(agent)} for agent in counts]


def test_events_say_what_robot_and_person_do():
    assert happened("scratch_upper_arm", poses(tool=(1, 1, 1)), pressing()) == [set(), set()]
    lifted = poses(lift=45.0)
    middle = (np.asarray(lifted.elbow) + np.asarray(lifted.wrist)) / 2
    pressed = happened(
        "scratch_upper_arm", poses(lift=45.0, tool=middle, tilt=40.0), pressing(forearm=2.0)
    )
    assert pressed == [
        {"tool_near@forearm", "touch@forearm", "tool_tilted"},
        {"arm_lifted", "target_presented"},
    ]
    upper = (np.asarray(lifted.shoulder) + np.asarray(lifted.elbow)) / 2
    aside = upper + np.array([0.0, -0.09, 0.0])
    assert happened("bathe_up", poses(lift=45.0, tool=aside), pressing(upper_arm=1.0))[0] == {
        "tool_near@upper_arm",
        "touch@upper_arm",
    }
    mouth = np.asarray(poses(turn=-35.0).mouth) - np.array([0.0, 0.09, 0.0])
    fed = happened("feed_right", poses(turn=-35.0, tool=mouth), pressing(head=1.0))
    assert fed == [{"tool_near@mouth", "touch@head"}, {"head_right", "target_presented"}]
    assert happened("feed_right", poses(turn=35.0, tool=(1, 1, 1)), pressing()) == [
        set(),
        {"head_left"},
    ]


@pytest.mark.parametrize(
    ("name", "gained", "spilt", "event"),
    [
        ("scratch_forearm", 1, 0, "stroke"),
        ("bathe_down", 1, 0, "wipe"),
        ("feed_left", 1, 0, "portion_eaten"),
        ("feed_left", 0, 1, "portion_spilt"),
        ("drink_right", 1, 0, "unit_drunk"),
    ],
)
def test_what_is_done_is_an_event_of_both(name, gained, spilt, event):
    own, at = style(name), poses(tool=(1, 1, 1))
    progress = tasks.first_progress(own)
    outcome = tasks.Outcome(progress, jnp.array(gained), jnp.array(spilt))
    target = tasks.find_target(at, own, aim(), progress)
    counts = events.count_events(own, pressing(), at, target, outcome)
    assert [[events.NAMES[i] for i in np.flatnonzero(row)] for row in counts] == [[event]] * 2


@pytest.mark.parametrize(
    ("name", "away", "tilt", "error"),
    [
        ("feed_left", 0.5, 20.0, 0.0),
        ("feed_left", 0.5, 50.0, 20.0),
        ("drink_left", 0.5, 0.0, 0.0),
        ("drink_left", 0.05, 30.0, 15.0),
        ("drink_left", 0.05, 110.0, 10.0),
        ("drink_left", 0.05, 60.0, 0.0),
        ("scratch_forearm", 0.0, 90.0, 0.0),
    ],
)
def test_the_tilt_that_a_task_needs(name, away, tilt, error):
    own = style(name)
    mouth = np.asarray(poses(turn=35.0).mouth)
    at = poses(turn=35.0, tilt=tilt, tool=mouth - np.array([0.0, away, 0.0]))
    target = tasks.find_target(at, own, aim(), tasks.first_progress(own))
    assert np.degrees(tasks.tilt_error(own, at, target)) == pytest.approx(error, abs=1e-3)


def test_styles_of_some_tasks():
    assert styles.style_names(("feed",)) == ("feed_left", "feed_right")
    some = styles.all_styles(("feed", "drink"))
    # The one-hot is that of all eight styles, so that policies of other subsets fit.
    np.testing.assert_array_equal(some.one_hot.argmax(axis=1), [4, 5, 6, 7])


@pytest.mark.parametrize("name", styles.style_names())
def test_every_style_can_present_and_starts_within_its_ranges(name):
    from envs.assistive import model

    low, high = np.asarray(style(name).ranges).T
    assert (low <= model.HOME).all()
    assert (high >= model.HOME).all()
    turn = float(style(name).head_turn)
    head_z = model.JOINTS.index("head_z")
    assert low[head_z] <= turn <= high[head_z]
