"""A kitchen whose pots and counters are markets: the relaxation behind the upper bounds.

Each player moves by the real rules, and the two collide as in the game. But a pot or a counter
takes and gives anything at any time; only by the end of the game must each have been given what
it gave away. Prices of these goods turn that last condition into pay, and then nothing but the
two players' places and hands is left to plan over.
"""

import dataclasses

import numpy as np

from envs.overcooked import layouts
from envs.overcooked.dynamics import ONION, STAY, TOMATO
from envs.overcooked.layouts import Layout
from envs.overcooked.styles import Style

HANDS = ("nothing", "ingredient", "dish", "soup")
EMPTY, WITH_INGREDIENT, WITH_DISH, WITH_SOUP = range(len(HANDS))
NUM_HANDS = len(HANDS)
MOVES = STAY + 1
"""North, south, east, west, and to stay."""
MAX_TRADES = 3
"""Most trades at one place with the same hands: an empty-handed player at a counter."""


@dataclasses.dataclass(frozen=True, eq=False)
class Order:
    """What pays, in the relaxation: soups of `size` ingredients of the useful kinds.

    Attributes:
        items: item codes of the ingredients that occur in a paying soup.
        size: ingredients of the smallest paying soup.
        pays: what a soup brings at best at each station, float [K].
    """

    items: tuple[int, ...]
    size: int
    pays: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Walker:
    """One player's places: a floor cell and the station faced from it, if it may be used.

    Attributes:
        cell: floor cell of each place, int [Q].
        face: station faced, K for none that may be used, int [Q].
        arrive: place after each of the five moves (the fifth is to stay), int [Q, 5].
        remain: the same if the way is blocked by the other player, int [Q, 5].
        start: the first place.
    """

    cell: np.ndarray
    face: np.ndarray
    arrive: np.ndarray
    remain: np.ndarray
    start: int


@dataclasses.dataclass(frozen=True, eq=False)
class Trades:
    """What a player's interactions change; axes [place, hands, trade].

    Attributes:
        hands: hands afterwards; the same hands where there is no trade, int.
        possible: whether there is such a trade, bool.
        pay: team reward, float.
        goods: what is given to (+) and taken from (-) each good, float [..., good].
        pot: pot in which an ingredient is put or from which a soup is taken, -1 for none, int.
    """

    hands: np.ndarray
    possible: np.ndarray
    pay: np.ndarray
    goods: np.ndarray
    pot: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Market:
    """A kitchen and style as a market.

    Attributes:
        good_names: names of the goods, such as `pot 0: ingredient` or `counter 3: dish`.
        walkers: the ego's and the partner's places.
        trades: and what they can do there.
        following: place of both (ego's * Q_partner + partner's) after both moves, int
            [Q_ego * Q_partner, 5 * 5].
    """

    layout: Layout
    order: Order
    good_names: tuple[str, ...]
    walkers: tuple[Walker, Walker]
    trades: tuple[Trades, Trades]
    following: np.ndarray

    @property
    def num_pots(self) -> int:
        """Number of pots."""
        return self.layout.num_pots


def build_market(layout: Layout, style: Style, *, old_dynamics: bool = False) -> Market:
    """Makes the market of a kitchen and a style.

    Args:
        layout: the kitchen.
        style: the partner's style.
        old_dynamics: pots start by themselves.
    """
    order = _read_order(layout, np.asarray(style.pays))
    cells, targets, start = (np.asarray(a) for a in (style.cells, style.targets, style.start))
    ego, partner = (
        _build_walker(layout, cells[agent], targets[agent], int(start[agent])) for agent in (0, 1)
    )
    goods = _good_names(layout)
    of_ego, of_partner = (
        _build_trades(layout, order, walker, goods, old_dynamics) for walker in (ego, partner)
    )
    return Market(
        layout=layout,
        order=order,
        good_names=goods,
        walkers=(ego, partner),
        trades=(of_ego, of_partner),
        following=_following(ego, partner),
    )


def _good_names(layout: Layout) -> tuple[str, ...]:
    pots = [
        f"pot {pot}: {good}"
        for pot in range(layout.num_pots)
        for good in ("ingredient", "start", "turn")
    ]
    counters = [
        f"counter {counter}: {item}" for counter in range(layout.num_counters) for item in HANDS[1:]
    ]
    return (*pots, *counters)


def _read_order(layout: Layout, pays: np.ndarray) -> Order:
    serving = layout.kinds[:-1] == layouts.SERVING
    paying = np.flatnonzero((pays[serving] > 0).any(axis=0))
    if not paying.size:
        raise ValueError(f"no soup pays in kitchen {layout.name!r}; give the style an order")
    items = [ONION] * bool((paying >> 2).any()) + [TOMATO] * bool((paying & 3).any())
    return Order(
        items=tuple(items),
        size=int(((paying >> 2) + (paying & 3)).min()),
        pays=np.where(serving, pays.max(axis=1), 0.0),
    )


