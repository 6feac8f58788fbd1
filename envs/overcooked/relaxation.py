"""The market of a kitchen with the limits that hold at any prices: time, and each pot's turns."""

import dataclasses

import numpy as np

from envs.overcooked import pot_times
from envs.overcooked.layouts import Layout
from envs.overcooked.market import NUM_HANDS, WITH_DISH, Market, Trades, build_market
from envs.overcooked.styles import Style


@dataclasses.dataclass(frozen=True, eq=False)
class Relaxation:
    """A market with the limits that hold at any prices.

    Attributes:
        market: the market.
        max_steps: steps of a game.
        allowance: how much more may be taken from each good than is given, float [good]: a pot's
            turns, and nothing for all others.
        from_step, until_step: steps in which each trade is of use, for each player, int [Q,
            hands, trade].
    """

    market: Market
    max_steps: int
    allowance: np.ndarray
    from_step: tuple[np.ndarray, np.ndarray]
    until_step: tuple[np.ndarray, np.ndarray]


def relax(
    layout: Layout, style: Style, *, max_steps: int, old_dynamics: bool = False
) -> Relaxation:
    """Makes the relaxation of a kitchen and a style.

    Args:
        layout: the kitchen.
        style: the partner's style.
        max_steps: steps of a game.
        old_dynamics: pots start by themselves.
    """
    market = build_market(layout, style, old_dynamics=old_dynamics)
    times = pot_times.pot_times(market, max_steps, old_dynamics=old_dynamics)
    allowance = np.zeros(len(market.good_names))
    for pot, limits in enumerate(times):
        allowance[market.good_names.index(f"pot {pot}: turn")] = limits.turns
    windows = [_windows(trades, times, max_steps) for trades in market.trades]
    return Relaxation(
        market=market,
        max_steps=max_steps,
        allowance=allowance,
        from_step=(windows[0][0], windows[1][0]),
        until_step=(windows[0][1], windows[1][1]),
    )


def _windows(
    trades: Trades, times: list[pot_times.PotTimes], max_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    first = np.zeros(trades.possible.shape, int)
    last = np.where(trades.possible, max_steps, -1)
    for pot, limits in enumerate(times):
        here = trades.possible & (trades.pot == pot)
        takes = here & (np.arange(NUM_HANDS)[:, None] == WITH_DISH)
        first[takes] = limits.first_soup
        last[here & ~takes] = limits.last_ingredient
    return first, last
