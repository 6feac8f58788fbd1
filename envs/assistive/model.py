"""The model of arm and person, and where things are in it."""

# MuJoCo's compiled classes have no types for a checker.
# pyright: reportAttributeAccessIssue=false

import copy
import functools
from importlib import resources

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.quiet import no_word_of_warp

with no_word_of_warp():
    from mujoco import mjx

ARM = tuple(f"arm_{number}" for number in range(1, 8))
"""Joints of the robot, from the base."""
PERSON = ("shoulder_y", "shoulder_x", "shoulder_z", "elbow", "head_x", "head_z")
"""Joints of the person: lift, swing and turn of the upper arm, elbow, nod and turn of the head."""
JOINTS = (*ARM, *PERSON)
"""All joints in the model's order."""
SEATED = ("torso", "shoulder_lift", "head_pitch")
"""The bodies that the person's seat carries."""
HOME = np.radians([211.4, 253.2, 216.7, 93.0, 166.2, 97.6, 38.0, 15.0, 0.0, 0.0, -15.0, 0.0, 0.0])
"""Angles from which games start: a level tool in front of the person's right shoulder (rad)."""
CONTROL_SECONDS = 0.1
"""Time of one step of a game."""


@functools.cache
def mujoco_model() -> mujoco.MjModel:
    """The model for C MuJoCo; the same object every time, not to be changed."""
    text = resources.files("envs.assistive").joinpath("jaco.xml").read_text(encoding="utf-8")
    return mujoco.MjModel.from_xml_string(text)


def posed(angles: np.ndarray, seat: np.ndarray) -> mujoco.MjData:
    """C MuJoCo's data of arm and person at joint angles [joint], the seat moved by m [3]."""
    known = copy.copy(mujoco_model())
    for name in SEATED:
        known.body(name).pos += seat
    data = mujoco.MjData(known)
    data.qpos[:] = angles
    mujoco.mj_forward(known, data)
    return data


def mjx_model_with(seat: jax.Array) -> mjx.Model:
    """The model for MJX with the person's seat moved by m [3]."""
    known = mjx_model()
    seated = np.array([body(name) for name in SEATED])
    return known.replace(body_pos=known.body_pos.at[seated].add(seat))


def mjx_model() -> mjx.Model:
    """The model for MJX."""
    return jax.tree.map(jnp.asarray, _stored()[0])


def blank_data() -> mjx.Data:
    """Data of the model, to be filled."""
    return jax.tree.map(jnp.asarray, _stored()[1])


@functools.cache
def _stored() -> tuple[mjx.Model, mjx.Data]:
    """Model and blank data in NumPy arrays.

    JAX's own must not be kept: the first use may be inside a compiled function, and arrays made
    in one that is shared out belong to its mesh of devices.
    """
    with jax.ensure_compile_time_eval():
        known = mjx.put_model(mujoco_model())
        return jax.tree.map(np.asarray, (known, mjx.make_data(known)))


@functools.cache
def substeps() -> int:
    """Steps of the physics in one step of a game."""
    return round(CONTROL_SECONDS / mujoco_model().opt.timestep)


@functools.cache
def joint_ranges() -> np.ndarray:
    """Lower and upper limit of each joint, rad [joint, 2]; infinite where it turns for ever."""
    # The solver keeps no limits, so the compiler leaves them as they are written, in degrees.
    ranges = np.radians(mujoco_model().jnt_range)
    endless = ranges[:, 0] >= ranges[:, 1]
    ranges[endless] = -np.inf, np.inf
    return ranges


@functools.cache
def largest_speed_errors() -> np.ndarray:
    """How far each servo may be from its speed before its motor gives its all, rad/s [joint].

    A servo's torque is its gain times that error; infinite where the motor has no limit.
    """
    actuators = mujoco_model()
    gain, most = actuators.actuator_gainprm[:, 0], actuators.actuator_forcerange[:, 1]
    return np.where(most > 0, most / gain, np.inf)


def site(name: str) -> int:
    """The number of a site."""
    return mujoco_model().site(name).id


def body(name: str) -> int:
    """The number of a body."""
    return mujoco_model().body(name).id


def geom(name: str) -> int:
    """The number of a geom."""
    return mujoco_model().geom(name).id
