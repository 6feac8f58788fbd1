"""Plays policies with partners and says what they earn."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from haland_jax import partners
from haland_jax.networks import Policy
from haland_jax.seeds import all_pairs


class Scores(NamedTuple):
    """Means over the games of each pair, the axes as it is said where they come from.

    Attributes:
        returns: team reward of a game.
        successes: share of the games that succeeded; None where games only earn a return.
    """

    returns: np.ndarray
    successes: np.ndarray | None

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> "Scores":
        """Does the same with both."""
        successes = None if self.successes is None else function(self.successes)
        return Scores(function(self.returns), successes)


class Judge:
    """Plays policies with partners, many pairs at a time in one compiled program."""

    def __init__(self, env: Any, games: int, batch: int):
        self.env, self.batch = env, batch
        self._play = partners.compile_evaluation(env, games)

    def scores(self, key: jax.Array, egos: Policy, partner: Policy, styles: Any) -> Scores:
        """Scores of each pair; all arguments but the key have the leading axis [pair]."""
        total = jax.tree.leaves(styles)[0].shape[0]
        keys = jax.random.split(key, total)
        returns, successes = [], []
        for first in range(0, total, self.batch):
            rows = np.minimum(np.arange(first, first + self.batch), total - 1)
            pairs = _rows((egos, partner, styles), rows)
            played = self._play(keys[rows], *pairs)
            returns.append(np.asarray(played.returns).mean(axis=1))
            if self.env.success_event is not None:
                event = self.env.event_names.index(self.env.success_event)
                successes.append(np.asarray(played.events)[:, :, 0, event].mean(axis=1))
        found = Scores(np.concatenate(returns), np.concatenate(successes) if successes else None)
        return found.map(lambda values: values[:total])

    def with_held_out(self, key: jax.Array, egos: Policy, held_out: Policy) -> Scores:
        """Scores of each style's egos with each held-out partner of that style.

        Args:
            key: consumed.
            egos: leading axes [style, ego].
            held_out: leading axes [style, seed].

        Returns:
            [style, seed, ego].
        """
        styles, count = jax.tree.leaves(egos)[0].shape[:2]
        seeds = jax.tree.leaves(held_out)[0].shape[1]
        flat_egos, flat_partners = all_pairs(egos, held_out)
        each_style = partners.repeat_styles(self.env, seeds * count)
        found = self.scores(key, flat_egos, flat_partners, each_style)
        return found.map(lambda values: values.reshape(styles, seeds, count))


def over_egos(scores: Scores) -> Scores:
    """Means over the egos of [style, seed, ego]."""
    return scores.map(lambda values: values.mean(axis=2))


def by_style(scores: Scores, style_names: tuple[str, ...]) -> dict[str, dict[str, np.ndarray]]:
    """Scores [style, seed] as results.json holds them."""
    measured = {name: values for name, values in scores._asdict().items() if values is not None}
    return {
        style: {name: values[index] for name, values in measured.items()}
        for index, style in enumerate(style_names)
    }


@jax.jit
def _rows(tree: Any, rows: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)
