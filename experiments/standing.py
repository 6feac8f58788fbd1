"""Haland beside other methods: shares of the Oracle with intervals, and who is ahead of whom."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.intervals import Estimate, estimate
from experiments.summary import (
    COMPARISONS,
    HEADLINE,
    METHODS,
    ORACLE,
    mean,
    ordered_methods,
    ratios,
    returns,
)

ADAPTIVE = "Adaptive Ego"
WITHOUT_MEMORY = ("General Ego (MLP)", "Instructed Ego (MLP)")
"""The egos of `COMPARISONS`, in their order, trained with the budget of a comparison."""
EGOS = (
    *("General Ego", "Instructed Ego", ADAPTIVE),
    *WITHOUT_MEMORY,
    *("Self-play", "FCP", *COMPARISONS),
)
"""Universal egos; further methods that no run of ours knows follow them."""
ABLATIONS = ("CGAN (MLP)", "CGAN (UNet)", "Without translator", "Without VAE")
"""The columns of Table 1 after Oracle and Haland."""
_OWN = (*(name for name in METHODS if name != HEADLINE), "Without fine-tuning")
"""Steps of Haland itself and controls."""
Results = Mapping[str, Any]


class Standing(NamedTuple):
    """Another method beside Haland, in one run.

    Attributes:
        method: its name.
        share: interquartile mean of return / Oracle, with its 95% interval.
        haland: the same of Haland from test sentences.
        steps: environment steps of one of its egos; None where it learns from best responses.
        budget: those steps as a share of the steps of all best responses together.
    """

    method: str
    share: Estimate
    haland: Estimate
    steps: int | None
    budget: float | None

    @property
    def verdict(self) -> str:
        """Where Haland is: "ahead", "behind", or "level" where the intervals overlap."""
        if self.haland.overlaps(self.share):
            return "level"
        return "ahead" if self.haland.value > self.share.value else "behind"


def compared(runs: Iterable[Results]) -> list[str]:
    """The methods of Fig. 3: Haland, the universal egos, then any others that are not ours."""
    measured = {HEADLINE: None}
    for run in runs:
        others = (name for name in ordered_methods(run) if name not in (*_OWN, *ABLATIONS, *EGOS))
        measured |= dict.fromkeys([*universal_egos(run), *others])
    return in_order(measured)


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods as tables and figures show them: Haland, universal egos, others, ablations."""
    found = dict.fromkeys(methods)
    first, last = (HEADLINE, *EGOS), ABLATIONS
    others = [name for name in found if name not in (*first, *last)]
    known = [[name for name in names if name in found] for names in (first, last)]
    return [*known[0], *others, *known[1]]


def universal_egos(run: Results) -> list[str]:
    """The universal egos that were measured; of the same kind, only those that learnt longest."""
    found, steps = set(run["methods"]), _steps(run)
    for shorter, longer in zip(COMPARISONS, WITHOUT_MEMORY, strict=True):
        if longer in found and steps.get(longer, 0) >= steps.get(shorter, 0):
            found.discard(shorter)
    return [name for name in EGOS if name in found]


def estimates(runs: Sequence[Results], method: str) -> Estimate | None:
    """The interquartile mean of a method's share of the Oracle over runs, styles and seeds.

    None where a run lacks the method, or no partner's Oracle earns anything.
    """
    if any(method not in run["methods"] and method != ORACLE for run in runs):
        return None
    rows = [row for run in runs for row in ratios(run, method)]
    widest = max(len(row) for row in rows)
    padded = [np.pad(row, (0, widest - len(row)), constant_values=np.nan) for row in rows]
    return estimate(np.array(padded)) if np.isfinite(padded).any() else None


def standings(results: Results) -> list[Standing]:
    """The other methods of a run, universal egos first; empty where Haland was not measured."""
    haland = estimates([results], HEADLINE)
    if haland is None:
        return []
    steps = _steps(results)
    budget = results.get("universal", {}).get("best_response_steps")
    found = []
    for method in [*compared([results])[1:], *ABLATIONS]:
        share = estimates([results], method)
        if share is None:
            continue
        took = steps.get(method)
        found.append(
            Standing(method, share, haland, took, took / budget if took and budget else None)
        )
    return found


def best_ego(found: Iterable[Standing]) -> Standing | None:
    """The universal ego that earns most; None where none was measured."""
    egos = [one for one in found if one.method in EGOS]
    return max(egos, key=lambda one: one.share.value, default=None)


class Gain(NamedTuple):
    """How much more Haland earns than universal egos in one run, as shares; NaN beside a loss.

    Attributes:
        best: than the one that earns most.
        each: than each of them.
    """

    best: float
    each: tuple[float, ...]


def gain(run: Results) -> Gain | None:
    """Haland's gain in a run; None where no universal ego was measured."""
    others = universal_egos(run)
    if not others or HEADLINE not in run["methods"]:
        return None
    ours = returns(run, HEADLINE).mean()
    theirs = [returns(run, name).mean() for name in others]
    each = tuple(float(ours / one - 1) if one > 0 else float("nan") for one in theirs)
    return Gain(each[int(np.argmax(theirs))], each)


def improvement(gains: Iterable[Gain | None]) -> Gain | None:
    """The mean gain over environments, beside their best universal egos and beside all of them.

    The paper states one number, 89.64%, and not how it was taken.
    """
    found = [one for one in gains if one is not None]
    if not found:
        return None
    every = np.array([value for one in found for value in one.each])
    return Gain(mean(np.array([one.best for one in found])), (mean(every),))


def improvement_in_words(gains: Iterable[Gain | None]) -> str:
    """The same in a sentence; empty where there is nothing to say."""
    known = [one for one in gains if one is not None and np.isfinite(one.best)]
    more = improvement(known)
    if more is None:
        return ""
    counted = f"{len(known)} environment{'s' * (len(known) != 1)}"
    return (
        f"In mean return Haland earns {more.best:+.1%} beside the best universal ego of each "
        f"environment, {more.each[0]:+.1%} beside each of them, on average over {counted} (the "
        "paper states +89.64%)."
    )


def _steps(results: Results) -> dict[str, int]:
    """Environment steps of each method's egos, by the name that it shows."""
    took = dict.fromkeys(COMPARISONS, results.get("universal", {}).get("steps"))
    for found in results.get("compared", {}).values():
        took |= dict.fromkeys(found.get("by_ego", {}), found.get("steps"))
    return {name: int(steps) for name, steps in took.items() if steps}
