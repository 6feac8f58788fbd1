"""What happened in a step: what was done for the task, where the tool was, what was shown."""

import jax
import jax.numpy as jnp

from envs.assistive import physics, tasks
from envs.assistive.physics import Physics, Poses
from envs.assistive.styles import TASKS, Style
from envs.assistive.tasks import Outcome, Target

PARTS = ("upper_arm", "forearm", "head")
GAINS = dict(zip(TASKS, ("stroke", "wipe", "portion_eaten", "unit_drunk"), strict=True))
"""What is counted in each task."""
SUCCESS = "success"
"""Happens once, when enough has been done for a success."""
NAMES = (
    *GAINS.values(),
    "portion_spilt",
    SUCCESS,
    *(f"tool_near@{part}" for part in ("upper_arm", "forearm", "mouth")),
    *(f"touch@{part}" for part in PARTS),
    "tool_tilted",
    "arm_lifted",
    "head_left",
    "head_right",
    "target_presented",
)
_NEAR = 0.1
_TURNED = 0.3
"""Where a head counts as turned, rad."""


def count_events(
    style: Style, body: Physics, poses: Poses, target: Target, outcome: Outcome
) -> jax.Array:
    """Returns how often each event of `NAMES` happened in this step, float32 [agent, event].

    What is done for the task is done by both; tool and touch are the robot's, the rest the
    person's.
    """
    gained = (jnp.arange(len(TASKS)) == style.task) * outcome.gained
    enough = outcome.progress.done == tasks.success_counts()[style.task]
    success = outcome.gained * enough
    away = jnp.stack(
        [
            _from_segment(poses.tool, poses.shoulder, poses.elbow),
            _from_segment(poses.tool, poses.elbow, poses.wrist),
            jnp.linalg.norm(poses.tool - poses.mouth),
        ]
    )
    touch = jnp.stack([physics.force_on(body, part) for part in PARTS]) > 0
    lift = jnp.arccos(jnp.clip(poses.upper_arm_rotation[2, 2], -0.9999, 0.9999))
    turn = tasks.head_turn(poses)
    both = jnp.concatenate([gained, outcome.spilt[None], success[None]])
    robot = jnp.concatenate([away < _NEAR, touch, (tasks.tilt(poses) > tasks.SPILL)[None]])
    person = jnp.stack([lift > tasks.LIFTED, turn > _TURNED, turn < -_TURNED, target.presented])
    ego = jnp.concatenate([both, robot, jnp.zeros(len(person))])
    partner = jnp.concatenate([both, jnp.zeros(len(robot)), person])
    return jnp.stack([ego, partner]).astype(jnp.float32)


def _from_segment(point: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Distance of a point from a line between two others, m []."""
    along = jnp.dot(point - start, end - start) / jnp.dot(end - start, end - start)
    return jnp.linalg.norm(point - start - jnp.clip(along, 0.0, 1.0) * (end - start))
