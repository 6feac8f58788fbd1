"""What happened: named events by kind and place, and overcooked-ai's own event log.

Each player causes at most one interaction event and exactly one region event a step, so
an event vector is two one-hot codes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs.overcooked import dynamics, layouts, reward
from envs.overcooked.dynamics import State, Transition
from envs.overcooked.layouts import Layout

ITEM_KINDS = ("onion", "tomato", "dish", "soup")
RECIPES = ("onion_soup", "tomato_soup", "other_soup")


@dataclasses.dataclass(frozen=True, eq=False)
class EventTable:
    """Which event an interaction or a step in a region is.

    Attributes:
        names: names of the events, E of them.
        of_interaction: event of (station, change, variant), E where there is none,
            int32 [K + 1, change, variant]; the variant is the item kind, or the recipe of a
            delivered soup.
        of_cell: event of standing on a floor cell, int32 [F].
    """

    names: tuple[str, ...]
    of_interaction: np.ndarray
    of_cell: np.ndarray


def region_name(layout: Layout, x: float, y: float) -> str:
    """Names the part of the kitchen that (x, y) lies in, such as `upper_left`."""
    columns, rows = (layout.width - 1) / 2, (layout.height - 1) / 2
    vertical = ("upper", "", "lower")[int(np.sign(y - rows)) + 1]
    horizontal = ("left", "", "right")[int(np.sign(x - columns)) + 1]
    return "_".join(part for part in (vertical, horizontal) if part) or "centre"


def station_places(layout: Layout) -> list[str]:
    """Names each station's place: by region, or numbered from the left where regions clash.

    A station that is the only one of its kind needs no place and gets an empty name;
    counters always get their region.
    """
    places = [region_name(layout, x, y) for x, y in layout.stations]
    for kind in range(1, layouts.NOTHING):
        of_kind = [int(i) for i in np.flatnonzero(layout.kinds[:-1] == kind)]
        names = [_short_place(layout, of_kind, i) for i in of_kind]
        if len(set(names)) < len(names):
            order = sorted(of_kind, key=lambda i: tuple(layout.stations[i]))
            names = [str(order.index(i) + 1) for i in of_kind]
        for i, name in zip(of_kind, names, strict=True):
            places[i] = name
    return places


def _short_place(layout: Layout, of_kind: list[int], station: int) -> str:
    """The shortest of "", left/right, upper/lower, upper_left… that tells stations apart."""
    if len(of_kind) == 1:
        return ""
    full = {i: region_name(layout, *layout.stations[i]).split("_") for i in of_kind}
    for wanted in ({"left", "right"}, {"upper", "lower"}):
        short = {i: [part for part in full[i] if part in wanted] for i in of_kind}
        if all(short.values()) and len({tuple(p) for p in short.values()}) == len(of_kind):
            return short[station][0]
    return "_".join(full[station])


def build_event_table(layout: Layout) -> EventTable:
    """Lists the events of a kitchen and where each comes from."""
    names: list[str] = []
    num_stations = len(layout.stations)
    of_interaction = np.full((num_stations + 1, 8, 4), -1, np.int32)

    def event(name: str) -> int:
        if name not in names:
            names.append(name)
        return names.index(name)

    items = [kind for kind in ITEM_KINDS if kind != "tomato" or layout.has_tomatoes]
    for station, place in enumerate(station_places(layout)):
        at = f"@{place}" if place else ""
        table = of_interaction[station]
        kind = layout.kinds[station]
        if kind == layouts.COUNTER:
            for item in items:
                variant = ITEM_KINDS.index(item)
                table[dynamics.PUT_ON_COUNTER, variant] = event(f"put_{item}{at}")
                table[dynamics.TAKEN_FROM_COUNTER, variant] = event(f"take_{item}{at}")
        elif kind == layouts.POT:
            for item in items[:-2]:
                table[dynamics.POTTED, ITEM_KINDS.index(item)] = event(f"pot_{item}{at}")
            table[dynamics.COOKING_STARTED] = event(f"start_cooking{at}")
            table[dynamics.SOUP_TAKEN] = event(f"take_soup_from_pot{at}")
        elif kind == layouts.SERVING:
            recipes = RECIPES if layout.has_tomatoes else ("onion_soup", "other_soup")
            for recipe in recipes:
                table[dynamics.DELIVERED, RECIPES.index(recipe)] = event(f"deliver_{recipe}{at}")
        else:
            item = ITEM_KINDS[kind - layouts.ONIONS]
            table[dynamics.TAKEN_FROM_DISPENSER] = event(f"pickup_{item}{at}")
    of_cell = np.array([event(f"stand@{region_name(layout, x, y)}") for x, y in layout.floor])
    of_interaction[of_interaction < 0] = len(names)
    return EventTable(tuple(names), of_interaction, of_cell.astype(np.int32))


def count_events(table: EventTable, transition: Transition) -> jax.Array:
    """Returns how often each event happened in this step, float32 [agent, event]."""
    did = transition.interactions
    content = jnp.maximum(did.item - dynamics.SOUP, 0)
    recipe = jnp.where(content == 12, 0, jnp.where(content == 3, 1, 2))
    item_kind = jnp.clip(did.item, 1, dynamics.SOUP) - 1
    variant = jnp.where(did.change == dynamics.DELIVERED, recipe, item_kind)
    interaction = jnp.asarray(table.of_interaction)[did.station, did.change, variant]
    region = jnp.asarray(table.of_cell)[transition.after.cell]
    events = np.arange(len(table.names))
    hit = (interaction[:, None] == events) | (region[:, None] == events)
    return hit.astype(jnp.float32)


REFERENCE_EVENTS = (
    *("tomato_pickup", "useful_tomato_pickup", "tomato_drop", "useful_tomato_drop"),
    "potting_tomato",
    *("onion_pickup", "useful_onion_pickup", "onion_drop", "useful_onion_drop"),
    "potting_onion",
    *("dish_pickup", "useful_dish_pickup", "dish_drop", "useful_dish_drop"),
    *("soup_pickup", "soup_delivery", "soup_drop"),
    *("optimal_onion_potting", "optimal_tomato_potting"),
    *("viable_onion_potting", "viable_tomato_potting"),
    *("catastrophic_onion_potting", "catastrophic_tomato_potting"),
    *("useless_onion_potting", "useless_tomato_potting"),
)


def reference_events(layout: Layout, transition: Transition) -> dict[str, jax.Array]:
    """Returns overcooked-ai's event log of this step, each bool [agent].

    The reference's quirk is kept: taking a tomato from a dispenser logs nothing. Source:
    `log_object_pickup`, `log_object_drop` and `log_object_potting` of overcooked-ai 1.1.0.
    """
    did = transition.interactions
    pots = transition.before
    full = (pots.pot_timer >= 0) | (dynamics.num_ingredients(pots.pot_content) == 3)
    all_full, none_full = jnp.all(full), ~jnp.any(full)
    seen: tuple[State, State] = (transition.before, transition.between)
    other_held = jnp.stack([seen[agent].held[1 - agent] for agent in (0, 1)])
    dish_useful = jnp.stack([reward.dish_is_useful(layout, pots, s) for s in seen])
    pickup_useful = ~all_full | (other_held == dynamics.DISH)
    drop_useful = all_full & (other_held != dynamics.DISH)
    dish_drop_useful = none_full & (other_held != dynamics.ONION)

    dispensed = did.change == dynamics.TAKEN_FROM_DISPENSER
    taken = did.change == dynamics.TAKEN_FROM_COUNTER
    put = did.change == dynamics.PUT_ON_COUNTER
    potted = did.change == dynamics.POTTED
    from_pot = did.change == dynamics.SOUP_TAKEN
    items = {
        "onion": did.item == dynamics.ONION,
        "tomato": did.item == dynamics.TOMATO,
        "dish": did.item == dynamics.DISH,
        "soup": did.item >= dynamics.SOUP,
    }
    log = {f"{name}_drop": put & held for name, held in items.items()}
    log |= {
        "onion_pickup": (dispensed | taken) & items["onion"],
        "tomato_pickup": taken & items["tomato"],
        "dish_pickup": (dispensed | taken) & items["dish"],
        "soup_pickup": (taken | from_pot) & items["soup"],
        "soup_delivery": did.change == dynamics.DELIVERED,
        "potting_onion": potted & items["onion"],
        "potting_tomato": potted & items["tomato"],
    }
    log["useful_dish_pickup"] = log["dish_pickup"] & dish_useful
    log["useful_dish_drop"] = log["dish_drop"] & dish_drop_useful
    reachable = reward.reachable_values(jnp.asarray(reward.order_values(layout.orders)))
    after = did.content + jnp.where(items["onion"], 4, 1)
    old_value = reachable[did.content]
    new_value = reachable[jnp.minimum(after, reward.NUM_CONTENTS - 1)]
    outcomes = {
        "optimal": old_value == new_value,
        "viable": new_value > 0,
        "catastrophic": (old_value > 0) & (new_value == 0),
        "useless": old_value == 0,
    }
    for name in ("onion", "tomato"):
        log[f"useful_{name}_pickup"] = log[f"{name}_pickup"] & pickup_useful
        log[f"useful_{name}_drop"] = log[f"{name}_drop"] & drop_useful
        for outcome, holds in outcomes.items():
            log[f"{outcome}_{name}_potting"] = potted & items[name] & holds
    return log
