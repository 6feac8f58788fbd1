"""Reward by named terms, with the weights of Assistive Gym (Erickson et al., 2020)."""

import dataclasses

import jax
import jax.numpy as jnp

from envs.assistive import physics, tasks
from envs.assistive.physics import Physics, Poses
from envs.assistive.styles import Style
from envs.assistive.tasks import Outcome, Target


@dataclasses.dataclass(frozen=True)
class RewardWeights:
    """Weights of the reward's terms.

    Attributes:
        distance: per metre between the tool's tip and the target.
        action: per norm of both players' actions.
        task: of the task's bonus.
        velocity: per m/s of the tool's tip; the person's preference, as the two below.
        force_elsewhere: per newton on the person that is not at the target.
        high_force: per newton at the target, where it is 10 or more.
    """

    distance: float = 1.0
    action: float = 0.01
    task: float = 1.0
    velocity: float = 0.25
    force_elsewhere: float = 0.01
    high_force: float = 0.05


@dataclasses.dataclass(frozen=True)
class ShapingWeights:
    """Weights of the shaped reward: a learning aid, never a score.

    Attributes:
        present: what the person earns for each radian by which it comes nearer to presenting.
        hold: what the person loses in a step for each radian that it is from presenting.
        level: what the robot loses in a step for each radian by which the tool tilts more than
            its task allows, or less than pouring needs at the mouth.
    """

    present: float = 1.7
    hold: float = 0.1
    level: float = 0.033


def target_force(style: Style, body: Physics, target: Target, poses: Poses) -> jax.Array:
    """Force of the tool at the target, N []: what presses near it counts."""
    near = jnp.linalg.norm(poses.tool - target.place) < tasks.NEAR
    arm = physics.force_on(body, "upper_arm", "forearm")
    head = physics.force_on(body, "head")
    return jnp.where(near, jnp.where(tasks.at_mouth(style), head, arm), 0.0)


def reward_terms(
    *,
    weights: RewardWeights,
    style: Style,
    body: Physics,
    poses: Poses,
    target: Target,
    outcome: Outcome,
    actions: jax.Array,
    tool_speed: jax.Array,
) -> dict[str, jax.Array]:
    """Returns the team reward by named term, each float32 [].

    Args:
        weights: of the terms.
        style: of the partner.
        body: after the step.
        poses: after the step.
        target: after the step.
        outcome: what the step did for the task.
        actions: of both players, -1 to 1 [joint].
        tool_speed: of the tool's tip, m/s [].
    """
    at_target = target_force(style, body, target, poses)
    everywhere = physics.force_on(body, by=("tool", "hand"))
    return {
        "distance": -weights.distance * jnp.linalg.norm(poses.tool - target.place),
        "action": -weights.action * jnp.linalg.norm(actions),
        "task": weights.task * tasks.bonus(style, outcome),
        "velocity": -weights.velocity * tool_speed,
        "force_elsewhere": -weights.force_elsewhere * (everywhere - at_target),
        "high_force": -weights.high_force * jnp.where(at_target < tasks.GENTLE, 0.0, at_target),
    }
