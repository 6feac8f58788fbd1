"""What results.json says in numbers: returns by method, style and held-out seed, and their means.

Throughout, a method's return with a held-out partner is the mean over episodes. A "mean over seeds"
is taken over the held-out seeds of the per-seed means over styles, and its spread is the sample
standard deviation over those seeds.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.errors import UserError
from experiments.intervals import Estimate, estimate

ORACLE = "Oracle"
BEST_RESPONSE = "Best response"
HEADLINE = "Haland, test sentences"
WRONG = "Haland, wrong sentence"
MOST_FROM_A_WRONG_SENTENCE = 0.6
"""Share of the Oracle from which on an ego of another style's sentence has not fallen: a gate."""
UNIVERSAL = "Universal ego"
UNIVERSAL_WITH_LABEL = "Universal ego with the style's label"
METHODS = (
    ORACLE,
    BEST_RESPONSE,
    "VAE reconstruction",
    "Diffusion, true task language",
    "Haland, training sentences",
    HEADLINE,
    WRONG,
)
"""The method itself, step by step."""
COMPARISONS = (UNIVERSAL, UNIVERSAL_WITH_LABEL)
"""What else every run measures."""
PARTNER_SIGHT = "partner_sight"
"""Where results.json has the comparisons with egos that see the partner only nearby."""


@dataclasses.dataclass(frozen=True)
class MethodSummary:
    """One row of the headline table; the ratio is the return divided by that partner's Oracle.

    `interval` is the interquartile mean of the ratios over styles and held-out seeds, with its
    stratified bootstrap interval; None where there is no ratio. `success` is the share of games
    that succeeded, None where games only earn a return.
    """

    method: str
    mean: float
    std: float
    ratio: float
    ratio_std: float
    interval: Estimate | None
    success: float | None
    episodes: int | None


def ordered_methods(results: Mapping[str, Any]) -> list[str]:
    """The methods that were measured: the paper's chain, the comparisons, then any others."""
    known = (*METHODS, *COMPARISONS)
    measured = [name for name in known if name in results["methods"]]
    if ORACLE not in measured:
        measured.insert(0, ORACLE)
    return measured + [name for name in results["methods"] if name not in known]


def returns(results: Mapping[str, Any], method: str) -> np.ndarray:
    """A method's mean return per episode with each held-out partner, [style, seed].

    Raises:
        UserError: a style is missing, or the styles differ in their number of seeds.
    """
    if method == ORACLE:
        by_style = {style: {"returns": seeds} for style, seeds in results["oracle"].items()}
    else:
        by_style = results["methods"][method]
    missing = [style for style in results["styles"] if style not in by_style]
    if missing:
        raise UserError(f"results.json has no returns of '{method}' for the style '{missing[0]}'")
    rows = [
        [float(np.mean(seed)) for seed in by_style[style]["returns"]] for style in results["styles"]
    ]
    if len({len(row) for row in rows}) != 1:
        raise UserError(f"results.json: the styles of '{method}' differ in their number of seeds")
    return np.asarray(rows)


def episodes(results: Mapping[str, Any], method: str) -> int | None:
    """How many episodes a method was measured in; None where only means were stored."""
    seeds = [
        seed for style in results["methods"].get(method, {}).values() for seed in style["returns"]
    ]
    if not seeds or not all(isinstance(seed, Sequence) for seed in seeds):
        return None
    return sum(len(seed) for seed in seeds)


def success(results: Mapping[str, Any], method: str) -> float | None:
    """The share of a method's games that succeeded; None where that was not measured."""
    by_style = results["methods"].get(method, {}).values()
    found = [np.mean(style["successes"]) for style in by_style if "successes" in style]
    return float(np.mean(found)) if found else None


def ratios(results: Mapping[str, Any], method: str) -> np.ndarray:
    """`returns` divided by each partner's Oracle, [style, seed]; NaN where that is not positive."""
    oracle = returns(results, ORACLE)
    measured = returns(results, method)
    if measured.shape != oracle.shape:
        raise UserError(
            f"results.json: '{method}' has {measured.shape[1]} held-out seeds a style, the Oracle "
            f"{oracle.shape[1]}"
        )
    return shares(measured, oracle)


def sight_shares(results: Mapping[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """The comparisons' shares of the Oracle by how far the ego sees the partner.

    Returns:
        By "everywhere", "2 cells" and so on, by method: `ratios`, [style, seed].
    """
    found = {"everywhere": {method: ratios(results, method) for method in COMPARISONS}}
    for measured in results.get(PARTNER_SIGHT, []):
        seen = f"{measured['cells']} cell{'s' * (measured['cells'] != 1)} away"
        nearby = {**results, "methods": measured["methods"]}
        found[seen] = {method: ratios(nearby, method) for method in COMPARISONS}
    return found


def shares(returns: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """Returns divided by the same partners' Oracle; NaN where that is not positive."""
    nothing = np.full(np.shape(oracle), np.nan)
    return np.divide(returns, oracle, out=nothing, where=np.asarray(oracle) > 0)


def dead_partners(results: Mapping[str, Any]) -> int:
    """How many held-out partners have an Oracle of zero or less, and so no ratio."""
    return int(np.sum(returns(results, ORACLE) <= 0))


def spread(values: np.ndarray) -> float:
    """The sample standard deviation over the numbers that are there; 0 for fewer than two."""
    values = values[np.isfinite(values)]
    return float(np.std(values, ddof=1)) if values.size > 1 else 0.0


def mean(values: np.ndarray | Sequence[float]) -> float:
    """The mean over the numbers that are there; NaN where there is none."""
    values = np.asarray(values)
    values = values[np.isfinite(values)]
    return float(np.mean(values)) if values.size else float("nan")


def return_digits(values: Iterable[float]) -> int:
    """Decimals that returns such as these are shown with: of one point at most, three."""
    return 1 if max(map(abs, values), default=0.0) >= 10 else 3


def summarise(results: Mapping[str, Any]) -> list[MethodSummary]:
    """The headline table, one row a method."""
    rows = []
    for method in ordered_methods(results):
        by_seed = returns(results, method).mean(axis=0)
        ratio = ratios(results, method)
        ratio_by_seed = np.asarray([mean(column) for column in ratio.T])
        rows.append(
            MethodSummary(
                method=method,
                mean=mean(by_seed),
                std=spread(by_seed),
                ratio=mean(ratio),
                ratio_std=spread(ratio_by_seed),
                interval=estimate(ratio) if np.isfinite(ratio).any() else None,
                success=success(results, method),
                episodes=episodes(results, method),
            )
        )
    return rows
