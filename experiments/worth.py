"""What knowing the partner's style is worth, in a few sentences from results.json."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.intervals import mean_estimate
from experiments.standing import PLACES, verdict_of, without_memory
from experiments.summary import (
    BEST_RESPONSE,
    HEADLINE,
    MethodSummary,
    ratios,
    return_digits,
    summarise,
)

# Shares of the Oracle that differ by less are said to be the same.
_NOTABLE = 0.05


def worth_of_the_style(results: Mapping[str, Any]) -> str:
    """The finding in a few sentences, good or bad; empty where nothing was measured."""
    rows = {row.method: row for row in summarise(results)}
    said = [*_between_styles(results), *_for_one_ego(results, rows)]
    return " ".join(said)


def steps_in_words(steps: float) -> str:
    """A number of environment steps for a reader: 800, 640 k, 1.5 M."""
    for size, unit in ((1e6, " M"), (1e3, " k")):
        if steps >= size:
            return f"{steps / size:.3g}{unit}"
    return f"{steps:g}"


def _between_styles(results: Mapping[str, Any]) -> list[str]:
    if "cross_play" not in results:
        return []
    values = np.asarray(results["cross_play"], float)
    own = float(np.mean(np.diag(values)))
    others = float(np.mean(values[~np.eye(len(values), dtype=bool)]))
    digits = return_digits([own])
    kept = f", {others / own:.0%} of that" if own > 0 and others > 0 else ""
    return [
        f"Best responses earn {own:.{digits}f} with held-out partners of their own style and "
        f"{others:.{digits}f} with those of other styles{kept}."
    ]


def _for_one_ego(results: Mapping[str, Any], rows: Mapping[str, MethodSummary]) -> list[str]:
    longest = without_memory(results)
    if longest is None:
        return []
    plain, told, steps = rows[longest[0]], rows[longest[1]], longest[2]
    digits = return_digits(row.mean for row in rows.values())
    said = [
        f"One feed-forward ego that learnt with the partners of all styles for "
        f"{steps_in_words(steps)} steps earns {plain.mean:.{digits}f} "
        f"({plain.ratio:.0%} of the Oracle) without the style's label and "
        f"{told.mean:.{digits}f} ({told.ratio:.0%}) with it"
        f"{_budget(results)}."
    ]
    if np.isnan(plain.ratio) or np.isnan(told.ratio):
        return said
    gain = told.ratio - plain.ratio
    if gain > _NOTABLE:
        said.append("To one ego for all, the label is worth something.")
    elif gain < -_NOTABLE:
        said.append("The label did not help it: that is optimisation, not information.")
    else:
        said.append("The label hardly changes what one ego for all earns.")
    ahead = HEADLINE if HEADLINE in rows else BEST_RESPONSE
    if ahead in rows:
        best = max(plain, told, key=lambda row: row.ratio)
        lead = mean_estimate(ratios(results, ahead) - ratios(results, best.method))
        said.append(
            f"{ahead} ({rows[ahead].ratio:.0%}) is {PLACES[verdict_of(lead)]} the better of the "
            f"two: {lead.signed} of the Oracle."
        )
    return said


def _budget(results: Mapping[str, Any]) -> str:
    other = results["universal"]["best_response_steps"]
    return f"; all archived best responses together took {steps_in_words(other)} steps"
