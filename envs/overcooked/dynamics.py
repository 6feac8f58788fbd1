"""The rules of overcooked-ai 1.1.0, over the reachable cells of a kitchen only.

Player 0's interaction resolves first, then player 1's, then both move, then pots cook.
Reference: `OvercookedGridworld.get_state_transition` of overcooked-ai 1.1.0.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.overcooked import layouts
from envs.overcooked.layouts import Layout

STAY, INTERACT = 4, 5
NUM_ACTIONS = 6
ACTION_NAMES = ("north", "south", "east", "west", "stay", "interact")

# Item codes: a soup is SOUP + 4 * onions + tomatoes.
NO_ITEM, ONION, TOMATO, DISH, SOUP = 0, 1, 2, 3, 4
IDLE = -1

# What an interaction changed.
NO_CHANGE, TAKEN_FROM_DISPENSER, PUT_ON_COUNTER, TAKEN_FROM_COUNTER = 0, 1, 2, 3
POTTED, COOKING_STARTED, SOUP_TAKEN, DELIVERED = 4, 5, 6, 7


class State(PyTreeNode):
    """A moment of a game.

    Attributes:
        cell: floor cell of each player, int32 [agent], an index into `Layout.floor`.
        orientation: 0 north, 1 south, 2 east, 3 west, int32 [agent].
        held: item code in each player's hands, int32 [agent].
        counters: item code on each reachable counter, int32 [C].
        pot_content: 4 * onions + tomatoes in each pot, int32 [P].
        pot_timer: -1 not cooking, else steps cooked, `cook_time` when ready, int32 [P].
        time: steps taken, int32 [].
    """

    cell: jax.Array
    orientation: jax.Array
    held: jax.Array
    counters: jax.Array
    pot_content: jax.Array
    pot_timer: jax.Array
    time: jax.Array


class Interaction(PyTreeNode):
    """What each player's interaction did; leading axis [agent] when stacked.

    Attributes:
        station: station that was faced, K for none, int32.
        change: one of the change codes above, int32.
        item: item that was taken, put, potted or delivered, int32.
        content: content of the pot before, if a pot was faced, int32.
    """

    station: jax.Array
    change: jax.Array
    item: jax.Array
    content: jax.Array


class Transition(PyTreeNode):
    """A step with what rewards and events are computed from.

    Attributes:
        before: the state when the step began.
        between: the state after player 0's interaction, which player 1's then met.
        after: the state when the step ended.
        interactions: `Interaction` with leading axis [agent].
    """

    before: State
    between: State
    after: State
    interactions: Interaction


def num_ingredients(content: jax.Array) -> jax.Array:
    """Returns how many ingredients a content code holds, 0 to 3."""
    return (content >> 2) + (content & 3)


def start_state(layout: Layout, start: jax.Array | None = None) -> State:
    """Returns an empty kitchen with both players facing north.

    Args:
        layout: the kitchen.
        start: start cells, int32 [agent]; the layout's own by default.
    """
    return State(
        cell=jnp.asarray(layout.start if start is None else start, jnp.int32),
        orientation=jnp.zeros(2, jnp.int32),
        held=jnp.zeros(2, jnp.int32),
        counters=jnp.zeros(layout.num_counters, jnp.int32),
        pot_content=jnp.zeros(layout.num_pots, jnp.int32),
        pot_timer=jnp.full(layout.num_pots, IDLE, jnp.int32),
        time=jnp.zeros((), jnp.int32),
    )


def faced_station(layout: Layout, state: State, agent: int) -> jax.Array:
    """Returns the station that a player faces, K for none, int32 []."""
    facing = jnp.asarray(layout.facing.ravel())
    return facing[state.cell[agent] * 4 + state.orientation[agent]]


def interact(
    layout: Layout, state: State, agent: int, acts: jax.Array, old_dynamics: bool
) -> tuple[State, Interaction]:
    """Resolves one player's interaction.

    Args:
        layout: the kitchen.
        state: the state that the player meets.
        agent: 0 or 1.
        acts: whether the player interacts at all, bool [].
        old_dynamics: pots with three ingredients start by themselves, and only so.

    Returns:
        The state with hands, counters and pots updated, and what happened.
    """
    num_counters, num_pots = layout.num_counters, layout.num_pots
    station = faced_station(layout, state, agent)
    kind = jnp.asarray(layout.kinds)[station]
    held = state.held[agent]
    empty_handed = held == NO_ITEM

    on_counter = jnp.arange(num_counters) == station
    at_pot = jnp.arange(num_counters, num_counters + num_pots) == station
    lying = jnp.sum(jnp.where(on_counter, state.counters, 0))
    content = jnp.sum(jnp.where(at_pot, state.pot_content, 0))
    timer = jnp.sum(jnp.where(at_pot, state.pot_timer, 0))

    counter = acts & (kind == layouts.COUNTER)
    put = counter & ~empty_handed & (lying == NO_ITEM)
    take = counter & empty_handed & (lying != NO_ITEM)
    dispense = acts & empty_handed & (kind >= layouts.ONIONS) & (kind <= layouts.DISHES)
    pot = acts & (kind == layouts.POT)
    ingredient = (held == ONION) | (held == TOMATO)
    potted = pot & ingredient & (timer == IDLE) & (num_ingredients(content) < 3)
    started = pot & empty_handed & (timer == IDLE) & (content > 0)
    if old_dynamics:
        started = jnp.zeros_like(started)
    soup_taken = pot & (held == DISH) & (timer == layout.cook_time)
    delivered = acts & (kind == layouts.SERVING) & (held >= SOUP)

    dispensed = kind - layouts.ONIONS + ONION
    new_content = jnp.where(
        potted, content + jnp.where(held == ONION, 4, 1), jnp.where(soup_taken, 0, content)
    )
    new_timer = jnp.where(started, 0, jnp.where(soup_taken, IDLE, timer))
    new_held = jnp.where(dispense, dispensed, held)
    new_held = jnp.where(take, lying, new_held)
    new_held = jnp.where(soup_taken, SOUP + content, new_held)
    new_held = jnp.where(put | potted | delivered, NO_ITEM, new_held)
    new_lying = jnp.where(put, held, jnp.where(take, NO_ITEM, lying))

    is_agent = np.arange(2) == agent
    changed = state.replace(
        held=jnp.where(is_agent, new_held, state.held),
        counters=jnp.where(on_counter, new_lying, state.counters),
        pot_content=jnp.where(at_pot, new_content, state.pot_content),
        pot_timer=jnp.where(at_pot, new_timer, state.pot_timer),
    )
    # The cases exclude each other, so their codes can be added.
    change = (
        dispense * TAKEN_FROM_DISPENSER
        + put * PUT_ON_COUNTER
        + take * TAKEN_FROM_COUNTER
        + potted * POTTED
        + started * COOKING_STARTED
        + soup_taken * SOUP_TAKEN
        + delivered * DELIVERED
    )
    item = jnp.where(dispense | take | soup_taken, new_held, held)
    return changed, Interaction(station=station, change=change, item=item, content=content)


def move(layout: Layout, state: State, actions: jax.Array, cells: jax.Array) -> State:
    """Turns and moves both players; if they would collide or swap, neither moves.

    Args:
        layout: the kitchen.
        state: the state after both interactions.
        actions: int32 [agent].
        cells: floor cells each player may enter, bool [agent, F].
    """
    neighbour = jnp.asarray(layout.neighbour.ravel())
    moves = actions < STAY
    orientation = jnp.where(moves, actions, state.orientation)
    wanted = jnp.where(moves, neighbour[state.cell * 4 + orientation], state.cell)
    allowed = jnp.stack([cells[agent][wanted[agent]] for agent in (0, 1)])
    wanted = jnp.where(allowed, wanted, state.cell)
    same = wanted[0] == wanted[1]
    swapped = (wanted[0] == state.cell[1]) & (wanted[1] == state.cell[0])
    return state.replace(
        orientation=orientation, cell=jnp.where(same | swapped, state.cell, wanted)
    )


def cook(layout: Layout, state: State, old_dynamics: bool) -> State:
    """Lets the pots cook for one step and counts the time."""
    timer = state.pot_timer
    if old_dynamics:
        starts = (timer == IDLE) & (num_ingredients(state.pot_content) == 3)
        timer = jnp.where(starts, 0, timer)
    cooking = (timer >= 0) & (timer < layout.cook_time)
    return state.replace(pot_timer=timer + cooking, time=state.time + 1)


def step(
    layout: Layout,
    state: State,
    actions: jax.Array,
    *,
    cells: jax.Array,
    targets: jax.Array,
    old_dynamics: bool = False,
) -> Transition:
    """Plays one step.

    Args:
        layout: the kitchen.
        state: the state before.
        actions: int32 [agent], 0 to 5: north, south, east, west, stay, interact.
        cells: floor cells each player may enter, bool [agent, F].
        targets: stations each player may interact with, bool [agent, K].
        old_dynamics: see `interact`.
    """
    may_use = jnp.pad(targets, ((0, 0), (0, 1)))
    states, interactions = [state], []
    for agent in (0, 1):
        here = states[-1]
        acts = (actions[agent] == INTERACT) & may_use[agent][faced_station(layout, here, agent)]
        changed, interaction = interact(layout, here, agent, acts, old_dynamics)
        states.append(changed)
        interactions.append(interaction)
    after = cook(layout, move(layout, states[-1], actions, cells), old_dynamics)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *interactions)
    return Transition(before=state, between=states[1], after=after, interactions=stacked)
