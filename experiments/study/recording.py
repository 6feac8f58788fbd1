"""The steps of a round as they are stored: eight bytes each."""

from collections.abc import Iterable

import numpy as np

from envs.base import Pair

STEP = np.dtype([("ego", "u1"), ("person", "u1"), ("reward", "<f4"), ("late", "<u2")])
"""Both actions, the team reward, and how late the step came, in milliseconds (65,535: or more)."""
MOST_LATE = 65_535


def pack(steps: Iterable[tuple[int, int, float, float]]) -> bytes:
    """Steps as bytes: ego's action, the person's, the reward, milliseconds late."""
    rows = [(ego, person, reward, min(max(round(late), 0), MOST_LATE))
            for ego, person, reward, late in steps]  # fmt: skip
    return np.array(rows, STEP).tobytes()


def unpack(chunks: Iterable[tuple[int, bytes]]) -> np.ndarray:
    """All steps of a round, [T] of `STEP`.

    Args:
        chunks: number of the first step, and packed steps, in any order.

    Raises:
        ValueError: steps are missing, stored twice, or cut off.
    """
    parts, reached = [], 0
    for first, data in sorted(chunks):
        if first != reached:
            raise ValueError(f"step {reached} should come next, but step {first} does")
        if len(data) % STEP.itemsize:
            raise ValueError(f"the steps from {first} on are {len(data)} bytes, no whole steps")
        parts.append(np.frombuffer(data, STEP))
        reached += len(parts[-1])
    return np.concatenate(parts) if parts else np.zeros(0, STEP)


def sound_part(chunks: Iterable[tuple[int, bytes]]) -> np.ndarray:
    """The steps before the first damage, [T] of `STEP`; arguments as `unpack`."""
    kept: list[tuple[int, bytes]] = []
    for chunk in sorted(chunks):
        try:
            unpack([*kept, chunk])
        except ValueError:
            break
        kept.append(chunk)
    return unpack(kept)


def actions_of(steps: np.ndarray) -> Pair:
    """Both players' actions, `Pair` of int32 [T]."""
    return Pair(steps["ego"].astype(np.int32), steps["person"].astype(np.int32))
