"""Haland beside other methods: shares of the Oracle with intervals, and who is ahead of whom."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.intervals import Estimate, estimate, mean_estimate
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
FURTHER_ABLATIONS = ("Without VAE (clean)", "Without fine-tuning")
"""Not in Table 1; the last is of Fig. 6."""
_LEFT_OUT = (*ABLATIONS, *FURTHER_ABLATIONS)
_OWN = (*(name for name in METHODS if name != HEADLINE), *FURTHER_ABLATIONS)
"""Steps of Haland itself and controls."""
Results = Mapping[str, Any]


PLACES = {"ahead": "ahead of", "behind": "behind", "level": "level with"}
"""What `verdict_of` says, in a sentence before the other one's name."""


class Standing(NamedTuple):
    """Another method beside Haland, in one run.

    Attributes:
        method: its name.
        share: interquartile mean of return / Oracle, with its 95% interval.
        haland: the same of Haland from test sentences.
        lead: by how much more of the Oracle Haland earns with the same partners: the mean of the
            differences, with its 95% interval.
        mean: mean of return / Oracle.
        lowest: the same of the style in which it is lowest.
        steps: environment steps of one of its egos; None where it learns from best responses.
        budget: those steps as a share of the steps of all best responses together.
    """

    method: str
    share: Estimate
    haland: Estimate
    lead: Estimate
    mean: float
    lowest: float
    steps: int | None
    budget: float | None

    @property
    def verdict(self) -> str:
        """Where Haland is; see `verdict_of`."""
        return verdict_of(self.lead)

    @property
    def apart(self) -> bool:
        """Whether the two intervals of the interquartile means have no point in common."""
        return not self.haland.overlaps(self.share)


def verdict_of(lead: Estimate) -> str:
    """Where one is who leads by that: "ahead" or "behind"; "level" if the interval has 0 in it."""
    if lead.low <= 0 <= lead.high:
        return "level"
    return "ahead" if lead.value > 0 else "behind"


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
    first, last = (HEADLINE, *EGOS), _LEFT_OUT
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


def without_memory(run: Results) -> tuple[str, str, int] | None:
    """The universal egos without a memory that learnt longest; None where none was measured.

    Returns:
        The name of the one that is told nothing, of the one that is told the style, and the
        environment steps of each.
    """
    steps = _steps(run)
    both = [names for names in (WITHOUT_MEMORY, COMPARISONS) if set(names) <= set(run["methods"])]
    if not both:
        return None
    plain, told = max(both, key=lambda names: steps.get(names[0], 0))
    return plain, told, steps.get(plain, 0)


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


def overall_shares(runs: Sequence[Results]) -> dict[str, Estimate]:
    """`estimates` over all runs, by method that all of them have; empty for fewer than two runs."""
    if len(runs) < 2:
        return {}
    found = {method: estimates(runs, method) for method in [*compared(runs), *_LEFT_OUT]}
    return {method: one for method, one in found.items() if one is not None}


def standings(results: Results) -> list[Standing]:
    """The other methods of a run, universal egos first; empty where Haland was not measured."""
    haland = estimates([results], HEADLINE)
    if haland is None:
        return []
    ours, steps = ratios(results, HEADLINE), _steps(results)
    budget = results.get("universal", {}).get("best_response_steps")
    found = []
    for method in [*compared([results])[1:], *_LEFT_OUT]:
        share = estimates([results], method)
        if share is None:
            continue
        theirs, took = ratios(results, method), steps.get(method)
        found.append(
            Standing(
                method=method,
                share=share,
                haland=haland,
                lead=mean_estimate(ours - theirs),
                mean=mean(theirs),
                lowest=lowest(theirs),
                steps=took,
                budget=took / budget if took and budget else None,
            )
        )
    return found


def lowest(shares: np.ndarray) -> float:
    """The mean over seeds of the style where it is lowest, from shares [style, seed]."""
    return float(np.nanmin([mean(row) for row in shares]))


def best_ego(found: Iterable[Standing]) -> Standing | None:
    """The universal ego that earns most, by its mean share of the Oracle; None without any."""
    egos = [one for one in found if one.method in EGOS]
    return max(egos, key=lambda one: one.mean, default=None)


class Gain(NamedTuple):
    """How much more Haland earns than universal egos in one run, as shares of their mean returns.

    Attributes:
        best: than the one that earns the largest share of the Oracle; NaN where that one loses.
        each: than each of them, the mean over those that do not lose; NaN where all do.
    """

    best: float
    each: float


def gain(run: Results) -> Gain | None:
    """Haland's gain in a run; None where no universal ego was measured."""
    others = universal_egos(run)
    if not others or HEADLINE not in run["methods"]:
        return None
    ours = returns(run, HEADLINE).mean()
    theirs = np.array([returns(run, name).mean() for name in others])
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.where(theirs > 0, ours / theirs - 1, np.nan)
    best = np.argmax([mean(ratios(run, name)) for name in others])
    return Gain(float(each[best]), mean(each))


class Improvement(NamedTuple):
    """The mean gain over environments, each of which counts once.

    The paper states one number, 89.64%, and not how it was taken.

    Attributes:
        best: beside the best universal ego of each environment.
        median: the median over environments of the same.
        each: beside each universal ego, their mean in each environment.
    """

    best: float
    median: float
    each: float


def improvement(gains: Iterable[Gain | None]) -> Improvement | None:
    """The mean gain over environments; None where no universal ego was measured."""
    found = [one for one in gains if one is not None]
    if not found:
        return None
    best = np.array([one.best for one in found])
    return Improvement(mean(best), float(np.nanmedian(best)), mean([one.each for one in found]))


def improvement_in_words(gains: Iterable[Gain | None]) -> str:
    """The same in a sentence; empty where there is nothing to say."""
    known = [one for one in gains if one is not None and np.isfinite(one.best)]
    more = improvement(known)
    if more is None:
        return ""
    counted = f"{len(known)} environment{'s' * (len(known) != 1)}"
    return (
        f"In mean return Haland earns {more.best:+.1%} beside the best universal ego of each "
        f"environment (median {more.median:+.1%}), {more.each:+.1%} beside each of them, on "
        f"average over {counted} that count alike (the paper states +89.64%)."
    )


def _steps(results: Results) -> dict[str, int]:
    """Environment steps of each method's egos, by the name that it shows."""
    took = dict.fromkeys(COMPARISONS, results.get("universal", {}).get("steps"))
    for found in results.get("compared", {}).values():
        took |= dict.fromkeys(found.get("by_ego", {}), found.get("steps"))
    return {name: int(steps) for name, steps in took.items() if steps}
