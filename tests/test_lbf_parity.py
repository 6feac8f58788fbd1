"""Every step of every recorded lbforaging episode, replayed: no difference is allowed."""

import dataclasses
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.lbf import dynamics, observation
from envs.lbf.dynamics import Rules, State

pytestmark = pytest.mark.full_compilation

GOLDEN = Path(os.environ.get("GOLDEN_DIR", Path(__file__).parent / "golden")) / "lbf"
RECORDINGS = sorted(GOLDEN.glob("*.npz"))


def test_there_are_recordings():
    assert RECORDINGS, f"no recordings in {GOLDEN}"


def rules_of(recording) -> Rules:
    """The recording's own rules; its games last as many steps as it has room for."""
    _, rows, columns = recording["field0"].shape
    sight = int(recording["sight"])
    return Rules(
        rows=rows,
        columns=columns,
        max_steps=recording["actions"].shape[1],
        sight=None if sight >= max(rows, columns) else sight,
        penalty=float(recording["penalty"]),
        normalize_reward=bool(recording["normalize_reward"]),
    )


def start_of(field, place, level, num_foods) -> State:
    """The start of one episode; foods that could not be spawned are taken from the start."""
    food_place = np.full((num_foods, 2), -1)
    food_level = np.zeros(num_foods)
    found = np.argwhere(field)
    # Our order of the foods is free: let it differ from the observation's.
    shuffled = np.random.default_rng(0).permutation(found)
    food_place[: len(found)] = shuffled
    food_level[: len(found)] = field[tuple(shuffled.T)]
    arrays = (place, level, food_place, food_level, 0, field.sum())
    return State(*(jnp.asarray(array, jnp.int32) for array in arrays))


def fields_of(states, rows, columns) -> np.ndarray:
    """Our foods as arrays of cells, [..., R, C]."""
    levels, places = np.asarray(states.food_level), np.asarray(states.food_place)
    field = np.zeros((*levels.shape[:-1], rows, columns), int)
    for index in np.ndindex(*levels.shape):
        if levels[index]:
            field[(*index[:-1], *places[index])] = levels[index]
    return field


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_parity(path):
    recording = np.load(path)
    rules = rules_of(recording)
    num_steps, num_players = recording["actions"].shape[1:]
    num_foods = recording["obs0"].shape[-1] // 3 - num_players
    starts = [
        start_of(*start, num_foods)
        for start in zip(recording["field0"], recording["pos0"], recording["levels"], strict=True)
    ]
    start = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    # Sight over the whole field is seen in two ways: without a limit and with one that wide.
    sights = {rules.sight, int(recording["sight"])}

    def see(state):
        return [
            observation.flat(dataclasses.replace(rules, sight=sight), state) for sight in sights
        ]

    def one(state, action):
        transition = dynamics.step(rules, state, action)
        after = transition.after
        done = dynamics.nothing_left(after) | dynamics.time_is_up(rules, after)
        return after, (after, transition.reward, done, see(after))

    def episode(state, actions):
        return see(state), jax.lax.scan(one, state, actions)[1]

    actions = jnp.asarray(recording["actions"], jnp.int32)
    first, (states, reward, done, seen) = jax.jit(jax.vmap(episode))(start, actions)
    played = np.arange(num_steps) < recording["length"][:, None]
    assert played.any(axis=1).all()
    ours = {
        "pos": states.place,
        "field": fields_of(states, rules.rows, rules.columns),
        "reward": reward,
        "done": done,
    }
    for name, values in ours.items():
        wanted = recording[name]
        if name == "reward":  # recorded as float64
            wanted = wanted.astype(np.float32)
        np.testing.assert_array_equal(np.asarray(values)[played], wanted[played], err_msg=name)
    for first_seen, later_seen in zip(first, seen, strict=True):
        np.testing.assert_array_equal(first_seen, recording["obs0"])
        np.testing.assert_array_equal(np.asarray(later_seen)[played], recording["obs"][played])