def _build_walker(layout: Layout, cells: np.ndarray, targets: np.ndarray, start: int) -> Walker:
    """All places that a player reaches when the other is never in its way."""
    none = len(layout.stations)
    usable = np.append(targets, False)

    def faced(cell: int, direction: int) -> int:
        station = int(layout.facing[cell, direction])
        return station if usable[station] else none

    index = {(start, faced(start, 0)): 0}
    places = list(index)
    arrive, remain = [], []

    def number(cell: int, face: int) -> int:
        if (cell, face) not in index:
            index[cell, face] = len(places)
            places.append((cell, face))
        return index[cell, face]

    # `places` grows while it is read.
    for here, (cell, _) in enumerate(places):
        there = [int(layout.neighbour[cell, direction]) for direction in range(4)]
        there = [other if cells[other] else cell for other in there]
        arrive.append([number(there[d], faced(there[d], d)) for d in range(4)] + [here])
        remain.append([number(cell, faced(cell, d)) for d in range(4)] + [here])
    return Walker(
        cell=np.array([cell for cell, _ in places]),
        face=np.array([face for _, face in places]),
        arrive=np.array(arrive),
        remain=np.array(remain),
        start=0,
    )


def _build_trades(
    layout: Layout, order: Order, walker: Walker, goods: tuple[str, ...], old_dynamics: bool
) -> Trades:
    shape = (len(walker.cell), NUM_HANDS, MAX_TRADES)
    hands = np.broadcast_to(np.arange(NUM_HANDS)[:, None], shape).copy()
    possible, pot = np.zeros(shape, bool), np.full(shape, -1)
    pay, change = np.zeros(shape), np.zeros((*shape, len(goods)))
    for place, station in enumerate(walker.face):
        for before, after, pays, given in _trades_at(layout, order, int(station), old_dynamics):
            slot = (place, before, int(possible[place, before].sum()))
            hands[slot], possible[slot], pay[slot] = after, True, pays
            for good, amount in given.items():
                change[slot][goods.index(good)] = amount
            if layout.kinds[station] == layouts.POT:
                pot[slot] = station - layout.num_counters
    return Trades(hands=hands, possible=possible, pay=pay, goods=change, pot=pot)


def _trades_at(
    layout: Layout, order: Order, station: int, old_dynamics: bool
) -> list[tuple[int, int, float, dict[str, float]]]:
    """Hands before and after, the pay, and what each good gains."""
    kind = int(layout.kinds[station])
    if kind == layouts.COUNTER:
        items = [(hand, f"counter {station}: {HANDS[hand]}") for hand in range(1, NUM_HANDS)]
        put = [(hand, EMPTY, 0.0, {good: 1.0}) for hand, good in items]
        return put + [(EMPTY, hand, 0.0, {good: -1.0}) for hand, good in items]
    if kind == layouts.POT:
        pot = f"pot {station - layout.num_counters}"
        soup = {f"{pot}: ingredient": -float(order.size), f"{pot}: turn": -1.0}
        if old_dynamics:
            return [
                (WITH_INGREDIENT, EMPTY, 0.0, {f"{pot}: ingredient": 1.0}),
                (WITH_DISH, WITH_SOUP, 0.0, soup),
            ]
        return [
            (WITH_INGREDIENT, EMPTY, 0.0, {f"{pot}: ingredient": 1.0}),
            (EMPTY, EMPTY, 0.0, {f"{pot}: start": 1.0}),
            (WITH_DISH, WITH_SOUP, 0.0, {**soup, f"{pot}: start": -1.0}),
        ]
    if kind == layouts.DISHES:
        return [(EMPTY, WITH_DISH, 0.0, {})]
    if kind in (layouts.ONIONS, layouts.TOMATOES):
        item = ONION if kind == layouts.ONIONS else TOMATO
        return [(EMPTY, WITH_INGREDIENT, 0.0, {})] if item in order.items else []
    if kind == layouts.SERVING and order.pays[station] > 0:
        return [(WITH_SOUP, EMPTY, float(order.pays[station]), {})]
    return []


def _following(ego: Walker, partner: Walker) -> np.ndarray:
    """Where both are after both moves: if they would collide or swap, neither moves."""
    width = len(partner.cell)
    old = ego.cell[:, None, None, None], partner.cell[None, :, None, None]
    new = (
        ego.cell[ego.arrive][:, None, :, None],
        partner.cell[partner.arrive][None, :, None, :],
    )
    blocked = (new[0] == new[1]) | ((new[0] == old[1]) & (new[1] == old[0]))
    after = np.where(
        blocked,
        ego.remain[:, None, :, None] * width + partner.remain[None, :, None, :],
        ego.arrive[:, None, :, None] * width + partner.arrive[None, :, None, :],
    )
    return after.reshape(-1, MOVES * MOVES)
