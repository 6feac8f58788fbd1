"""What a player sees: a flat feature vector for small MLPs, or overcooked-ai's grid.

The features are egocentric in order (own things first, then the other player's), so one
network can play either side of a symmetric kitchen.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from envs.overcooked import dynamics
from envs.overcooked.dynamics import State
from envs.overcooked.layouts import Layout

GRID_CHANNELS = (
    *("own_location", "other_location"),
    *(f"own_orientation_{d}" for d in ("north", "south", "east", "west")),
    *(f"other_orientation_{d}" for d in ("north", "south", "east", "west")),
    *("pot", "counter", "onions", "tomatoes", "dishes", "serving"),
    *("onions_in_pot", "tomatoes_in_pot", "onions_in_soup", "tomatoes_in_soup"),
    *("cooking_time_left", "soup_ready", "dish", "onion", "tomato", "urgency"),
)
URGENT_STEPS = 40


@functools.cache
def feature_slices(layout: Layout) -> dict[str, slice]:
    """Names every slice of the feature vector.

    Values are 0 or 1 but for amounts (ingredients / 3), timers (steps left / cook time) and
    `time_left` (share of the game, 1 at the start).
    """
    cells, items = len(layout.floor), _num_item_flags(layout)
    sizes = {"own_cell": cells, "other_cell": cells, "own_orientation": 4, "other_orientation": 4}
    sizes |= {"own_held": items, "other_held": items}
    # Kinds of the faced cell (X P O T D S, floor), its item, whether the other stands there.
    sizes |= {"faced_kind": 7, "faced_item": items, "faced_ready": 1, "faced_other": 1}
    # Onions, tomatoes, cooking, ready, time left of each pot.
    sizes |= {"pots": 5 * layout.num_pots, "counters": items * layout.num_counters, "time_left": 1}
    ends = np.cumsum(list(sizes.values()))
    starts = [0, *ends[:-1]]
    return {name: slice(int(a), int(b)) for name, a, b in zip(sizes, starts, ends, strict=True)}


def num_features(layout: Layout) -> int:
    """Returns the length of the feature vector."""
    return feature_slices(layout)["time_left"].stop


def _num_item_flags(layout: Layout) -> int:
    return 6 if layout.has_tomatoes else 4


@functools.cache
def _item_table(layout: Layout) -> np.ndarray:
    """Features of each item code: onion, (tomato), dish, soup, soup's amounts / 3; [17, n]."""
    table = np.zeros((dynamics.SOUP + 13, 6), np.float32)
    for code in range(1, dynamics.SOUP):
        table[code, code - 1] = 1
    for content in range(13):
        table[dynamics.SOUP + content, 3:] = 1, (content >> 2) / 3, (content & 3) / 3
    return table if layout.has_tomatoes else table[:, [0, 2, 3, 4]]


def features(layout: Layout, state: State, agent: int, max_steps: int) -> jax.Array:
    """Returns one player's feature vector, float32 [O]; slices in `feature_slices`."""
    other = 1 - agent
    cell_codes, directions = np.arange(len(layout.floor)), np.arange(4)
    item = jnp.asarray(_item_table(layout))
    station = dynamics.faced_station(layout, state, agent)
    ahead = jnp.asarray(layout.neighbour.ravel())[state.cell[agent] * 4 + state.orientation[agent]]
    other_ahead = (ahead == state.cell[other]) & (ahead != state.cell[agent])

    counter_codes = np.arange(layout.num_counters)
    pot_codes = layout.num_counters + np.arange(layout.num_pots)
    at_pot = pot_codes == station
    faced_item = jnp.sum(jnp.where(counter_codes == station, state.counters, 0)) + jnp.sum(
        jnp.where(at_pot & (state.pot_content > 0), dynamics.SOUP + state.pot_content, 0)
    )
    ready = state.pot_timer == layout.cook_time
    pots = jnp.stack(
        [
            (state.pot_content >> 2) / 3,
            (state.pot_content & 3) / 3,
            (state.pot_timer >= 0) & ~ready,
            ready,
            jnp.where(state.pot_timer >= 0, 1 - state.pot_timer / layout.cook_time, 0.0),
        ],
        axis=-1,
        dtype=jnp.float32,
    )
    parts = (
        state.cell[agent] == cell_codes,
        state.cell[other] == cell_codes,
        state.orientation[agent] == directions,
        state.orientation[other] == directions,
        item[state.held[agent]],
        item[state.held[other]],
        jnp.asarray(layout.kinds)[station] == np.arange(7),
        item[faced_item],
        jnp.any(at_pot & ready)[None],
        other_ahead[None],
        pots.ravel(),
        item[state.counters].ravel(),
        (1 - state.time / max_steps)[None],
    )
    return jnp.concatenate([part.astype(jnp.float32) for part in parts])


