"""Every step of every recorded overcooked-ai episode, replayed: no difference is allowed."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.overcooked import dynamics, events, layouts, reward

pytestmark = pytest.mark.full_compilation

GOLDEN = Path(os.environ.get("GOLDEN_DIR", Path(__file__).parent / "golden")) / "overcooked"
RECORDINGS = sorted(GOLDEN.glob("*.npz"))


def test_there_are_recordings():
    assert RECORDINGS, f"no recordings in {GOLDEN}"


def layout_of(recording) -> layouts.Layout:
    """The recording's own kitchen, so that other recordings can be replayed too."""
    rows = [list("".join(row)) for row in recording["terrain"]]
    for player in (0, 1):
        x, y = recording["players"][0, 0, player, :2]
        rows[y][x] = str(player + 1)
    layout = layouts.parse_layout("recorded", "\n".join("".join(row) for row in rows))
    codes = {
        4 * order.split().count("onion") + order.split().count("tomato")
        for order in recording["orders"]
    }
    assert codes == set(layout.orders)
    return layout


def states_of(layout, players, grid) -> dict[str, np.ndarray]:
    """Recorded moments [...] as the arrays of our states."""
    held = np.where(
        players[..., 3] == 4,
        dynamics.SOUP + 4 * players[..., 4].astype(int) + players[..., 5],
        players[..., 3],
    )
    x, y = layout.stations[:, 0], layout.stations[:, 1]
    thing, onions, tomatoes, tick = np.moveaxis(grid[..., y, x].astype(int), -2, 0)
    lying = np.where(thing == 4, dynamics.SOUP + 4 * onions + tomatoes, thing)
    pots = slice(layout.num_counters, layout.num_counters + layout.num_pots)
    floor = np.full((layout.width, layout.height), -1)
    floor[tuple(layout.floor.T)] = np.arange(len(layout.floor))
    return {
        "cell": floor[players[..., 0], players[..., 1]],
        "orientation": players[..., 2],
        "held": held,
        "counters": lying[..., : layout.num_counters],
        "pot_content": (4 * onions + tomatoes)[..., pots],
        "pot_timer": np.where(thing[..., pots] == 0, dynamics.IDLE, tick[..., pots]),
    }


def starts_by_itself(layout, states) -> bool:
    """Whether the recording was made with the old dynamics: no full pot is ever left idle.

    The file's name is no proof: the released overcooked-ai 1.1.0 has no old dynamics, and
    recordings named `old` were made with the new ones.
    """
    full = dynamics.num_ingredients(states["pot_content"]) == 3
    return bool(full.any() and not (full & (states["pot_timer"] == dynamics.IDLE)).any())


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_parity(path):
    recording = np.load(path)
    layout = layout_of(recording)
    recorded = states_of(layout, recording["players"], recording["grid"])
    old_dynamics = starts_by_itself(layout, recorded)
    everything = {
        "cells": jnp.ones((2, len(layout.floor)), bool),
        "targets": jnp.ones((2, len(layout.stations)), bool),
    }
    pays = np.tile(reward.order_values(layout.orders), (len(layout.stations), 1))
    names = [str(name) for name in recording["event_names"]]
    assert sorted(names) == sorted(events.REFERENCE_EVENTS)

    def one(state, action):
        transition = dynamics.step(layout, state, action, old_dynamics=old_dynamics, **everything)
        log = events.reference_events(layout, transition)
        outputs = (
            transition.after,
            reward.delivery_reward(layout, transition.interactions, jnp.asarray(pays)),
            reward.reference_shaping(layout, transition),
            jnp.stack([log[name] for name in names]),
        )
        return transition.after, outputs

    start = dynamics.start_state(layout)
    actions = jnp.asarray(recording["actions"], jnp.int32)
    replay = jax.jit(jax.vmap(lambda episode: jax.lax.scan(one, start, episode)[1]))
    states, sparse, shaped, log = replay(actions)
    for name, values in recorded.items():
        np.testing.assert_array_equal(getattr(states, name), values[:, 1:], err_msg=name)
        first = getattr(start, name)
        np.testing.assert_array_equal(
            np.broadcast_to(first, values[:, 0].shape), values[:, 0], err_msg=name
        )
    np.testing.assert_array_equal(sparse, recording["sparse"])
    np.testing.assert_array_equal(shaped, recording["shaped"])
    np.testing.assert_array_equal(log, recording["events"])
