"""The four tasks: what the tool must do where, and when the person presents it.

Neither player succeeds alone: nothing counts unless the person presents the target, its arm
lifted and an itch turned to the robot, or its head turned as its style wants it; and only the
robot has the tool.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.assistive import physics
from envs.assistive.physics import Physics, Poses
from envs.assistive.styles import TASKS, Style

UPPER_ARM, FOREARM = 0.279, 0.257
"""Lengths of the person's limbs, m."""
UPPER_ARM_RADIUS, FOREARM_RADIUS = 0.043, 0.033
ROBOT = np.array([-0.35, -0.3, 0.6355])
"""The robot's shoulder: to where the person turns an itch, and from where it is bathed, m."""

LIFTED = math.radians(30.0)
"""How far an arm is lifted, at least, when it is presented, rad."""
FACING, HEAD_TOLERANCE = math.radians(20.0), math.radians(10.0)
"""How far, around a limb, a presented itch is from the side that the robot is on, and a presented
mouth from where its style turns it, rad."""

AT_SKIN, AT_MOUTH = 0.025, 0.03
"""How near the tool's tip must be to a place on the skin, and to the mouth, m."""
NEAR = 0.1
"""How near the tip is to the target where its force counts as force at the target, m."""
STROKE, GENTLE = 0.01, 10.0
"""Least way of the tip between two strokes, m, and the force that scratching stays below, N."""
SPILL = math.radians(30.0)
POUR = (math.radians(45.0), math.radians(100.0))

STEPS_OF_BATHING = 20
"""Points along the arm."""
PORTIONS, UNITS = 8, 64
"""What the tool holds of food and of drink at the start."""
ITCHES = (0.45, 0.55), (math.radians(45.0), math.radians(135.0))
"""Where along a limb an itch may be, 0 upper end to 1 lower end, and around it, where the person
can turn all of it to the robot; 0 is the person's right, 90 degrees the front (rad)."""

BONUS = {"scratch": 5.0, "bathe": 5.0, "feed": 20.0, "drink": 10.0}
"""Pay for a stroke, a new point, a portion, a unit."""
SPILT = -5.0
SUCCESS = {"scratch": 25, "bathe": 6, "feed": 6, "drink": 48}
"""How many of them are a success."""


class Aim(PyTreeNode):
    """What is drawn at a game's start; its distribution is the same for all styles.

    Attributes:
        along: where along the limb the itch is, 0 upper end to 1 lower end, float32 [].
        around: where around the limb the itch is, rad [].
    """

    along: jax.Array
    around: jax.Array


class Progress(PyTreeNode):
    """How far the task is.

    Attributes:
        done: strokes, points, portions or units so far, int32 [].
        reached: the point of the arm from which on it is to be bathed; those that were passed by
            are lost, int32 [].
        left: what the tool still holds, int32 [].
        stroke: where the last stroke ended, in the limb's frame, m [3].
    """

    done: jax.Array
    reached: jax.Array
    left: jax.Array
    stroke: jax.Array


class Target(PyTreeNode):
    """Where the tool is wanted.

    Attributes:
        place: m [3].
        presented: whether the person presents it, bool [].
        effort: how far the person is from presenting it, 0 when it does, about rad [].
        tip: the tool's tip in the frame of the limb that has the target, m [3].
        point: the first point to bathe that the tip is at, `STEPS_OF_BATHING` where it is at none,
            int32 [].
    """

    place: jax.Array
    presented: jax.Array
    effort: jax.Array
    tip: jax.Array
    point: jax.Array


class Outcome(PyTreeNode):
    """What a step did for the task.

    Attributes:
        progress: after the step.
        gained: strokes, points, portions or units of this step, 0 or 1, int32 [].
        spilt: portions lost in this step, 0 or 1, int32 [].
    """

    progress: Progress
    gained: jax.Array
    spilt: jax.Array


