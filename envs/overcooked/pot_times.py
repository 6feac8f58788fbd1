"""How soon and how often a pot can give a soup, at best: limits that prices cannot know.

All are lower bounds on numbers of steps: the other player is never in the way, and a counter
offers any item at any time.
"""

import dataclasses

import numpy as np

from envs.overcooked import layouts
from envs.overcooked.market import (
    EMPTY,
    WITH_DISH,
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
                "first": int(potting[walker.start, EMPTY]) - 1,
                "again": int(potting[beside, EMPTY].min()),
                "after_soup": int(potting[beside, WITH_SOUP].min()),
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


def _steps_to_pot(walker: Walker, trades: Trades, pot: int) -> np.ndarray:
    """Fewest steps until an ingredient is in the pot, by place and hands, int [Q, hands]."""
    steps = np.full(trades.possible.shape[:2], NEVER)
    goal = trades.possible & (trades.pot == pot)
    goal[:, [EMPTY, WITH_DISH, WITH_SOUP]] = False
    while True:
        after = steps[np.arange(len(steps))[:, None, None], trades.hands]
        traded = np.where(goal, 0, np.where(trades.possible, after, NEVER)).min(axis=-1)
        moved = steps[walker.arrive].min(axis=1)
        new = np.minimum(steps, 1 + np.minimum(traded, moved))
        if (new == steps).all():
            return steps
        steps = new


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
