"""The arm's physics: MJX beside C MuJoCo, forces, joint ranges."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from envs.assistive import control, model, physics

pytestmark = pytest.mark.full_compilation

STEPS = 100
MJX = {"xla_cpu_use_fusion_emitters": False}


def c_step(data: mujoco.MjData, velocities: np.ndarray) -> None:
    """One control step of C MuJoCo."""
    data.ctrl[:] = velocities
    for _ in range(model.substeps()):
        mujoco.mj_step(data.model, data)


def c_forces(data: mujoco.MjData) -> list[float]:
    """Normal force of each of the `CONTACTS`, N."""
    found = dict.fromkeys(map(frozenset, physics.CONTACTS), 0.0)
    force = np.zeros(6)
    for number in range(data.ncon):
        mujoco.mj_contactForce(data.model, data, number, force)
        names = frozenset(data.model.geom(geom).name for geom in data.contact[number].geom)
        found[names] += force[0]
    return list(found.values())


def near_the_arm(rng: np.random.Generator) -> np.ndarray:
    """Angles at which the tool is about to touch the person's forearm or upper arm, rad."""
    mujoco_model = model.mujoco_model()
    data = mujoco.MjData(mujoco_model)
    best, best_gap = model.HOME, np.inf
    for _ in range(4000):
        angles = model.HOME + rng.normal(0, 0.7, len(model.JOINTS))
        angles = np.clip(angles, *model.joint_ranges().T)
        data.qpos[:] = angles
        mujoco.mj_forward(mujoco_model, data)
        gaps = [
            abs(
                mujoco.mj_geomDistance(
                    mujoco_model, data, model.geom("tool"), model.geom(part), 1.0, None
                )
            )
            for part in ("upper_arm", "forearm")
        ]
        if min(gaps) < best_gap:
            best, best_gap = angles, min(gaps)
    return best


@pytest.fixture(scope="module")
def played() -> dict[str, np.ndarray]:
    """100 control steps of random actions from touching starts, in MJX and in C.

    In half of the games the person does not sit in the usual place. 32 such games of the first
    eight seeds, with up to 15 steps of contact, stay below 6e-5 rad, most below 1e-5.
    """
    rng = np.random.default_rng(1)
    starts = np.stack([near_the_arm(rng) for _ in range(4)])
    actions = rng.uniform(-1, 1, (STEPS, len(starts), len(model.JOINTS)))
    seats = rng.uniform(-0.02, 0.02, (len(starts), 3)) * np.array([[0], [1], [0], [1]])
    ranges = model.joint_ranges()

    def one_step(body, action):
        velocities = control.velocities(body, action, ranges)
        body = physics.step(body, velocities)
        return body, (body.angles, body.forces, velocities)

    def play(angles, seat, actions):
        return jax.lax.scan(one_step, physics.at_rest(angles, seat), actions)[1]

    program = jax.jit(jax.vmap(play, in_axes=(0, 0, 1)), compiler_options=MJX)
    arguments = (jnp.asarray(given, jnp.float32) for given in (starts, seats, actions))
    angles, forces, velocities = map(np.asarray, program(*arguments))
    reference, pushed = [], []
    for game, start in enumerate(starts):
        data = model.posed(start, seats[game])
        for step in range(STEPS):
            c_step(data, velocities[game, step])
            reference.append(data.qpos.copy())
            pushed.append(c_forces(data))
    shape = (len(starts), STEPS, -1)
    return {
        "angles": angles,
        "forces": forces,
        "reference": np.reshape(reference, shape),
        "pushed": np.reshape(pushed, shape),
    }


def test_mjx_agrees_with_c(played):
    assert np.abs(played["angles"] - played["reference"]).max() < 1e-4


def test_the_seat_carries_the_whole_person_and_nothing_else():
    seat = np.array([0.05, -0.03, 0.02])
    find = jax.jit(lambda seat: physics.poses(physics.at_rest(jnp.asarray(model.HOME), seat)))
    usual, moved = find(jnp.zeros(3)), find(jnp.asarray(seat))
    for part in ("shoulder", "elbow", "wrist", "head", "mouth"):
        shift = np.asarray(getattr(moved, part) - getattr(usual, part))
        np.testing.assert_allclose(shift, seat, atol=1e-5, err_msg=part)
    np.testing.assert_allclose(moved.tool, usual.tool, atol=1e-6)
    in_c = physics.read_poses(model.posed(model.HOME, seat))
    np.testing.assert_allclose(moved.mouth, in_c.mouth, atol=1e-5)
    np.testing.assert_allclose(moved.wrist, in_c.wrist, atol=1e-5)


def test_the_games_had_contact(played):
    touching = (played["pushed"] > 0).any(axis=-1).sum(axis=1)
    assert (touching >= 2).all(), touching
    assert touching.sum() >= 20, touching


def test_forces_are_those_of_c(played):
    np.testing.assert_allclose(played["forces"], played["pushed"], atol=0.05)


def test_the_model_serves_one_mesh_of_devices_after_another():
    # Brax's PPO shares its games out over a mesh of its own, after ours has used the model.
    model._stored.cache_clear()
    for axis in ("member", "i"):
        mesh, spec = Mesh(np.array(jax.devices()), (axis,)), PartitionSpec(axis)

        def two_steps(seat: jax.Array) -> jax.Array:
            return 2 * model.mjx_model_with(seat).opt.timestep + model.blank_data().time

        shared_out = jax.shard_map(jax.vmap(two_steps), mesh=mesh, in_specs=spec, out_specs=spec)
        found = jax.jit(shared_out)(jnp.zeros((2, 3)))
        np.testing.assert_allclose(found, 2 * model.mujoco_model().opt.timestep, rtol=1e-6)
