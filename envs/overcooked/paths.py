"""How far it is to a station while the other player stands in the way."""

import numpy as np

from envs.overcooked.layouts import Layout

REACH = 12
"""Longer ways, and ways that the other player blocks, count as this many steps."""


def steps_around(layout: Layout, cells: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Counts the steps from each cell to each station, around the other player.

    Args:
        layout: the kitchen.
        cells: floor cells that the walking player may enter, bool [F].
        targets: stations that it may use, bool [K].

    Returns:
        Steps to a cell beside the station, int [F, F, K] by the other's cell, the walker's cell
        and the station; `REACH` where that is further, blocked or forbidden.
    """
    size = len(layout.floor)
    beside = np.stack([layout.stations_beside(np.arange(size) == cell) for cell in range(size)])
    steps = np.full((size, size, len(layout.stations)), REACH)
    for other in range(size):
        free = cells & (np.arange(size) != other)
        goals = beside & free[:, None] & targets
        reached = goals.copy()
        steps[other][reached] = 0
        for distance in range(1, REACH):
            # A step leads from any cell to a neighbour that is free.
            following = reached[layout.neighbour] & free[layout.neighbour][..., None]
            new = following.any(axis=1) & ~reached
            steps[other][new] = distance
            reached |= new
    return steps
