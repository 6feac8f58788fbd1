"""What one run found in one row, so that environments can stand side by side."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.compared import COMPARED, NAMES
from experiments.intervals import Estimate
from experiments.standing import Gain, Standing, best_ego, gain, lowest, standings, without_memory
from experiments.summary import (
    BEST_RESPONSE,
    HEADLINE,
    ORACLE,
    PARTNER_SIGHT,
    UNIVERSAL,
    UNIVERSAL_WITH_LABEL,
    WRONG,
    mean,
    ratios,
    returns,
    sight_shares,
    success,
    summarise,
)
from experiments.worth import worth_of_the_style


@dataclasses.dataclass(frozen=True)
class Overview:
    """One run's row; what was not measured is None.

    Attributes:
        environment: its name.
        preset: the run's scale.
        seed: the run's seed.
        styles: how many styles.
        held_out_seeds: held-out partners of each style.
        oracle: mean return, and its standard deviation over held-out seeds.
        upper_bound: mean over styles of the bound on the return.
        oracle_of_bound: mean over styles of Oracle / upper bound.
        lowest_oracle_of_bound: the same in the style where it is lowest.
        ceiling: best response / Oracle.
        haland: mean return from test sentences, and its deviation over held-out seeds.
        share: Haland from test sentences / Oracle.
        wrong_share: Haland from a wrong sentence / Oracle.
        successes: share of the games that succeed with the Oracle and with Haland from test
            sentences; None where games only earn a return.
        accuracy: share of the test sentences that are translated into their own style.
        universal: return of the ego for all styles without a memory that learnt longest and is
            told nothing.
        universal_with_label: the same of the one that is told the style.
        diagonal: return of best responses with partners of their own style.
        off_diagonal: return of best responses with partners of the other styles.
        worth: what knowing the style is worth, in sentences; may be empty.
        sights: how far the ego of all styles sees the partner, and its shares of the Oracle
            without and with the style's label; empty where only the full view was measured.
        minutes: all stages together.
        gates_met: how many gates were met.
        gates: how many there are.
        machine: processor and number of its cores.
        date: day of the run, year-month-day.
        shares: by method that is compared with others, the interquartile mean of return / Oracle
            with its interval; Haland's first.
        means: by the same methods, the mean of return / Oracle, and that of the lowest style.
        steps: by method whose egos learnt in games, environment steps of one of them and their
            share of the steps of all best responses together, where that is known.
        gain: how much more Haland earns than universal egos; None where none was measured.
        best_ego: the universal ego that earns most beside Haland; None where none was measured.
        compared: which of the project's other methods `experiments.compare` measured, by the
            options of the command.
        added: the methods that came from files of their own.
    """

    environment: str
    preset: str
    seed: int
    styles: int
    held_out_seeds: int
    oracle: tuple[float, float]
    upper_bound: float | None
    oracle_of_bound: float | None
    lowest_oracle_of_bound: float | None
    ceiling: float | None
    haland: tuple[float, float] | None
    share: float | None
    wrong_share: float | None
    successes: tuple[float, float] | None
    accuracy: float | None
    universal: float | None
    universal_with_label: float | None
    diagonal: float | None
    off_diagonal: float | None
    worth: str
    sights: tuple[tuple[str, float, float], ...]
    minutes: float | None
    gates_met: int
    gates: int
    machine: str | None
    date: str | None
    shares: Mapping[str, Estimate]
    means: Mapping[str, tuple[float, float]]
    steps: Mapping[str, tuple[int, float | None]]
    gain: Gain | None
    best_ego: Standing | None
    compared: Mapping[str, Sequence[str]]
    added: Sequence[str]

    def amount(self, value: float | None) -> str:
        """A return of this environment for a reader; a dash for what was not measured."""
        return number(value, self._digits)

    def amount_with_spread(self, value: tuple[float, float] | None) -> str:
        """A return ± its deviation over held-out seeds; one seed has no deviation."""
        if value is None or self.held_out_seeds == 1:
            return self.amount(value[0] if value else None)
        return f"{self.amount(value[0])} ± {self.amount(value[1])}"

    @property
    def _digits(self) -> int:
        """Where an episode earns at most a few points, whole numbers say too little."""
        return 0 if self.oracle[0] >= 10 else 2


def overview(results: Mapping[str, Any]) -> Overview:
    """The row of a run, from the content of its results.json.

    Raises:
        UserError: the results contradict themselves.
    """
    oracle = returns(results, ORACLE)
    bounds, of_bound = _upper_bounds(results, oracle)
    diagonal, off_diagonal = _cross_play(results)
    machine = results.get("machine", {})
    rows = {row.method: row for row in summarise(results)}
    times, gates = results.get("times"), results.get("gates", {})
    found = standings(results)
    plain, told, _ = without_memory(results) or (UNIVERSAL, UNIVERSAL_WITH_LABEL, 0)
    return Overview(
        environment=results["environment"],
        preset=results["preset"],
        seed=results["seed"],
        styles=len(results["styles"]),
        held_out_seeds=oracle.shape[1],
        oracle=(rows[ORACLE].mean, rows[ORACLE].std),
        upper_bound=None if bounds is None else float(bounds.mean()),
        oracle_of_bound=None if of_bound is None else float(of_bound.mean()),
        lowest_oracle_of_bound=None if of_bound is None else float(of_bound.min()),
        ceiling=_share(results, BEST_RESPONSE),
        haland=(rows[HEADLINE].mean, rows[HEADLINE].std) if HEADLINE in rows else None,
        share=_share(results, HEADLINE),
        wrong_share=_share(results, WRONG),
        successes=_successes(results),
        accuracy=results.get("translator", {}).get("accuracy"),
        universal=rows[plain].mean if plain in rows else None,
        universal_with_label=rows[told].mean if told in rows else None,
        diagonal=diagonal,
        off_diagonal=off_diagonal,
        worth=worth_of_the_style(results),
        sights=_sights(results),
        minutes=sum(times.values()) / 60 if times else None,
        gates_met=sum(bool(gate["met"]) for gate in gates.values()),
        gates=len(gates),
        machine=_machine(machine),
        date=machine.get("date"),
        shares=_shares(found),
        means=_means(results, found),
        steps={one.method: (one.steps, one.budget) for one in found if one.steps is not None},
        gain=gain(results),
        best_ego=best_ego(found),
        compared=_compared(results),
        added=_added(results),
    )


def number(value: float | None, digits: int = 0) -> str:
    """The number as a reader wants it; a dash for what was not measured."""
    return "–" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """The share in per cent; a dash for what was not measured."""
    return "–" if value is None else f"{value:.0%}"


def _shares(found: Sequence[Standing]) -> dict[str, Estimate]:
    haland = {HEADLINE: found[0].haland} if found else {}
    return haland | {one.method: one.share for one in found}


def _means(results: Mapping[str, Any], found: Sequence[Standing]) -> dict[str, tuple[float, float]]:
    if not found:
        return {}
    haland = ratios(results, HEADLINE)
    others = {one.method: (one.mean, one.lowest) for one in found}
    return {HEADLINE: (mean(haland), lowest(haland))} | others


def _compared(results: Mapping[str, Any]) -> dict[str, list[str]]:
    """Methods by what the command was asked for; those that any command makes join the first."""
    budget = results.get("universal", {}).get("best_response_steps")
    groups: dict[str, list[str]] = {}
    for name, found in results.get(COMPARED, {}).items():
        options = f" --seeds {found['seeds']}" if "seeds" in found else ""
        if found.get("asked_steps", budget) != budget:
            options += f" --steps {found['asked_steps']}"
        if name in NAMES:
            groups.setdefault(options, []).append(name)
    anyhow = groups.pop("", [])
    if anyhow:
        groups.setdefault(next(iter(groups), ""), []).extend(anyhow)
    return {options: sorted(names, key=NAMES.index) for options, names in groups.items()}


def _added(results: Mapping[str, Any]) -> list[str]:
    """What methods that are not the project's own call their egos."""
    found = results.get(COMPARED, {}).items()
    return [shown for name, one in found if name not in NAMES for shown in one.get("by_ego", {})]


