"""Long computations in pieces that can be interrupted: populations and supervised fits.

Between two pieces the state may be saved; what is computed does not depend on when that
happens, so a resumed run ends with the results of an uninterrupted one.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Environment, Pair
from experiments.progress import StageProgress
from haland_jax import checkpoint, fit, partners
from haland_jax.fit import FitConfig, FitState
from haland_jax.learner import TrainState
from haland_jax.population import share_out, turns
from haland_jax.ppo import PPOConfig

SECONDS_BETWEEN_CHECKPOINTS = 20.0
UPDATES_PER_PIECE = 25
CURVE_POINTS = 40
Program = Callable[..., tuple[Any, dict[str, jax.Array]]]
"""Does some updates of a population: state, and whatever else it takes -> state, metrics."""


class Saver:
    """Saves the state of a long computation now and then."""

    def __init__(self, path: Path):
        self.path = path
        self._last = time.monotonic()

    def restore(self, like: Any) -> Any | None:
        """The state that an interrupted run left, or None."""
        return checkpoint.restore(self.path, like) if checkpoint.exists(self.path) else None

    def save_if_due(self, state: Any) -> None:
        """Saves if the last save was long enough ago."""
        if time.monotonic() - self._last >= SECONDS_BETWEEN_CHECKPOINTS:
            checkpoint.save(self.path, state)
            self._last = time.monotonic()


def train_population(
    env: Environment,
    config: PPOConfig,
    start: Callable[[], TrainState],
    styles: Any,
    saver: Saver,
    report: Callable[[int, dict[str, float]], None],
    stage: str,
    *,
    updates_per_piece: int | None = None,
    between: Callable[[TrainState], TrainState] | None = None,
) -> tuple[Pair, np.ndarray]:
    """Trains a population to its end.

    Args:
        env: the environment.
        config: settings.
        start: makes the initial states, leading axis [member].
        styles: style of each member.
        saver: where interrupted training goes on from.
        report: called with the updates done and the mean return.
        stage: for messages.
        updates_per_piece: updates of each compiled piece; `UPDATES_PER_PIECE` by default.
        between: what happens to the state between two pieces, if anything.

    Returns:
        The trained players (`partners.trained_players`), and the training games' mean return,
        [update, member].

    Raises:
        NonFiniteLoss: training diverged.
    """
    state, returns = train_in_pieces(
        config,
        start(),
        lambda updates: partners.compile_training(env, config, updates),
        saver,
        report,
        stage,
        by_member=(share_out(styles),),
        updates_per_piece=updates_per_piece,
        between=between,
    )
    return partners.trained_players(state), returns


def train_in_pieces(
    config: PPOConfig,
    state: Any,
    compiled: Callable[[int], Program],
    saver: Saver,
    report: Callable[[int, dict[str, float]], None],
    stage: str,
    *,
    by_member: tuple[Any, ...] = (),
    updates_per_piece: int | None = None,
    between: Callable[[Any], Any] | None = None,
) -> tuple[Any, np.ndarray]:
    """Trains a population of any kind to its end.

    Args:
        config: settings; `config.num_updates` is the length.
        state: the initial states, leading axis [member], with the updates done in `update`.
        compiled: makes the program that does some updates: state, *by_member -> state, metrics.
        saver: where interrupted training goes on from.
        report: called with the updates done and the mean return.
        stage: for messages.
        by_member: whatever else the program takes, leading axis [member].
        updates_per_piece: updates of each member in a piece; `UPDATES_PER_PIECE` by default, which
            is rounded down to whole rounds where members take turns (`population.turns`).
        between: what happens to the state between two pieces, if anything.

    Returns:
        The final state, and the training games' mean return, [update, member].

    Raises:
        NonFiniteLoss: training diverged.
    """
    members = state.update.shape[0]
    returns = np.zeros((config.num_updates, members), np.float32)
    saved = saver.restore({"state": state, "returns": returns})
    if saved is not None:
        state, returns = saved["state"], np.array(saved["returns"])
    state = share_out(state)
    groups = turns(members, len(jax.devices()))
    rounds = sum(len(group) for group in groups) // members
    if updates_per_piece is not None and updates_per_piece % rounds:
        groups, rounds = [np.arange(members)], 1
    programs: dict[int, Program] = {}
    done = int(np.asarray(state.update)[0])
    while done < config.num_updates:
        size = min(updates_per_piece or UPDATES_PER_PIECE, config.num_updates - done)
        # What is less than a round is done by all members at once.
        taken, each = (groups, rounds) if size >= rounds else ([np.arange(members)], 1)
        size -= size % each
        if size // each not in programs:
            programs[size // each] = compiled(size // each)
        state, metrics = in_turns(programs[size // each], taken, state, by_member)
        metrics = {name: values.T for name, values in metrics.items()}
        fit.check_finite(stage, done, metrics)
        returns[done : done + size] = metrics["return"]
        done += size
        report(done, {"return": float(metrics["return"].mean())})
        if between is not None and done < config.num_updates:
            state = share_out(between(state))
        saver.save_if_due({"state": state, "returns": returns})
    return state, returns


def curves_of(
    config: PPOConfig, names: Sequence[str], returns: np.ndarray
) -> dict[str, np.ndarray | dict[str, np.ndarray]]:
    """Learning curves for results.json, averaged to at most `CURVE_POINTS` points.

    Args:
        config: how the players learnt.
        names: of the kinds of players.
        returns: of the training games, [update, kind * seed].
    """
    points = np.linspace(0, len(returns), min(CURVE_POINTS, len(returns)) + 1).astype(int)
    smooth = np.array([returns[a:b].mean(axis=0) for a, b in itertools.pairwise(points)])
    curves = np.split(smooth.T, len(names))  # [seed, point] each
    return {
        "curve_steps": points[1:] * config.steps_per_update,
        "curve_returns": dict(zip(names, curves, strict=True)),
    }


def in_turns(
    program: Program, groups: list[np.ndarray], state: Any, by_member: tuple[Any, ...]
) -> tuple[Any, dict[str, np.ndarray]]:
    """Lets groups of members compute one after the other; metrics are [member, update]."""
    if len(groups) == 1:
        state, metrics = program(state, *by_member)
        return state, {name: np.asarray(values) for name, values in metrics.items()}
    found: list[list[dict[str, np.ndarray]]] = [[] for _ in range(len(state.update))]
    device = jax.devices()[0]  # whoever waits for a turn, waits here
    state, by_member = jax.device_put((state, by_member), device)
    for group in groups:
        after, metrics = program(*_members_of((state, *by_member), group))
        metrics = {name: np.asarray(values) for name, values in metrics.items()}
        for place, member in enumerate(group):
            found[member].append({name: values[place] for name, values in metrics.items()})
        state = _with_members(state, jax.device_put(after, device), group)
    return state, {
        name: np.array([np.concatenate([part[name] for part in parts]) for parts in found])
        for name in found[0][0]
    }


@jax.jit
def _members_of(population: Any, group: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[group], population)


@jax.jit
def _with_members(population: Any, members: Any, group: Any) -> Any:
    return jax.tree.map(lambda whole, part: whole.at[group].set(part), population, members)


def run_fit(
    stage: str,
    config: FitConfig,
    chunk: Callable[[FitState, Any], tuple[FitState, dict[str, jax.Array]]],
    state: FitState,
    data: Any,
    saver: Saver,
    task: StageProgress,
    *,
    offset: int = 0,
    refresh: Callable[[FitState], Any] | None = None,
) -> tuple[FitState, dict[str, float]]:
    """Runs a supervised fit to its end.

    Args:
        stage: for messages.
        config: length of the fit.
        chunk: what `fit.make_fit_chunk` returned.
        state: the initial state.
        data: data of the fit.
        saver: where an interrupted fit goes on from.
        task: progress of the stage.
        offset: steps of the stage before this fit.
        refresh: makes the next piece's data from the state; the same from the same one, since
            data are not saved.

    Returns:
        The final state, and the last chunk's metrics (means).

    Raises:
        NonFiniteLoss: the fit diverged.
    """
    means: dict[str, float] = {}
    saved = saver.restore(state)
    # All on one device: data that a population has left on several ones would split every small
    # operation of the fit, which takes twice as long on a CPU.
    device = jax.devices()[0]
    state, data = jax.device_put((state if saved is None else saved, data), device)
    if saved is not None and refresh is not None:
        data = jax.device_put(refresh(state), device)
    while int(state.step) < config.steps:
        first = int(state.step)
        state, metrics = chunk(state, data)
        fit.check_finite(stage, first, metrics)
        means = {name: float(np.mean(values)) for name, values in metrics.items()}
        task.update(offset + int(state.step), means)
        # Nothing is saved after the last piece, so that its metrics are always at hand.
        if int(state.step) < config.steps:
            if refresh is not None:
                data = jax.device_put(refresh(state), device)
            saver.save_if_due(state)
    return state, means
