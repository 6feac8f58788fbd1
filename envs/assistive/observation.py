"""What the players see, in the robot's base frame."""

import jax
import jax.numpy as jnp
import numpy as np

from envs.assistive import model, physics
from envs.assistive.physics import Physics, Poses
from envs.assistive.styles import RULES, TASKS, Style
from envs.assistive.tasks import Progress, Target

SLICES = {
    "ego": {
        "tool_place": 3,
        "tool_orientation": 4,
        "arm_angles": 7,
        "shoulder_elbow_wrist": 9,
        "head_place": 3,
        "head_orientation": 4,
        "tool_force": 1,
    },
    "target": {"target_from_tool": 3, "target_place": 3},
    "tool": {"tool_kind": len(TASKS)},
    "partner": {
        "tool_place": 3,
        "tool_orientation": 4,
        "target_from_tool": 3,
        "target_place": 3,
        "own_angles": 6,
        "shoulder_elbow_wrist": 9,
        "head_place": 3,
        "head_orientation": 4,
        "tool_and_all_force": 2,
        "progress": 1,
        "style": len(RULES),
    },
}
"""Numbers in each named part of the players' vectors; `target` and `tool` end the ego's with
`reveal_target` and `tool="per_task"`. Places in m, angles in rad, orientations as quaternions
(w first, w >= 0), forces in 10 N, progress as the share of a success."""

_FORCE = 10.0


def feature_slices(
    player: str, *, reveal_target: bool = False, tool_kind: bool = False
) -> dict[str, slice]:
    """Where the named parts of a player's vector lie.

    Args:
        player: `ego` or `partner`.
        reveal_target: whether the ego is shown the target.
        tool_kind: whether the ego is shown the kind of its tool.
    """
    sizes = dict(SLICES[player])
    if player == "ego":
        sizes |= SLICES["target"] if reveal_target else {}
        sizes |= SLICES["tool"] if tool_kind else {}
    ends = np.cumsum(list(sizes.values()))
    return {
        name: slice(int(end) - size, int(end))
        for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


def ego_features(body: Physics, poses: Poses) -> jax.Array:
    """The robot's vector, float32 [31]: neither target nor task nor progress."""
    parts = (
        _place(poses.tool),
        _quaternion(poses.tool_rotation),
        body.angles[: len(model.ARM)],
        *map(_place, (poses.shoulder, poses.elbow, poses.wrist)),
        _place(poses.head),
        _quaternion(poses.head_rotation),
        physics.force_on(body)[None] / _FORCE,
    )
    return jnp.concatenate(parts)


def target_features(poses: Poses, target: Target) -> jax.Array:
    """Where the target lies, from the tool and from the base, float32 [6]."""
    return jnp.concatenate([_direction(target.place - poses.tool), _place(target.place)])


def partner_features(
    body: Physics, poses: Poses, target: Target, progress: Progress, share: jax.Array, style: Style
) -> jax.Array:
    """The person's vector, float32 [46].

    Args:
        body: of both.
        poses: of both.
        target: where the tool is wanted.
        progress: of the task.
        share: what one stroke, point, portion or unit is of a success, float32 [].
        style: its own.
    """
    forces = jnp.stack([physics.force_on(body), physics.force_on(body, by=("tool", "hand"))])
    parts = (
        _place(poses.tool),
        _quaternion(poses.tool_rotation),
        target_features(poses, target),
        body.angles[len(model.ARM) :],
        *map(_place, (poses.shoulder, poses.elbow, poses.wrist)),
        _place(poses.head),
        _quaternion(poses.head_rotation),
        forces / _FORCE,
        (progress.done * share)[None],
        style.one_hot,
    )
    return jnp.concatenate(parts)


def _base() -> tuple[np.ndarray, np.ndarray]:
    """Place and rotation of the robot's base, which does not move."""
    mujoco_model = model.mujoco_model()
    number = model.body("base")
    w, x, y, z = mujoco_model.body_quat[number]
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return mujoco_model.body_pos[number].astype(np.float32), rotation.astype(np.float32)


def _place(position: jax.Array) -> jax.Array:
    place, rotation = _base()
    return jnp.asarray(rotation.T) @ (position - place)


def _direction(vector: jax.Array) -> jax.Array:
    return jnp.asarray(_base()[1].T) @ vector


def _quaternion(rotation: jax.Array) -> jax.Array:
    """A rotation matrix in the base frame as a quaternion, w >= 0, float32 [4].

    By the largest of its four numbers, so that nothing is divided by little (Shepperd, 1978).
    """
    m = _base()[1].T @ rotation
    trace = jnp.trace(m)
    squares = jnp.stack([trace, m[0, 0], m[1, 1], m[2, 2]])
    spin = jnp.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    symmetric = m + m.T
    # Row i: the quaternion times four times its i-th number.
    first = jnp.concatenate([(1 + trace)[None], spin])[None]
    others = jnp.concatenate(
        [spin[:, None], symmetric + jnp.diag(1 - trace - jnp.zeros(3))], axis=1
    )
    candidates = jnp.concatenate([first, others])
    chosen = candidates[jnp.argmax(squares)]
    quaternion = chosen / jnp.linalg.norm(chosen)
    return jnp.where(quaternion[0] < 0, -quaternion, quaternion)