def _share(results: Mapping[str, Any], method: str) -> float | None:
    """Mean of return / Oracle; None where it was not measured or no Oracle earns anything."""
    if method not in results["methods"]:
        return None
    share = mean(ratios(results, method))
    return None if np.isnan(share) else share


def _successes(results: Mapping[str, Any]) -> tuple[float, float] | None:
    oracle, haland = (success(results, method) for method in (ORACLE, HEADLINE))
    return None if oracle is None or haland is None else (oracle, haland)


def _upper_bounds(
    results: Mapping[str, Any], oracle: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The bound of each style, and Oracle / bound of each style where all bounds are positive."""
    if not (by_style := results.get("upper_bounds")):
        return None, None
    bounds = np.asarray([by_style[style] for style in results["styles"]], float)
    return bounds, oracle.mean(axis=1) / bounds if (bounds > 0).all() else None


def _sights(results: Mapping[str, Any]) -> tuple[tuple[str, float, float], ...]:
    if not results.get(PARTNER_SIGHT):
        return ()
    return tuple(
        (seen, mean(by_method[UNIVERSAL]), mean(by_method[UNIVERSAL_WITH_LABEL]))
        for seen, by_method in sight_shares(results).items()
    )


def _cross_play(results: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Mean return on the diagonal and off it."""
    if "cross_play" not in results:
        return None, None
    values = np.asarray(results["cross_play"], float)
    own = np.eye(len(values), dtype=bool)
    return float(values[own].mean()), float(values[~own].mean())


def _machine(machine: Mapping[str, Any]) -> str | None:
    if "processor" not in machine:
        return None
    cores = f", {machine['cores']} cores" if "cores" in machine else ""
    return f"{machine['processor']}{cores}"
