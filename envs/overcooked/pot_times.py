"""How soon and how often a pot can give a soup, at best: limits that prices cannot know.

All are lower bounds on numbers of steps: the other player is never in the way, and a counter
offers any item at any time. But what is there at first, somebody must have brought; and where a
soup was just put, there is nothing else.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from envs.overcooked import layouts
from envs.overcooked.market import (
    EMPTY,
    WITH_DISH,
    WITH_INGREDIENT,
    WITH_SOUP,
    Market,
    Trades,
    Walker,
)

NEVER = 10**6


@dataclasses.dataclass(frozen=True)
class PotTimes:
    """When a pot can be of use in a game; steps are counted from 0.

    Attributes:
        first_soup: first step in which a soup can be taken.
        last_ingredient: last step in which an ingredient can still become a paid soup.
        turns: most soups that it can give in time to be delivered.
    """

    first_soup: int
    last_ingredient: int
    turns: int


def pot_times(market: Market, max_steps: int, *, old_dynamics: bool = False) -> list[PotTimes]:
    """Returns the limits of each pot in a game of `max_steps` steps."""
    delivery = _steps_to_deliver(market)
    return [
        _times_of(market, pot, delivery, max_steps, old_dynamics) for pot in range(market.num_pots)
    ]


def _times_of(
    market: Market,
    pot: int,
    delivery: tuple[np.ndarray, np.ndarray],
    max_steps: int,
    old_dynamics: bool,
) -> PotTimes:
    station = market.layout.num_counters + pot
    cook_time, size = market.layout.cook_time, market.order.size
    cooks = []
    taken_to_delivered = NEVER
    for agent, (walker, trades) in enumerate(zip(market.walkers, market.trades, strict=True)):
        beside = np.flatnonzero(walker.face == station)
        if not beside.size:
            continue
        potting = _steps_to_pot(walker, trades, pot)
        cooks.append(
            {
                "first": _steps_to_first_potting(market, agent, pot) - 1,
                "again": int(potting[beside, EMPTY].min()),
                "after_soup": int(_steps_after_soup(market, agent, pot)[beside].min()),
            }
        )
        taken_to_delivered = min(taken_to_delivered, int(delivery[agent][beside].min()))
    if not cooks or taken_to_delivered >= NEVER:
        return PotTimes(first_soup=NEVER, last_ingredient=-1, turns=0)
    # One cook starts the pot in the step after its last ingredient, another may in the same.
    starting = 0 if old_dynamics or len(cooks) == 2 else 1
    filled = _nth_potting([(cook["first"], cook["again"]) for cook in cooks], size)
    first_soup = filled + starting + cook_time
    refills = []
    for taker in range(len(cooks)):
        # The other may hold an ingredient ready; the taker first gets rid of the soup.
        others = [(0, cook["again"]) for index, cook in enumerate(cooks) if index != taker]
        refills.append(
            _nth_potting([*others, (cooks[taker]["after_soup"], cooks[taker]["again"])], size)
        )
    cycle = min(refills) + starting + cook_time
    last_soup = max_steps - 1 - taken_to_delivered
    turns = 0 if last_soup < first_soup else 1 + (last_soup - first_soup) // cycle
    return PotTimes(
        first_soup=first_soup,
        last_ingredient=last_soup - cook_time,
        turns=turns,
    )


def _nth_potting(cooks: list[tuple[int, int]], count: int) -> int:
    """The step of the count-th ingredient, by each cook's first step and steps between two."""
    return sorted(first + again * n for first, again in cooks for n in range(count))[count - 1]


def _steps_to_pot(
    walker: Walker, trades: Trades, pot: int, closed: Sequence[int] = ()
) -> np.ndarray:
    """Fewest steps until an ingredient is in the pot, by place and hands, int [Q, hands].

    From the stations `closed` nothing is taken, and no soup is put there.
    """
    goal = trades.possible & (trades.pot == pot)
    goal[:, [EMPTY, WITH_DISH, WITH_SOUP]] = False
    return _fewest_steps(walker, trades, goal, closed)


def _fewest_steps(
    walker: Walker, trades: Trades, goal: np.ndarray, closed: Sequence[int] = ()
) -> np.ndarray:
    """Fewest steps until one of the trades `goal` is made, by place and hands, int [Q, hands]."""
    possible = trades.possible.copy()
    shut = np.isin(walker.face, closed)
    possible[shut, EMPTY] = possible[shut, WITH_SOUP] = False
    steps = np.full(possible.shape[:2], NEVER)
    while True:
        after = steps[np.arange(len(steps))[:, None, None], trades.hands]
        traded = np.where(goal, 0, np.where(possible, after, NEVER)).min(axis=-1)
        moved = steps[walker.arrive].min(axis=1)
        new = np.minimum(steps, 1 + np.minimum(traded, moved))
        if (new == steps).all():
            return steps
        steps = new


