"""Rewards of the kitchen: deliveries, the reference's shaping, and our own.

The reference's shaped reward pays for potting (3), a useful dish (3) and a soup taken from
the pot (5), whatever the soup. In kitchens of two rooms that is farmed with soups that
nobody ordered, and it says nothing about hand-overs; `guided_shaping` mends both.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs.overcooked import dynamics, paths
from envs.overcooked.dynamics import Interaction, State, Transition
from envs.overcooked.layouts import Layout

IN_THE_WAY = -0.5
"""Worth of a useless item on a counter that both players need, in hand-overs."""

NUM_CONTENTS = 16
"""Content codes run from 0 to 12; the tables have 16 rows."""


@dataclasses.dataclass(frozen=True)
class ShapingWeights:
    """Weights of the guided shaping, in units of the team reward (a soup pays 20).

    `potting`, `dish` and `soup_taken` are the reference's, but a soup that nobody ordered
    earns less when it is taken from the pot. Starting an unfinished pot costs nothing: any
    fine keeps random players, who start the pot by accident all the time, from learning to
    use it at all (measured: docs/paper_map.md). `way` pays both players for each step by which
    a carrier's way gets shorter, so that giving way is paid at once. `bring` pays a player for
    each step by which it brings an ingredient nearer to a pot that takes it: where one pot is
    full, the next is worth the walk.
    """

    potting: float = 3.0
    dish: float = 3.0
    soup_taken: float = 5.0
    unordered_soup_taken: float = 2.0
    start_full: float = 3.0
    spoilt: float = -1.0
    unordered_delivery: float = -1.0
    hand_over: float = 1.0
    way: float = 0.3
    bring: float = 0.3


def order_values(orders: tuple[int, ...], soup_reward: float = 20.0) -> np.ndarray:
    """Returns what a soup of each content pays, float32 [content]."""
    values = np.zeros(NUM_CONTENTS, np.float32)
    values[list(orders)] = soup_reward
    return values


def reachable_values(values: jax.Array) -> jax.Array:
    """Returns the best pay that each content can still become by adding ingredients.

    Args:
        values: pay by content, float [content].

    Returns:
        float [content]; 0 for contents of which no paying soup can be made.
    """
    content = np.arange(NUM_CONTENTS)
    onions, tomatoes = content >> 2, content & 3
    becomes = (onions[:, None] <= onions) & (tomatoes[:, None] <= tomatoes)
    return jnp.max(jnp.where(becomes, values, 0.0), axis=1)


def delivery_reward(layout: Layout, interaction: Interaction, pays: jax.Array) -> jax.Array:
    """Returns what each player's delivery pays, float32 [agent].

    Args:
        layout: the kitchen.
        interaction: leading axis [agent].
        pays: pay by station and content, float32 [K, content].
    """
    station = jnp.minimum(interaction.station, len(layout.stations) - 1)
    content = jnp.maximum(interaction.item - dynamics.SOUP, 0)
    delivered = interaction.change == dynamics.DELIVERED
    return jnp.where(delivered, pays[station, content], 0.0)


def dish_is_useful(layout: Layout, pots: State, seen: State) -> jax.Array:
    """Whether taking a dish now is useful, bool [].

    There is no dish on a counter, and fewer dishes in hands than pots that are cooking,
    ready or partly filled. The reference looks at the pots as they were when the step
    began (`pots`) and at the rest as the acting player meets it (`seen`).
    """
    amount = dynamics.num_ingredients(pots.pot_content)
    cooked = pots.pot_timer >= 0
    waiting = jnp.sum(cooked | ((amount > 0) & (amount < 3)))
    in_hands = jnp.sum(seen.held == dynamics.DISH)
    return (in_hands < waiting) & ~jnp.any(seen.counters == dynamics.DISH)


def useful_dishes(layout: Layout, transition: Transition) -> jax.Array:
    """Returns whether each player took a useful dish from the dispenser, bool [agent]."""
    interaction = transition.interactions
    useful = jnp.stack(
        [
            dish_is_useful(layout, transition.before, seen)
            for seen in (transition.before, transition.between)
        ]
    )
    took_dish = interaction.item == dynamics.DISH
    return useful & took_dish & (interaction.change == dynamics.TAKEN_FROM_DISPENSER)


def reference_shaping(layout: Layout, transition: Transition) -> jax.Array:
    """Returns overcooked-ai's shaped reward, float32 [agent].

    Source: `OvercookedGridworld.resolve_interacts`, overcooked-ai 1.1.0, default parameters.
    """
    change = transition.interactions.change
    return (
        3.0 * (change == dynamics.POTTED)
        + 3.0 * useful_dishes(layout, transition)
        + 5.0 * (change == dynamics.SOUP_TAKEN)
    )


def guided_shaping_terms(
    layout: Layout,
    transition: Transition,
    *,
    pays: jax.Array,
    hand_over: jax.Array,
    welcome: jax.Array,
    way: jax.Array,
    weights: ShapingWeights,
) -> dict[str, jax.Array]:
    """Returns our shaped reward by named term, each float32 [agent].

    Args:
        layout: the kitchen.
        transition: the step.
        pays: pay by station and content, float32 [K, content].
        hand_over: what each player earns by putting an item kind (onion, tomato, dish, soup)
            on a counter, float32 [agent, C, 4]. Taking it earns the opposite, so that nothing
            is won by putting a thing down and taking it back, whoever does it.
        welcome: how many items of each kind are welcome on the shared counters at once,
            float32 [4]; further ones are in the way.
        way: steps to the stations around the other, int32 [agent, F, F, K].
        weights: the terms' weights.
    """
    did = transition.interactions
    soup_values = jnp.max(pays, axis=0)
    reachable = reachable_values(soup_values)
    ingredient = jnp.where(did.item == dynamics.ONION, 4, 1)
    potted = did.change == dynamics.POTTED
    # The content index is clipped by XLA where nothing was potted.
    viable = reachable[jnp.minimum(did.content + ingredient, NUM_CONTENTS - 1)] > 0
    complete = soup_values[did.content] > 0
    started = did.change == dynamics.COOKING_STARTED
    taken = did.change == dynamics.SOUP_TAKEN
    delivered = did.change == dynamics.DELIVERED
    # An ego that cannot see the order has to try: only what no order accepts is fined.
    nonsense = delivered & ~jnp.isin(did.item - dynamics.SOUP, np.array(layout.orders))

    counter = jnp.minimum(did.station, layout.num_counters - 1)
    kind = jnp.clip(did.item, 1, dynamics.SOUP) - 1
    put = did.change == dynamics.PUT_ON_COUNTER
    picked = did.change == dynamics.TAKEN_FROM_COUNTER
    shared = jnp.any(hand_over != 0, axis=(0, 2))
    lying = jnp.stack([transition.before.counters, transition.between.counters])
    alike = (jnp.clip(lying, 0, dynamics.SOUP) - 1 == kind[:, None]) & shared
    # The item itself counts among those that lie there before it is taken, not before it is put.
    others = jnp.sum(alike, axis=1) - picked
    value = hand_over[np.arange(2), counter, kind]
    crowded = shared[counter] & (others >= welcome[kind])
    value = jnp.where(crowded, jnp.minimum(value, IN_THE_WAY), value)
    return {
        "potting": weights.potting * (potted & viable),
        "spoilt": weights.spoilt * (potted & ~viable),
        "dish": weights.dish * useful_dishes(layout, transition),
        "start_full": weights.start_full * (started & complete),
        "soup_taken": weights.soup_taken * (taken & complete),
        "unordered_soup_taken": weights.unordered_soup_taken * (taken & ~complete),
        "unordered_delivery": weights.unordered_delivery * nonsense,
        "hand_over": weights.hand_over * value * (put.astype(jnp.float32) - picked),
        "way": weights.way
        * jnp.full(
            2,
            clear_way(layout, transition.after, pays, way)
            - clear_way(layout, transition.before, pays, way),
        ),
        "bring": weights.bring
        * (
            brought_near(layout, transition.after, pays, way)
            - brought_near(layout, transition.before, pays, way)
        ),
    }


def clear_way(layout: Layout, state: State, pays: jax.Array, way: jax.Array) -> jax.Array:
    """Returns how near carriers are to where their load is wanted, float32 [], >= 0.

    A dish is wanted at a pot that cooks or is ready, a soup where it pays; a carrier whom the
    other blocks counts as far away. Summed over both players, so that its change in a step is
    a potential-based reward (Ng et al., 1999) for walking there and for giving way alike.
    """
    kinds = np.array(list(layout.station_kinds))
    pots, serving = np.flatnonzero(kinds == "P"), np.flatnonzero(kinds == "S")
    steps = _steps_to_stations(state, way)
    wants_dish = state.pot_timer >= 0
    content = jnp.maximum(state.held - dynamics.SOUP, 0)
    wants_soup = pays[serving][:, content].T > 0
    holds_dish = state.held == dynamics.DISH
    wanted = jnp.concatenate([holds_dish[:, None] & wants_dish, wants_soup], axis=1)
    nearest = jnp.min(jnp.where(wanted, steps[:, np.r_[pots, serving]], paths.REACH), axis=1)
    return jnp.sum(paths.REACH - nearest).astype(jnp.float32)


def brought_near(layout: Layout, state: State, pays: jax.Array, way: jax.Array) -> jax.Array:
    """How near each player is with an ingredient to a pot that takes it, float32 [agent], >= 0.

    A pot takes what, added to its content, can still become a soup that pays. The change in a
    step is a potential-based reward (Ng et al., 1999).
    """
    pots = np.flatnonzero(np.array(list(layout.station_kinds)) == "P")
    steps = _steps_to_stations(state, way)[:, pots]
    holds = (state.held == dynamics.ONION) | (state.held == dynamics.TOMATO)
    ingredient = jnp.where(state.held == dynamics.ONION, 4, 1)
    becomes = jnp.minimum(state.pot_content + ingredient[:, None], NUM_CONTENTS - 1)
    useful = reachable_values(jnp.max(pays, axis=0))[becomes] > 0
    room = (state.pot_timer < 0) & (dynamics.num_ingredients(state.pot_content) < 3)
    nearest = jnp.min(jnp.where(holds[:, None] & useful & room, steps, paths.REACH), axis=1)
    return (paths.REACH - nearest).astype(jnp.float32)


def _steps_to_stations(state: State, way: jax.Array) -> jax.Array:
    """Steps of each player to each station around the other, int32 [agent, K]."""
    return way[np.arange(2), state.cell[::-1], state.cell]
