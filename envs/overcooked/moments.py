"""Random moments of games to start from in training.

In an empty kitchen a beginner never sees a soup, and one wrong move may block the only pot for
the rest of the game. From random moments each player can learn its part before the other has
learnt to give.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.overcooked import dynamics
from envs.overcooked.dynamics import State
from envs.overcooked.layouts import Layout

POOL_SIZE = 256
FULL_POTS = 0.4
"""Share of the pots that are full for certain."""
LONGEST, SHORTEST = 200, 40
"""Steps that a moment leaves, at most and at least."""


@dataclasses.dataclass(frozen=True)
class Situation:
    """What random moments of a style have in common.

    Attributes:
        start: start cells, int [agent].
        cells: floor cells where each player may be, bool [agent, F].
        shared: counters that both players reach, bool [C].
        needed: items that one player needs from the other.
        wanted: contents of the soups that pay.
        max_steps: length of a game.
    """

    start: np.ndarray
    cells: np.ndarray
    shared: np.ndarray
    needed: tuple[int, ...]
    wanted: tuple[int, ...]
    max_steps: int


def draw_pool(layout: Layout, situation: Situation) -> State:
    """Draws moments once, since drawing on every reset is slow.

    Returns:
        State with leading axis [POOL_SIZE]; the first is the usual start.
    """
    random = np.random.default_rng(0)
    first = dynamics.start_state(layout, jnp.asarray(situation.start))
    moments = [jax.tree.map(np.asarray, first)]
    moments += [draw_moment(layout, random, situation) for _ in range(POOL_SIZE - 1)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *moments)


def draw_moment(layout: Layout, random: np.random.Generator, situation: Situation) -> State:
    """Draws places, hands, counters, pots and the time left.

    On half of the shared counters lies something that one player needs from the other.
    """
    soups = [dynamics.SOUP + content for content in situation.wanted]
    ingredients = [dynamics.ONION] + [dynamics.TOMATO] * layout.has_tomatoes
    items = [*ingredients, dynamics.DISH, *soups]

    def draw_items(size: int, share: float) -> np.ndarray:
        drawn = random.choice(items, size)
        return np.where(random.random(size) < share, drawn, dynamics.NO_ITEM).astype(np.int32)

    ego_cells, partner_cells = situation.cells
    partner = random.choice(np.flatnonzero(partner_cells))
    ego_cells = ego_cells.copy()
    ego_cells[partner] = False
    ego = random.choice(np.flatnonzero(ego_cells))
    counters = draw_items(layout.num_counters, 0.1)
    if situation.needed:
        offered = random.choice(situation.needed, layout.num_counters)
        fits = situation.shared & (random.random(layout.num_counters) < 0.5)
        counters = np.where(fits, offered, counters)
    amounts = random.integers(0, 4, layout.num_pots)
    amounts = np.where(random.random(layout.num_pots) < FULL_POTS, 3, amounts)
    units = _ingredient_units(layout, random, situation)
    cooking = (amounts == 3) & (random.random(layout.num_pots) < 0.7)
    # Twice the cook time: half of the soups that were started are ready.
    timer = random.integers(0, 2 * layout.cook_time + 1, layout.num_pots)
    timer = np.minimum(timer, layout.cook_time)
    least = max(0, situation.max_steps - LONGEST)
    arrays: dict[str, Any] = {
        "cell": np.array([ego, partner], np.int32),
        "orientation": random.integers(0, 4, 2).astype(np.int32),
        "held": draw_items(2, 0.5),
        "counters": counters.astype(np.int32),
        "pot_content": (amounts * units).astype(np.int32),
        "pot_timer": np.where(cooking, timer, dynamics.IDLE).astype(np.int32),
        "time": np.array(random.integers(least, situation.max_steps - SHORTEST), np.int32),
    }
    return State(**arrays)


def _ingredient_units(
    layout: Layout, random: np.random.Generator, situation: Situation
) -> np.ndarray:
    """What one ingredient adds to a content code, by pot, int [P]; mostly what is ordered."""
    units = [4, 1, *(content // 3 for content in situation.wanted)] if layout.has_tomatoes else [4]
    return random.choice(units, layout.num_pots)
