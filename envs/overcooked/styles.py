"""The partners' styles of the four kitchens, as arrays (App. C.2 of the paper).

A style says where the partner may stand, what it may use, which soups pay where, and, for
training only, the role that the ego is meant to take and what is worth handing over.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.overcooked import dynamics, events, moments, paths, reward
from envs.overcooked.dynamics import State
from envs.overcooked.layouts import Layout

FREE_STYLE = "free"
"""The only style of the classic kitchens: nothing is forbidden."""

ITEM_KINDS = events.ITEM_KINDS


class Style(PyTreeNode):
    """One partner style; all styles of a kitchen stack into one pytree.

    Attributes:
        cells: floor cells that each player may enter, bool [agent, F].
        targets: stations that each player may interact with, bool [agent, K].
        role_cells: floor cells of the ego's intended role, bool [F]; training only.
        role_targets: stations of that role, bool [K]; training only.
        start: start cells, int32 [agent].
        pays: what a soup pays by serving cell and content, float32 [K, content].
        task: what the partner is told about the order, float32 [task]; empty in kitchens
            where every style serves the same order.
        hand_over: what each player earns by putting an item kind on a counter, float32
            [agent, C, 4]; training only.
        welcome: how many items of each kind are welcome on the shared counters at once,
            float32 [4]; training only.
        way: steps of each player to each station around the other (`paths.steps_around`),
            int32 [agent, other's cell, own cell, K]; training only.
        pool: moments of games to start from in training, `State` with leading axis [pool];
            the first is the usual start.
    """

    cells: jax.Array
    targets: jax.Array
    role_cells: jax.Array
    role_targets: jax.Array
    start: jax.Array
    pays: jax.Array
    task: jax.Array
    hand_over: jax.Array
    welcome: jax.Array
    way: jax.Array
    pool: State


@dataclasses.dataclass(frozen=True)
class Rule:
    """A style in terms of coordinates and letters.

    Attributes:
        stand: whether the partner may stand on (x, y).
        use: whether the partner may use a station of a kind letter at (x, y).
        role: whether the ego's role includes the floor cell (x, y).
        role_use: whether the ego's role includes a station.
        gives: item kinds that each player must hand to the other over a counter.
        start: (x, y) of both players, where the layout's own does not fit.
        order: content and number of the serving cell from the left, if only that pays.
    """

    stand: Callable[[int, int], bool] = lambda x, y: True
    use: Callable[[str, int, int], bool] = lambda kind, x, y: True
    role: Callable[[int, int], bool] = lambda x, y: True
    role_use: Callable[[str, int, int], bool] = lambda kind, x, y: True
    gives: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    start: tuple[tuple[int, int] | None, tuple[int, int] | None] = (None, None)
    order: tuple[int, int] | None = None


def _center_pots() -> dict[str, Rule]:
    left, right = (lambda x, y: x <= 2), (lambda x, y: x >= 4)
    upper, lower = (lambda x, y: y == 1), (lambda x, y: y == 3)
    rules = {
        "left": Rule(stand=left, role=right),
        "right": Rule(stand=right, role=left),
        "upper": Rule(stand=upper, role=lower),
        "lower": Rule(stand=lower, role=upper),
    }
    for row, inside, opposite in (("upper", upper, lower), ("lower", lower, upper)):
        for side, columns in (("left", (1, 2)), ("right", (4, 5))):
            rules[f"{row}_{side}"] = Rule(
                stand=lambda x, y, inside=inside, columns=columns: inside(x, y) and x in columns,
                role=opposite,
            )
    return rules


def _crossway() -> dict[str, Rule]:
    def vertical(row: str) -> Callable[[int, int], bool]:
        return lambda x, y: x == 3 and (y <= 3 if row == "upper" else y >= 3)

    def horizontal(side: str) -> Callable[[int, int], bool]:
        return lambda x, y: y == 3 and (x <= 3 if side == "left" else x >= 3)

    def either(*tests: Callable[[int, int], bool]) -> Callable[[int, int], bool]:
        return lambda x, y: any(test(x, y) for test in tests)

    opposite = {"upper": "lower", "lower": "upper", "left": "right", "right": "left"}
    arm_end = {"upper": (3, 1), "lower": (3, 5), "left": (1, 3), "right": (5, 3)}
    rules = {}
    for row in ("upper", "lower"):
        for side in ("left", "right"):
            rules[f"{row}_{side}"] = Rule(
                stand=either(vertical(row), horizontal(side)),
                role=either(vertical(opposite[row]), horizontal(opposite[side])),
            )
    for row in ("upper", "lower"):
        rules[f"{row}_no_dish"] = Rule(
            stand=either(vertical(row), lambda x, y: y == 3 and x in (2, 4)),
            use=lambda kind, x, y: kind != "D",
            # The soups wait at the partner's end, so the ego's role is a task, not a place.
            role_use=lambda kind, x, y: kind != "O",
            start=(arm_end[opposite[row]], arm_end[row]),
        )
    for side in ("left", "right"):
        rules[f"deliver_{side}"] = Rule(
            stand=either(vertical("upper"), vertical("lower"), horizontal(side)),
            use=lambda kind, x, y: kind != "O",
            role=either(vertical("upper"), vertical("lower"), horizontal(opposite[side])),
            role_use=lambda kind, x, y: kind not in "DS",
            start=(None, arm_end[side]),
        )
    return rules


def _diverse_coordination() -> dict[str, Rule]:
    lacks = {
        "no_onion": ("O", (("onion",), ())),
        "no_dish": ("D", (("dish",), ())),
        "no_onion_no_dish": ("OD", (("onion", "dish"), ())),
        "no_delivery": ("S", ((), ("soup",))),
    }
    rules = {}
    for what in ("no_onion", "no_dish", "no_onion_no_dish", "no_delivery"):
        letters, gives = lacks[what]
        for side, near, counters in (
            ("left", lambda x: x <= 4, (1, 2, 3)),
            ("right", lambda x: x >= 4, (5, 6, 7)),
        ):

            def on_side(kind, x, y, near=near, counters=counters):
                return x in counters if y == 2 else near(x)

            rules[f"{side}_{what}"] = Rule(
                stand=lambda x, y, near=near: near(x),
                use=lambda kind, x, y, on_side=on_side, letters=letters: (
                    on_side(kind, x, y) and kind not in letters
                ),
                role=lambda x, y, near=near: y > 1 or near(x),
                role_use=on_side,
                gives=gives,
            )
    order = ("no_onion", "no_dish", "no_onion_no_dish", "no_delivery")
    return {
        f"{side}_{what}": rules[f"{side}_{what}"] for side in ("left", "right") for what in order
    }


def _diverse_orders() -> dict[str, Rule]:
    return {
        f"{ingredient}_{number}": Rule(gives=((), ("dish", "soup")), order=(content, number))
        for ingredient, content in (("onion", 12), ("tomato", 3))
        for number in (1, 2, 3, 4)
    }


RULES: dict[str, Callable[[], dict[str, Rule]]] = {
    "center_pots": _center_pots,
    "crossway": _crossway,
    "diverse_coordination": _diverse_coordination,
    "diverse_orders": _diverse_orders,
}


def style_rules(layout: Layout) -> dict[str, Rule]:
    """Returns the kitchen's styles by name, in the paper's order."""
    return RULES[layout.name]() if layout.name in RULES else {FREE_STYLE: Rule()}


def build_style(layout: Layout, rule: Rule, *, max_steps: int) -> Style:
    """Turns a rule into arrays.

    Args:
        layout: the kitchen.
        rule: the style.
        max_steps: length of a game.
    """
    floor = [(int(x), int(y)) for x, y in layout.floor]
    stations = [
        (kind, int(x), int(y))
        for kind, (x, y) in zip(layout.station_kinds, layout.stations, strict=True)
    ]
    partner_cells = np.array([rule.stand(x, y) for x, y in floor])
    role_cells = np.array([rule.role(x, y) for x, y in floor])
    partner_targets = np.array([rule.use(*station) for station in stations])
    role_targets = np.array([rule.role_use(*station) for station in stations])
    start = _start_cells(layout, rule, role_cells, partner_cells)
    shared = _shared_counters(layout, start, partner_cells, partner_targets)
    hand_over = _hand_over_worth(rule, shared)
    task = np.zeros(0, np.float32)
    pays = np.tile(reward.order_values(layout.orders, layout.soup_reward), (len(stations), 1))
    if rule.order is not None:
        content, number = rule.order
        serving = [i for i, (kind, _, _) in enumerate(stations) if kind == "S"]
        paying = sorted(serving, key=lambda i: stations[i][1])[number - 1]
        ordered = reward.order_values((content,), layout.soup_reward)
        pays = np.where(np.arange(len(stations))[:, None] == paying, ordered, 0.0)
        task = np.zeros(2 + len(serving), np.float32)
        task[[0 if content == 12 else 1, 1 + number]] = 1
    wanted = tuple(int(content) for content in np.flatnonzero(pays.max(axis=0)))
    codes: dict[str, tuple[int, ...]] = {
        "onion": (dynamics.ONION,),
        "tomato": (dynamics.TOMATO,),
        "dish": (dynamics.DISH,),
        "soup": tuple(dynamics.SOUP + content for content in layout.orders),
    }
    needed = tuple(code for kinds in rule.gives for kind in kinds for code in codes[kind])
    situation = moments.Situation(
        start=start,
        cells=np.stack(
            [role_cells & _room(layout, start[0]), partner_cells & _room(layout, start[1])]
        ),
        shared=shared,
        needed=needed,
        wanted=wanted,
        max_steps=max_steps,
    )
    arrays: dict[str, Any] = {
        "cells": np.stack([np.ones_like(partner_cells), partner_cells]),
        "targets": np.stack([np.ones_like(partner_targets), partner_targets]),
        "role_cells": role_cells,
        "role_targets": role_targets,
        "start": start,
        "pays": pays.astype(np.float32),
        "task": task,
        "hand_over": hand_over,
        "welcome": _welcome_items(rule),
        "way": np.stack(
            [
                paths.steps_around(layout, np.ones_like(partner_cells), np.ones_like(role_targets)),
                paths.steps_around(layout, partner_cells, partner_targets),
            ]
        ).astype(np.int32),
        "pool": moments.draw_pool(layout, situation),
    }
    return jax.tree.map(jnp.asarray, Style(**arrays))


def confine(style: Style) -> Style:
    """Returns the style with the ego held to its role (a curriculum, training only)."""
    partner_cells, partner_targets = style.cells[1], style.targets[1]
    return style.replace(
        cells=jnp.stack([style.role_cells, partner_cells]),
        targets=jnp.stack([style.role_targets, partner_targets]),
    )


def _room(layout: Layout, cell: int) -> np.ndarray:
    """The floor cells that can be walked to from a cell, bool [F]."""
    room = np.arange(len(layout.floor)) == cell
    while True:
        reached = room.copy()
        reached[layout.neighbour[room].ravel()] = True
        if (reached == room).all():
            return room
        room = reached


def _start_cells(
    layout: Layout, rule: Rule, role_cells: np.ndarray, partner_cells: np.ndarray
) -> np.ndarray:
    """The rule's start cells, else the layout's, else the nearest allowed in the same room."""
    chosen: list[int] = []
    for agent, allowed in ((1, partner_cells), (0, role_cells)):
        wanted = rule.start[agent]
        cell = layout.floor_index(*wanted) if wanted else int(layout.start[agent])
        possible = allowed & _room(layout, int(layout.start[agent]))
        possible[chosen] = False
        distance = np.abs(layout.floor - layout.floor[cell]).sum(axis=1)
        chosen.append(int(np.where(possible, distance, 10**6).argmin()))
    return np.array(chosen[::-1], np.int32)


def _shared_counters(
    layout: Layout, start: np.ndarray, partner_cells: np.ndarray, partner_targets: np.ndarray
) -> np.ndarray:
    """Counters that both players reach and may use, bool [C]."""
    ego_side = layout.stations_beside(_room(layout, int(start[0])))
    partner_side = layout.stations_beside(partner_cells & _room(layout, int(start[1])))
    return (ego_side & partner_side & partner_targets)[: layout.num_counters]


def _hand_over_worth(rule: Rule, shared: np.ndarray) -> np.ndarray:
    """What putting an item kind on each counter earns, float32 [agent, C, 4].

    The giver of a needed kind earns 1 by putting it on a shared counter, and its taker 1 by
    taking it; anything else is in the way there.
    """
    worth = np.zeros((2, len(shared), 4), np.float32)
    if any(rule.gives):
        for agent in (0, 1):
            values = [
                1.0 if kind in rule.gives[agent] else reward.IN_THE_WAY for kind in ITEM_KINDS
            ]
            worth[agent, shared] = values
        # Taking is paid with the opposite sign, so what the other gives is worth -1 to put back.
        for agent in (0, 1):
            given = np.array([kind in rule.gives[1 - agent] for kind in ITEM_KINDS])
            worth[agent][shared[:, None] & given] = -1.0
    return worth


def _welcome_items(rule: Rule) -> np.ndarray:
    """Where several kinds share the counters, two ingredients and one of any other are enough."""
    kinds = {kind for given in rule.gives for kind in given}
    if len(kinds) < 2:
        return np.full(4, np.inf, np.float32)
    return np.array([2, 2, 1, 1], np.float32)