@functools.cache
def _terrain_masks(layout: Layout) -> np.ndarray:
    """Where pots, counters, onions, tomatoes, dishes and serving cells are, [H, W, 6]."""
    letters = np.array([list(row) for row in layout.terrain])
    return np.stack([letters == kind for kind in "PXOTDS"], axis=-1)


@functools.cache
def _scatter_maps(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Index of each grid cell's floor cell and station (one past the end for none), [H, W]."""
    floor = np.full((layout.height, layout.width), len(layout.floor))
    floor[layout.floor[:, 1], layout.floor[:, 0]] = np.arange(len(layout.floor))
    station = np.full((layout.height, layout.width), len(layout.stations))
    x, y = layout.stations.T
    station[y, x] = np.arange(len(layout.stations))
    return floor, station


def grid(layout: Layout, state: State, agent: int, max_steps: int) -> jax.Array:
    """Returns overcooked-ai's lossless grid encoding for one player, uint8 [W, H, 26].

    Channels are named by `GRID_CHANNELS`; axes are (x, y) as in the reference, whose
    `lossless_state_encoding` of version 1.1.0 this follows.
    """
    floor_map, station_map = _scatter_maps(layout)
    other = 1 - agent
    here = {player: floor_map == state.cell[player] for player in (0, 1)}
    channels = [here[agent], here[other]]
    channels += [
        here[p] & (state.orientation[p] == direction)
        for p in (agent, other)
        for direction in range(4)
    ]
    channels += list(np.moveaxis(_terrain_masks(layout), -1, 0))

    # Codes of the things on stations; pots carry their content, counters an item.
    dispensers = len(layout.stations) - layout.num_counters - layout.num_pots + 1
    none = jnp.zeros(dispensers, jnp.int32)
    lying = jnp.concatenate([state.counters, jnp.zeros(layout.num_pots, jnp.int32), none])
    held = sum(jnp.where(here[player], state.held[player], 0) for player in (0, 1))
    item = lying[station_map] + held
    in_soup = jnp.where(item >= dynamics.SOUP, item - dynamics.SOUP, 0)
    no_counters = jnp.zeros(layout.num_counters, jnp.int32)
    pot_content = jnp.concatenate([no_counters, state.pot_content, none])[station_map]
    timer = jnp.concatenate([no_counters - 1, state.pot_timer, none - 1])[station_map]
    started = timer >= 0
    in_pot = jnp.where(started, 0, pot_content)
    soup = in_soup + jnp.where(started, pot_content, 0)
    # A soup off the stove counts as ready, with no time left.
    channels += [in_pot >> 2, in_pot & 3, soup >> 2, soup & 3]
    channels += [
        jnp.where(started, layout.cook_time - timer, 0),
        (timer == layout.cook_time) | (item >= dynamics.SOUP),
    ]
    channels += [item == code for code in (dynamics.DISH, dynamics.ONION, dynamics.TOMATO)]
    urgent = max_steps - state.time < URGENT_STEPS
    channels.append(jnp.broadcast_to(urgent, floor_map.shape))
    stacked = jnp.stack([jnp.asarray(c).astype(jnp.uint8) for c in channels], axis=-1)
    return stacked.transpose(1, 0, 2)