def draw_aim(key: jax.Array) -> Aim:
    """Draws the aim of a game; consumes `key`."""
    along_key, around_key = jax.random.split(key)
    return Aim(
        along=jax.random.uniform(along_key, minval=ITCHES[0][0], maxval=ITCHES[0][1]),
        around=jax.random.uniform(around_key, minval=ITCHES[1][0], maxval=ITCHES[1][1]),
    )


def first_progress(style: Style) -> Progress:
    """Nothing is done and the tool is full; the first stroke may be anywhere."""
    holds = jnp.array([0, 0, PORTIONS, UNITS], jnp.int32)
    nothing = jnp.zeros((), jnp.int32)
    return Progress(nothing, nothing, holds[style.task], jnp.full(3, 10.0, jnp.float32))


def find_target(poses: Poses, style: Style, aim: Aim, progress: Progress) -> Target:
    """Where the tool is wanted now, and whether the person presents it."""
    mouth, bathing = at_mouth(style), is_bathing(style)
    points = jnp.arange(STEPS_OF_BATHING)
    in_turn = jnp.where(style.downwards, points, STEPS_OF_BATHING - 1 - points)
    ways = (in_turn + 0.5) / STEPS_OF_BATHING * (UPPER_ARM + FOREARM)
    line = jax.vmap(lambda way: _on_arm(poses, way).place)(ways)
    at = (jnp.linalg.norm(poses.tool - line, axis=1) < AT_SKIN) & (points >= progress.reached)
    bathed = _on_arm(poses, ways[jnp.minimum(progress.reached, STEPS_OF_BATHING - 1)])
    down = aim.along * jnp.where(style.forearm, FOREARM, UPPER_ARM)
    itching = _on_skin(poses, style.forearm, down, aim.around)
    both = zip(bathed, itching, strict=True)
    skin = _Skin(*(jnp.where(bathing, one, other) for one, other in both))

    lift = jnp.arccos(jnp.clip(poses.upper_arm_rotation[2, 2], -0.9999, 0.9999))
    arm_effort = jnp.maximum(LIFTED - lift, 0.0) + jnp.maximum(skin.turned_away - FACING, 0.0)
    turn = head_turn(poses)
    head_effort = jnp.maximum(jnp.abs(turn - style.head_turn) - HEAD_TOLERANCE, 0.0)
    effort = jnp.where(mouth, head_effort, arm_effort)
    return Target(
        place=jnp.where(mouth, poses.mouth, skin.place),
        presented=effort <= 0.0,
        effort=effort,
        tip=skin.rotation.T @ (poses.tool - skin.origin),
        point=jnp.where(at.any(), jnp.argmax(at), STEPS_OF_BATHING),
    )


class _Skin(NamedTuple):
    """A place on the skin of the arm.

    Attributes:
        place: m [3].
        origin: upper end of its limb, m [3].
        rotation: of its limb [3, 3].
        turned_away: how far around the limb it is from the robot's side, rad [].
    """

    place: jax.Array
    origin: jax.Array
    rotation: jax.Array
    turned_away: jax.Array


def _on_arm(poses: Poses, way: jax.Array) -> _Skin:
    """The place on the robot's side of the arm, `way` m from the shoulder."""
    on_forearm = way > UPPER_ARM
    return _on_skin(poses, on_forearm, jnp.where(on_forearm, way - UPPER_ARM, way), None)


def _on_skin(
    poses: Poses, on_forearm: jax.Array, down: jax.Array, around: jax.Array | None
) -> _Skin:
    """A place on the skin.

    Args:
        poses: of the person.
        on_forearm: whether it is on the forearm, not the upper arm, bool [].
        down: how far from the limb's upper end it is, m [].
        around: where around the limb it is, rad []; None for the robot's side.
    """
    origin = jnp.where(on_forearm, poses.elbow, poses.shoulder)
    rotation = jnp.where(on_forearm, poses.forearm_rotation, poses.upper_arm_rotation)
    middle = origin - down * rotation[:, 2]
    # In a limb's frame -x is the person's right and -y its front; the limb hangs along -z.
    to_robot = rotation.T @ (ROBOT - middle)
    robot_side = jnp.arctan2(-to_robot[1], -to_robot[0])
    around = robot_side if around is None else around
    apart = jnp.abs(robot_side - around)
    normal = jnp.stack([-jnp.cos(around), -jnp.sin(around), jnp.zeros(())])
    radius = jnp.where(on_forearm, FOREARM_RADIUS, UPPER_ARM_RADIUS)
    return _Skin(
        place=middle + radius * rotation @ normal,
        origin=origin,
        rotation=rotation,
        turned_away=jnp.minimum(apart, 2 * jnp.pi - apart),
    )


