"""From actions to the velocities that the joints' servos keep."""

import jax
import jax.numpy as jnp

from envs.assistive import model
from envs.assistive.physics import Physics

FULL_SPEED = 0.63
"""Joint speed of an action of 1, rad/s (36 degrees a second)."""


def velocities(physics: Physics, actions: jax.Array, ranges: jax.Array) -> jax.Array:
    """Returns the speed that each joint's servo is to keep, rad/s [joint].

    A joint is slowed down so that it would not leave its range within the step, and brought back
    if it has; joint limits in the solver would cost more than all the contacts. And no servo is
    asked for more than its motor's torque: MJX and C MuJoCo treat clipped motors differently.

    Args:
        physics: before the step.
        actions: -1 to 1 [joint]; what lies outside is clipped.
        ranges: lower and upper limit of each joint, rad [joint, 2].
    """
    wanted = FULL_SPEED * jnp.clip(actions, -1.0, 1.0)
    lowest, highest = (ranges.T - physics.angles) / model.CONTROL_SECONDS
    kept = jnp.clip(wanted, lowest, highest)
    # A joint far outside, as when its range has just changed, comes back at full speed at most.
    kept = jnp.clip(kept, -FULL_SPEED, FULL_SPEED)
    most = model.largest_speed_errors()
    return jnp.clip(kept, physics.speeds - most, physics.speeds + most)


def speeds_back_home(physics: Physics) -> jax.Array:
    """Returns the actions by which joints come back to where games start, -1 to 1 [joint].

    Without gravity a servo that only keeps a speed of zero lets itself be pushed anywhere.
    """
    away = jnp.asarray(model.HOME) - physics.angles
    return jnp.clip(away / (model.CONTROL_SECONDS * FULL_SPEED), -1.0, 1.0)
