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


def in_sight(layout: Layout, state: State, sight: int | None) -> jax.Array:
    """Returns whether the players are at most `sight` columns and rows apart, bool []."""
    if sight is None:
        return jnp.ones((), bool)
    away = np.abs(layout.floor[:, None] - layout.floor).max(axis=-1)
    return jnp.asarray(away <= sight)[state.cell[0], state.cell[1]]


def features(
    layout: Layout, state: State, agent: int, max_steps: int, sight: int | None = None
) -> jax.Array:
    """Returns one player's feature vector, float32 [O]; slices in `feature_slices`.

    Args:
        layout: the kitchen.
        state: the state.
        agent: who sees it.
        max_steps: steps of a game.
        sight: columns and rows up to which it sees the other player, whose slices (`other_…`)
            are 0 farther away; None sees it everywhere.
    """
    other = 1 - agent
    seen = in_sight(layout, state, sight)
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
        (state.cell[other] == cell_codes) & seen,
        state.orientation[agent] == directions,
        (state.orientation[other] == directions) & seen,
        item[state.held[agent]],
        item[jnp.where(seen, state.held[other], 0)],
        jnp.asarray(layout.kinds)[station] == np.arange(7),
        item[faced_item],
        jnp.any(at_pot & ready)[None],
        other_ahead[None],
        pots.ravel(),
        item[state.counters].ravel(),
        (1 - state.time / max_steps)[None],
    )
    return jnp.concatenate([part.astype(jnp.float32) for part in parts])


_CHANNEL = {name: index for index, name in enumerate(GRID_CHANNELS)}


@functools.cache
def _item_rows() -> np.ndarray:
    """Channels of a cell where an item lies or is held, by item code, uint8 [17, 26]."""
    rows = np.zeros((dynamics.SOUP + 13, len(GRID_CHANNELS)), np.uint8)
    for item, name in ((dynamics.ONION, "onion"), (dynamics.TOMATO, "tomato")):
        rows[item, _CHANNEL[name]] = 1
    rows[dynamics.DISH, _CHANNEL["dish"]] = 1
    content = np.arange(13)
    # A soup off the stove counts as ready, with no time left.
    rows[dynamics.SOUP :, _CHANNEL["soup_ready"]] = 1
    rows[dynamics.SOUP :, _CHANNEL["onions_in_soup"]] = content >> 2
    rows[dynamics.SOUP :, _CHANNEL["tomatoes_in_soup"]] = content & 3
    return rows


@functools.cache
def _pot_rows(cook_time: int) -> np.ndarray:
    """Channels of a pot by content and timer + 1, uint8 [13, cook_time + 2, 26]."""
    rows = np.zeros((13, cook_time + 2, len(GRID_CHANNELS)), np.uint8)
    for content in range(13):
        onions, tomatoes = content >> 2, content & 3
        rows[content, 0, [_CHANNEL["onions_in_pot"], _CHANNEL["tomatoes_in_pot"]]] = (
            onions,
            tomatoes,
        )
        rows[content, 1:, _CHANNEL["onions_in_soup"]] = onions
        rows[content, 1:, _CHANNEL["tomatoes_in_soup"]] = tomatoes
    rows[:, 1:, _CHANNEL["cooking_time_left"]] = cook_time - np.arange(cook_time + 1)
    rows[:, -1, _CHANNEL["soup_ready"]] = 1
    return rows


@functools.cache
def _terrain_rows(layout: Layout) -> np.ndarray:
    """Where pots, counters, dispensers and serving cells are, uint8 [W * H, 26]; x-major."""
    letters = np.array([list(row) for row in layout.terrain]).T.ravel()
    rows = np.zeros((len(letters), len(GRID_CHANNELS)), np.uint8)
    first = _CHANNEL["pot"]
    rows[:, first : first + 6] = letters[:, None] == np.array(list("PXOTDS"))
    return rows


def _kitchen_rows(layout: Layout, state: State) -> jax.Array:
    """The grid without players and urgency, the same for both players, uint8 [W * H, 26].

    Cells whose channels can change are laid between runs of constant ones: on a CPU, one
    concatenation is several times faster than computing every channel of every cell.
    """
    terrain = _terrain_rows(layout)
    changing = layout.num_counters + layout.num_pots
    positions = layout.stations[:changing] @ np.array([layout.height, 1])
    counters = jnp.asarray(_item_rows())[state.counters]
    pots = jnp.asarray(_pot_rows(layout.cook_time))[state.pot_content, state.pot_timer + 1]
    rows = jnp.concatenate([counters, pots]) | terrain[positions]
    pieces, end = [], 0
    for station in np.argsort(positions):
        position = positions[station]
        pieces += [terrain[end:position], rows[station, None]]
        end = position + 1
    return jnp.concatenate([*pieces, terrain[end:]])


def grid(
    layout: Layout, state: State, agent: int, max_steps: int, sight: int | None = None
) -> jax.Array:
    """Returns overcooked-ai's lossless grid encoding for one player, uint8 [W, H, 26].

    Channels are named by `GRID_CHANNELS`; axes are (x, y) as in the reference, whose
    `lossless_state_encoding` of version 1.1.0 this follows. Arguments as for `features`; a
    player out of sight is in no channel.
    """
    channels = np.arange(len(GRID_CHANNELS))
    encoded = _kitchen_rows(layout, state)
    places = np.arange(layout.width * layout.height)
    floor = jnp.asarray(layout.floor @ np.array([layout.height, 1]))
    seen = in_sight(layout, state, sight)
    for player, shown, location, orientation in (
        (agent, True, "own_location", "own_orientation_north"),
        (1 - agent, seen, "other_location", "other_orientation_north"),
    ):
        here = (places == floor[state.cell[player]]) & shown
        row = (
            jnp.asarray(_item_rows())[state.held[player]]
            | (channels == _CHANNEL[location])
            | (channels == _CHANNEL[orientation] + state.orientation[player])
        )
        encoded |= jnp.where(here[:, None], row, jnp.uint8(0))
    urgent = max_steps - state.time < URGENT_STEPS
    encoded |= (urgent & (channels == _CHANNEL["urgency"])).astype(jnp.uint8)
    return encoded.reshape(layout.width, layout.height, len(GRID_CHANNELS))
