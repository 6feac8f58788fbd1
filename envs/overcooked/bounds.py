"""Upper bounds on the return of a kitchen and style.

The game is relaxed to a market (`market`): plan both players' moves exactly, collisions included,
and let pots and counters balance only over the whole game. With a price for each good, what a
play earns in the market is at least what it earns in the game, whatever the prices are, as long
as none is negative: so the best play of the market bounds the game, and good prices make the
bound tight. Source of the argument: Lagrangian relaxation (Geoffrion, 1974).
"""

import numpy as np

from envs.overcooked.layouts import Layout
from envs.overcooked.market import EMPTY, MAX_TRADES, MOVES, NUM_HANDS, Trades
from envs.overcooked.prices import steady_prices
from envs.overcooked.relaxation import Relaxation, relax
from envs.overcooked.styles import Style

ROUNDING = 0.05
"""More than what 400 sums of 32 bits may lose; added before a bound is rounded down."""


def values(relaxation: Relaxation, prices: np.ndarray) -> np.ndarray:
    """What the rest of the market's game is worth at most.

    Args:
        relaxation: the market.
        prices: of each good, none negative, float [good].

    Returns:
        By steps taken, the places of both and the hands of both, float32
        [max_steps + 1, Q_ego * Q_partner, hands * hands].
    """
    market = relaxation.market
    ego, partner = (len(walker.cell) for walker in market.walkers)
    stay = MOVES - 1
    moves = np.arange(MOVES * MOVES)
    both_move = market.following[:, (moves // MOVES != stay) & (moves % MOVES != stay)]
    ego_stays = market.following[:, moves // MOVES == stay]
    partner_stays = market.following[:, moves % MOVES == stay]
    worth = [_worth(trades, prices) for trades in market.trades]
    found = np.zeros((relaxation.max_steps + 1, ego * partner, NUM_HANDS**2), np.float32)
    for step in reversed(range(relaxation.max_steps)):
        after = found[step + 1]
        # A thing that is of no use may vanish: plays with other soups are covered by this.
        after = _with_empty_hands(after)
        now = [
            np.where(
                (relaxation.from_step[a] <= step) & (step <= relaxation.until_step[a]),
                worth[a],
                -np.inf,
            ).astype(np.float32)
            for a in (0, 1)
        ]
        by_ego = after.reshape(ego, partner, NUM_HANDS, NUM_HANDS).transpose(0, 2, 1, 3)
        ego_acts = _trade_first(market.trades[0], now[0], by_ego)
        partner_acts = _trade_second(market.trades[1], now[1], by_ego)
        both_act = _trade_second(market.trades[1], now[1], ego_acts)
        best = after[both_move].max(axis=1)
        np.maximum(best, _by_place(ego_acts)[ego_stays].max(axis=1), out=best)
        np.maximum(best, _by_place(partner_acts)[partner_stays].max(axis=1), out=best)
        np.maximum(best, _by_place(both_act), out=best)
        found[step] = best
    return found


def _worth(trades: Trades, prices: np.ndarray) -> np.ndarray:
    return trades.pay + trades.goods @ prices


def _with_empty_hands(after: np.ndarray) -> np.ndarray:
    hands = after.reshape(-1, NUM_HANDS, NUM_HANDS)
    hands = np.maximum(hands, hands[:, EMPTY : EMPTY + 1, :])
    hands = np.maximum(hands, hands[:, :, EMPTY : EMPTY + 1])
    return hands.reshape(after.shape)


def _trade_first(trades: Trades, worth: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The best of the ego's trades and of none; `after` is [Q_ego, hands, Q_partner, hands]."""
    place = np.arange(len(after))[:, None]
    best = after
    for trade in range(MAX_TRADES):
        gained = worth[:, :, trade, None, None]
        best = np.maximum(best, after[place, trades.hands[:, :, trade]] + gained)
    return best


def _trade_second(trades: Trades, worth: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The same for the partner."""
    place = np.arange(after.shape[2])[:, None]
    best = after
    for trade in range(MAX_TRADES):
        gained = worth[:, :, trade]
        best = np.maximum(best, after[:, :, place, trades.hands[:, :, trade]] + gained)
    return best


def _by_place(worth: np.ndarray) -> np.ndarray:
    """[Q_ego, hands, Q_partner, hands] as [Q_ego * Q_partner, hands * hands]."""
    return worth.transpose(0, 2, 1, 3).reshape(-1, NUM_HANDS**2)


def market_bound(relaxation: Relaxation, prices: np.ndarray) -> float:
    """The best return in the market: no play of the game earns more, at any prices >= 0."""
    ego, partner = relaxation.market.walkers
    start = ego.start * len(partner.cell) + partner.start
    return float(values(relaxation, prices)[0][start, 0] + relaxation.allowance @ prices)


def whole_soups(bound: float, pays: np.ndarray) -> float:
    """Rounds a bound down to whole soups, if all that pay, pay the same."""
    paid = np.unique(pays[pays > 0])
    if len(paid) > 1:
        return bound
    return float(paid[0] * np.floor((bound + ROUNDING) / paid[0]))


def upper_bound(layout: Layout, style: Style, *, max_steps: int, old_dynamics: bool) -> float:
    """Returns a return that no two players can exceed in a kitchen with a style.

    Args:
        layout: the kitchen.
        style: the partner's style.
        max_steps: steps of a game.
        old_dynamics: pots start by themselves.
    """
    relaxation = relax(layout, style, max_steps=max_steps, old_dynamics=old_dynamics)
    bound = market_bound(relaxation, steady_prices(relaxation))
    return whole_soups(bound, np.asarray(style.pays))