def advance(
    style: Style, poses: Poses, body: Physics, target: Target, progress: Progress
) -> Outcome:
    """Counts what the tool has done in a step; all tasks in one program, told apart by `style`."""
    distance = jnp.linalg.norm(poses.tool - target.place)
    force = physics.force_on(body, "upper_arm", "forearm")
    touching = force > 0.0
    at_skin, at_lips = distance < AT_SKIN, distance < AT_MOUTH
    moved = jnp.linalg.norm(target.tip - progress.stroke) > STROKE
    stroke = touching & at_skin & (force < GENTLE) & moved
    point = touching & (target.point < STEPS_OF_BATHING)
    held = progress.left > 0
    tilted = tilt(poses)
    spilt = _is(style, "feed") & held & (tilted > SPILL)
    portion = at_lips & held & ~spilt
    unit = at_lips & held & (tilted > POUR[0]) & (tilted < POUR[1])
    gained = jnp.stack([stroke, point, portion, unit])[style.task] & target.presented
    used = spilt | (gained & at_mouth(style))
    after = Progress(
        done=progress.done + gained,
        reached=jnp.where(gained & is_bathing(style), target.point + 1, progress.reached),
        left=progress.left - used,
        stroke=jnp.where(gained, target.tip, progress.stroke),
    )
    return Outcome(after, gained.astype(jnp.int32), spilt.astype(jnp.int32))


def tilt(poses: Poses) -> jax.Array:
    """Angle between the tool's upward axis and the vertical, rad []."""
    return jnp.arccos(jnp.clip(poses.tool_rotation[2, 2], -0.9999, 0.9999))


def tilt_error(style: Style, poses: Poses, target: Target) -> jax.Array:
    """How far the tool's tilt is from what its task needs where it is, rad [].

    Food must be carried level; drink must be poured at the mouth.
    """
    tilted = tilt(poses)
    spills = jnp.maximum(tilted - SPILL, 0.0)
    pours = jnp.maximum(POUR[0] - tilted, 0.0) + jnp.maximum(tilted - POUR[1], 0.0)
    near = jnp.linalg.norm(poses.tool - target.place) < NEAR
    pours = jnp.where(near, pours, 0.0)
    return jnp.where(_is(style, "feed"), spills, jnp.where(_is(style, "drink"), pours, 0.0))


def head_turn(poses: Poses) -> jax.Array:
    """How far the head is turned to the person's left, rad []."""
    looks = -poses.head_rotation[:, 1]
    return jnp.arctan2(looks[0], -looks[1])


def bonus(style: Style, outcome: Outcome) -> jax.Array:
    """What the step's success pays, with what was spilt, float32 []."""
    pays = jnp.array([BONUS[task] for task in TASKS])
    return pays[style.task] * outcome.gained + SPILT * outcome.spilt


def at_mouth(style: Style) -> jax.Array:
    """Whether the task is done at the mouth, not on the arm, bool []."""
    return _is(style, "feed") | _is(style, "drink")


def is_bathing(style: Style) -> jax.Array:
    """Whether the arm is bathed, bool []."""
    return _is(style, "bathe")


def success_counts() -> jax.Array:
    """How many strokes, points, portions or units are a success, int32 [task]."""
    return jnp.array([SUCCESS[task] for task in TASKS], jnp.int32)


def _is(style: Style, task: str) -> jax.Array:
    return style.task == TASKS.index(task)
