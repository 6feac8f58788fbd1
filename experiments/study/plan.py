"""Who meets which agent, and asks for what, in which order: balanced, and decided beforehand.

Conditions follow a Williams design (Williams, 1949): over its rows every condition stands at every
place equally often, and follows every other one equally often, so that neither practice nor what
was met before favours any. Participants take its rows in turn. What a participant is asked to do
is drawn so that no task comes twice before all have come.
"""

from typing import NamedTuple

import numpy as np


class Planned(NamedTuple):
    """A round to come: the agent's kind, and the number of the style that the player is to have."""

    condition: str
    style: int


def williams(count: int) -> np.ndarray:
    """A Williams design for `count` conditions, int [row, place].

    It has `count` rows where that is even, else twice as many. One condition has one row.

    Raises:
        ValueError: no conditions.
    """
    if count < 1:
        raise ValueError(f"count is {count}; expected at least one condition")
    # 0, 1, n - 1, 2, n - 2, ...: neighbours differ by every number once.
    steps = np.arange(count)
    first = np.where(steps % 2 == 1, (steps + 1) // 2, (count - steps // 2) % count)
    rows = (first[None] + np.arange(count)[:, None]) % count
    if count % 2 and count > 1:
        rows = np.concatenate([rows, rows[:, ::-1]])
    return rows


def plan(
    participant: int, conditions: tuple[str, ...], blocks: int, styles: int, seed: int
) -> list[Planned]:
    """The rounds of a participant.

    Args:
        participant: how many came before.
        conditions: kinds of agents.
        blocks: how often each participant meets each of them.
        styles: how many tasks there are.
        seed: of the study.

    Raises:
        ValueError: fewer than one condition, block or style, or a condition twice.
    """
    if len(set(conditions)) != len(conditions):
        raise ValueError(f"a condition stands twice in {', '.join(conditions)}")
    if blocks < 1 or styles < 1:
        raise ValueError(f"blocks is {blocks} and styles {styles}; expected at least 1 each")
    design = williams(len(conditions))
    rng = np.random.default_rng((seed, participant))
    order = [
        conditions[index]
        for block in range(blocks)
        for index in design[(participant + block * (1 + participant // len(design))) % len(design)]
    ]
    tasks: list[int] = []
    while len(tasks) < len(order):
        tasks.extend(rng.permutation(styles).tolist())
    return [Planned(*pair) for pair in zip(order, tasks, strict=False)]