def _steps_to_first_potting(market: Market, agent: int, pot: int) -> int:
    """Fewest steps from the start until a player puts an ingredient in the pot.

    It fetches the ingredient itself, or takes it from a counter to which the other brought it.
    """
    walker, trades = market.walkers[agent], market.trades[agent]
    other, of_other = market.walkers[1 - agent], market.trades[1 - agent]
    counters = list(range(market.layout.num_counters))
    best = int(_steps_to_pot(walker, trades, pot, closed=counters)[walker.start, EMPTY])
    potting = _steps_to_pot(walker, trades, pot)
    for counter in counters:
        beside = walker.face == counter
        if not beside.any():
            continue
        goal = _put_on(other, of_other, counter)
        brought = _fewest_steps(other, of_other, goal, closed=counters)[other.start, EMPTY]
        # It may be taken in the very step in which it was put there.
        best = min(best, int(brought + potting[beside, WITH_INGREDIENT].min()))
    return best


def _steps_after_soup(market: Market, agent: int, pot: int) -> np.ndarray:
    """Fewest steps of a player with a soup until it puts an ingredient in the pot, int [Q].

    The counter on which it puts the soup has nothing else to offer until the other player has
    taken the soup away and brought an ingredient there.
    """
    walker, trades = market.walkers[agent], market.trades[agent]
    potting = _steps_to_pot(walker, trades, pot)
    # By place: steps after the soup has been put down at the station that is faced there.
    put_down = potting[:, EMPTY].copy()
    for counter in range(market.layout.num_counters):
        beside = walker.face == counter
        if not beside.any():
            continue
        elsewhere = _steps_to_pot(walker, trades, pot, closed=[counter])[:, EMPTY]
        refilled = _steps_to_refill(market, 1 - agent, counter)
        from_there = refilled + potting[beside, WITH_INGREDIENT].min()
        put_down[beside] = np.minimum(elsewhere, from_there)[beside]
    drops = (trades.possible[:, WITH_SOUP] & (trades.hands[:, WITH_SOUP] == EMPTY)).any(axis=-1)
    steps = np.full(len(walker.cell), NEVER)
    while True:
        dropped = np.where(drops, put_down, NEVER)
        new = np.minimum(steps, 1 + np.minimum(dropped, steps[walker.arrive].min(axis=1)))
        if (new == steps).all():
            return steps
        steps = new


def _steps_to_refill(market: Market, agent: int, counter: int) -> int:
    """Fewest steps until a player has taken a soup from a counter and put an ingredient there.

    Counted from the step in which the soup was put there; it may be taken in that very step.
    """
    walker, trades = market.walkers[agent], market.trades[agent]
    beside = walker.face == counter
    if not beside.any():
        return NEVER
    bringing = _fewest_steps(walker, trades, _put_on(walker, trades, counter), closed=[counter])
    return int(bringing[beside, WITH_SOUP].min())


def _put_on(walker: Walker, trades: Trades, counter: int) -> np.ndarray:
    """The trades that put an ingredient on a counter, bool [Q, hands, trade]."""
    goal = trades.possible & (trades.hands == EMPTY)
    goal[walker.face != counter] = False
    goal[:, [EMPTY, WITH_DISH, WITH_SOUP]] = False
    return goal


def _steps_to_deliver(market: Market) -> tuple[np.ndarray, np.ndarray]:
    """Fewest further steps from holding a soup to its delivery, by player and place, int [Q].

    A soup that is put on a counter may be taken by the other player in the same step.
    """
    steps = [np.full(len(walker.cell), NEVER) for walker in market.walkers]
    while True:
        on_counter = np.full(len(market.layout.stations) + 1, NEVER)
        for walker, of_player in zip(market.walkers, steps, strict=True):
            np.minimum.at(on_counter, walker.face, of_player)
        on_counter[market.layout.kinds != layouts.COUNTER] = NEVER
        new = []
        for walker, trades, of_player in zip(market.walkers, market.trades, steps, strict=True):
            pays = (trades.pay[:, WITH_SOUP] > 0).any(axis=1)
            best = np.minimum(of_player[walker.arrive].min(axis=1), on_counter[walker.face])
            new.append(np.minimum(of_player, 1 + np.where(pays, 0, best)))
        if all((a == b).all() for a, b in zip(new, steps, strict=True)):
            return new[0], new[1]
        steps = new
