"""Prices that make the market's bound tight: any prices are valid, these are good ones.

They are those of a steady market in which the players pass through each other: a linear program
over flows, whose dual values say what one more of each good would be worth.
"""

from typing import Any

import numpy as np
from scipy import optimize, sparse

from envs.overcooked.market import NUM_HANDS, Trades, Walker
from envs.overcooked.relaxation import Relaxation

HIGHEST = 20.0
"""No good is worth more than a soup."""


def steady_prices(relaxation: Relaxation, *, endless_turns: bool = False) -> np.ndarray:
    """Prices of goods in the best steady flow, without starts, ends and collisions, float [good].

    Args:
        relaxation: the market.
        endless_turns: let the pots give soups without end. Where pots are scarce, all other
            goods are worth nothing, which is the tightest bound, but no guide to play.
    """
    market = relaxation.market
    endless = np.array([name.endswith("turn") for name in market.good_names]) & endless_turns
    flows = [
        _flows(walker, trades) for walker, trades in zip(market.walkers, market.trades, strict=True)
    ]
    pay = np.concatenate([flow[1] for flow in flows])
    goods = np.concatenate([flow[2] for flow in flows]).T
    balance = sparse.block_diag([flow[0] for flow in flows])
    rows: Any = balance.shape  # SciPy's stubs allow None.
    time = sparse.block_diag([np.ones((1, len(flow[1]))) for flow in flows])
    solved = optimize.linprog(
        -pay,
        A_ub=sparse.csr_array(-goods),
        b_ub=np.where(endless, 1e6, relaxation.allowance),
        A_eq=sparse.vstack([balance, time]).tocsr(),
        b_eq=np.concatenate([np.zeros(rows[0]), np.full(2, relaxation.max_steps)]),
        method="highs",
    )
    if solved.status != 0:
        raise RuntimeError(f"the flows of {market.layout.name} have no solution: {solved.message}")
    return np.clip(-solved.ineqlin.marginals, 0.0, HIGHEST)


def _flows(walker: Walker, trades: Trades) -> tuple[sparse.csr_array, np.ndarray, np.ndarray]:
    """A player's ways to spend a step: balance [Q * hands, way], pay [way], goods [way, good]."""
    places = len(walker.cell)
    here = np.arange(places)[:, None, None]
    hand = np.arange(NUM_HANDS)[None, :, None]
    moves = walker.arrive.shape[1]
    shape = (places, NUM_HANDS, moves)
    leave = np.broadcast_to(here * NUM_HANDS + hand, shape).ravel()
    reach = np.broadcast_to(walker.arrive[:, None, :] * NUM_HANDS + hand, shape).ravel()
    place, before, trade = np.nonzero(trades.possible)
    after = trades.hands[place, before, trade]
    leave = np.concatenate([leave, place * NUM_HANDS + before])
    reach = np.concatenate([reach, place * NUM_HANDS + after])
    ways = np.arange(len(leave))
    ones = np.ones(len(leave))
    size = (places * NUM_HANDS, len(leave))
    balance = sparse.coo_array((ones, (leave, ways)), size).tocsr()
    balance = balance - sparse.coo_array((ones, (reach, ways)), size).tocsr()
    walked = places * NUM_HANDS * moves
    pay = np.concatenate([np.zeros(walked), trades.pay[place, before, trade]])
    goods = np.zeros((len(leave), trades.goods.shape[-1]))
    goods[walked:] = trades.goods[place, before, trade]
    return balance, pay, goods
