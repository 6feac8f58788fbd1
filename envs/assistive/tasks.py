"""The four tasks: what the tool must do where, and when the person presents it.

Neither player succeeds alone: nothing counts unless the person presents the target, its arm
lifted and the place turned to the robot, or its head turned as its style wants it; and only the
robot has the tool.
"""

import math

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
"""The robot's shoulder: where the person turns a place to be seen, m."""

LIFTED = math.radians(30.0)
FACING = math.cos(math.radians(60.0))
HEAD_TOLERANCE = math.radians(10.0)

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
ITCHES = (math.radians(30.0), math.radians(150.0))
"""Where around a limb an itch may be, all of which the person can turn to the robot; 0 is the
person's right, 90 degrees the front (rad)."""

BONUS = {"scratch": 5.0, "bathe": 5.0, "feed": 20.0, "drink": 10.0}
"""Pay for a stroke, a new point, a portion, a unit."""
SPILT = -5.0
SUCCESS = {"scratch": 25, "bathe": 6, "feed": 6, "drink": 48}
"""How many of them are a success."""


class Aim(PyTreeNode):
    """What is drawn at a game's start; its distribution is the same for all styles.

    Attributes:
        along: where along the limb the itch is, 0 upper end to 1 lower end, float32 [].
        around: where around the limb the itch, or the line to bathe, is, rad [].
    """

    along: jax.Array
    around: jax.Array


class Progress(PyTreeNode):
    """How far the task is.

    Attributes:
        done: strokes, points, portions or units so far, int32 [].
        left: what the tool still holds, int32 [].
        stroke: where the last stroke ended, in the limb's frame, m [3].
    """

    done: jax.Array
    left: jax.Array
    stroke: jax.Array


class Target(PyTreeNode):
    """Where the tool is wanted.

    Attributes:
        place: m [3].
        presented: whether the person presents it, bool [].
        effort: how far the person is from presenting it, 0 when it does, about rad [].
        tip: the tool's tip in the frame of the limb that has the target, m [3].
    """

    place: jax.Array
    presented: jax.Array
    effort: jax.Array
    tip: jax.Array


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
        along=jax.random.uniform(along_key, minval=0.15, maxval=0.85),
        around=jax.random.uniform(around_key, minval=ITCHES[0], maxval=ITCHES[1]),
    )


def first_progress(style: Style) -> Progress:
    """Nothing is done and the tool is full; the first stroke may be anywhere."""
    holds = jnp.array([0, 0, PORTIONS, UNITS], jnp.int32)
    return Progress(jnp.zeros((), jnp.int32), holds[style.task], jnp.full(3, 10.0))


def find_target(poses: Poses, style: Style, aim: Aim, progress: Progress) -> Target:
    """Where the tool is wanted now, and whether the person presents it."""
    mouth = at_mouth(style)
    point = jnp.minimum(progress.done, STEPS_OF_BATHING - 1)
    way = (jnp.where(style.downwards, point, STEPS_OF_BATHING - 1 - point) + 0.5) / STEPS_OF_BATHING
    way = way * (UPPER_ARM + FOREARM)
    bathing = is_bathing(style)
    on_forearm = jnp.where(bathing, way > UPPER_ARM, style.forearm)
    bathed = jnp.where(on_forearm, way - UPPER_ARM, way)
    itching = aim.along * jnp.where(on_forearm, FOREARM, UPPER_ARM)
    down = jnp.where(bathing, bathed, itching)
    radius = jnp.where(on_forearm, FOREARM_RADIUS, UPPER_ARM_RADIUS)
    # In a limb's frame -x is the person's right and -y its front; the limb hangs along -z.
    normal = jnp.stack([-jnp.cos(aim.around), -jnp.sin(aim.around), jnp.zeros(())])
    origin = jnp.where(on_forearm, poses.elbow, poses.shoulder)
    rotation = jnp.where(on_forearm, poses.forearm_rotation, poses.upper_arm_rotation)
    place = origin + rotation @ (radius * normal - down * jnp.array([0.0, 0.0, 1.0]))

    to_robot = ROBOT - place
    facing = jnp.dot(rotation @ normal, to_robot) / jnp.linalg.norm(to_robot)
    lift = jnp.arccos(jnp.clip(poses.upper_arm_rotation[2, 2], -0.9999, 0.9999))
    arm_effort = jnp.maximum(LIFTED - lift, 0.0) + jnp.maximum(FACING - facing, 0.0)
    turn = head_turn(poses)
    head_effort = jnp.maximum(jnp.abs(turn - style.head_turn) - HEAD_TOLERANCE, 0.0)
    effort = jnp.where(mouth, head_effort, arm_effort)
    return Target(
        place=jnp.where(mouth, poses.mouth, place),
        presented=effort <= 0.0,
        effort=effort,
        tip=rotation.T @ (poses.tool - origin),
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
    point = touching & at_skin & (progress.done < STEPS_OF_BATHING)
    held = progress.left > 0
    tilted = tilt(poses)
    spilt = _is(style, "feed") & held & (tilted > SPILL)
    portion = at_lips & held & ~spilt
    unit = at_lips & held & (tilted > POUR[0]) & (tilted < POUR[1])
    gained = jnp.stack([stroke, point, portion, unit])[style.task] & target.presented
    used = spilt | (gained & at_mouth(style))
    after = Progress(
        done=progress.done + gained,
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
