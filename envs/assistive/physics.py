"""One control step of arm and person in MJX, and where their parts are then.

Programs that contain these functions must be compiled without XLA's fusion emitters when they
run on a CPU, where a serial chain of joints otherwise takes a thousand times longer:
`Assistive.compiler_options` holds the setting.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.assistive import model
from envs.assistive.model import mjx

CONTACTS = (
    ("tool", "upper_arm"),
    ("tool", "forearm"),
    ("tool", "head"),
    ("hand", "forearm"),
)
"""Pairs of geoms that can touch, in the order of forces."""


class Physics(PyTreeNode):
    """What the physics carries from step to step.

    Attributes:
        seat: how far the person's seat is from its usual place, m [3].
        angles: of all joints, rad [joint].
        speeds: of all joints, rad/s [joint].
        warmstart: accelerations from which the solver starts, rad/s² [joint].
        forces: with which the `CONTACTS` pressed at the step's end, N [contact].
    """

    seat: jax.Array
    angles: jax.Array
    speeds: jax.Array
    warmstart: jax.Array
    forces: jax.Array


class Poses(PyTreeNode):
    """Where things are in the world: positions in metres [3], rotation matrices [3, 3].

    A limb's z axis points from its lower to its upper end; the head looks along its -y axis; the
    tool's x axis points to its tip, its z axis up when it is held level.
    """

    tool: jax.Array
    tool_rotation: jax.Array
    shoulder: jax.Array
    elbow: jax.Array
    wrist: jax.Array
    upper_arm_rotation: jax.Array
    forearm_rotation: jax.Array
    head: jax.Array
    head_rotation: jax.Array
    mouth: jax.Array


def at_rest(angles: jax.Array, seat: jax.Array) -> Physics:
    """The physics of bodies that stand still, at joint angles [joint], the seat moved by m [3]."""
    still = jnp.zeros_like(angles)
    return Physics(seat, angles, still, still, jnp.zeros(len(CONTACTS)))


def step(physics: Physics, velocities: jax.Array) -> Physics:
    """Advances by one control step.

    Args:
        physics: before.
        velocities: that the joints' servos are to keep, rad/s [joint].
    """
    mjx_model = model.mjx_model_with(physics.seat)
    data = model.blank_data().replace(
        qpos=physics.angles,
        qvel=physics.speeds,
        qacc_warmstart=physics.warmstart,
        ctrl=velocities,
    )

    def substep(data: Any, _: None) -> tuple[Any, None]:
        return mjx.step(mjx_model, data), None

    data = jax.lax.scan(substep, data, None, length=model.substeps())[0]
    return Physics(physics.seat, data.qpos, data.qvel, data.qacc_warmstart, _forces(data))


def poses(physics: Physics) -> Poses:
    """Where everything is, by forward kinematics."""
    mjx_model = model.mjx_model_with(physics.seat)
    data = mjx.kinematics(mjx_model, model.blank_data().replace(qpos=physics.angles))
    return read_poses(data)


def read_poses(data: Any) -> Poses:
    """Where everything is, from MJX's or C MuJoCo's data after its kinematics."""

    def site(name: str) -> Any:
        return data.site_xpos[model.site(name)]

    def place(name: str) -> Any:
        return data.xpos[model.body(name)]

    def rotation(name: str) -> Any:
        return data.xmat[model.body(name)].reshape(3, 3)

    return Poses(
        tool=site("tool_tip"),
        tool_rotation=rotation("tool"),
        shoulder=place("upper_arm"),
        elbow=place("forearm"),
        wrist=site("wrist"),
        upper_arm_rotation=rotation("upper_arm"),
        forearm_rotation=rotation("forearm"),
        head=place("head"),
        head_rotation=rotation("head"),
        mouth=site("mouth"),
    )


def force_on(physics: Physics, *parts: str, by: tuple[str, ...] = ("tool",)) -> jax.Array:
    """With how much force some parts of the person are pressed, N [].

    Args:
        physics: after the step.
        parts: geoms of the person; all by default.
        by: geoms of the robot that count.
    """
    rows = [
        number
        for number, (robot, person) in enumerate(CONTACTS)
        if robot in by and (person in parts or not parts)
    ]
    return jnp.sum(physics.forces[np.array(rows)])


def _forces(data: Any) -> jax.Array:
    """Normal force of each of the `CONTACTS`, N [contact]; frictionless, so one row each."""
    contact: Any = data._impl.contact
    rows: Any = data._impl.efc_force
    found = []
    for pair in CONTACTS:
        numbers = np.array(sorted(map(model.geom, pair)))
        this = jnp.all(jnp.sort(contact.geom, axis=1) == numbers, axis=1)
        found.append(jnp.sum(rows[contact.efc_address], where=this))
    return jnp.stack(found)
