"""Plays policies with partners and says what they earn."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from haland_jax import partners
from haland_jax.networks import Policy


class Judge:
    """Plays policies with partners, many pairs at a time in one compiled program."""

    def __init__(self, env: Any, games: int, batch: int):
        self.env, self.batch = env, batch
        self._play = partners.compile_evaluation(env, games)

    def returns(self, key: jax.Array, egos: Policy, partner: Policy, styles: Any) -> np.ndarray:
        """Mean return of each pair; all arguments but the key have the leading axis [pair]."""
        total = jax.tree.leaves(styles)[0].shape[0]
        keys = jax.random.split(key, total)
        means = []
        for first in range(0, total, self.batch):
            rows = np.minimum(np.arange(first, first + self.batch), total - 1)
            pairs = _rows((egos, partner, styles), rows)
            played = self._play(keys[rows], *pairs)
            means.append(np.asarray(played.returns.mean(axis=1)))
        return np.concatenate(means)[:total]

    def with_held_out(self, key: jax.Array, egos: Policy, held_out: Policy) -> np.ndarray:
        """Mean return of each style's egos with each held-out partner of that style.

        Args:
            key: consumed.
            egos: leading axes [style, ego].
            held_out: leading axes [style, seed].

        Returns:
            [style, seed, ego].
        """
        styles, count = jax.tree.leaves(egos)[0].shape[:2]
        seeds = jax.tree.leaves(held_out)[0].shape[1]
        flat_egos, flat_partners = _all_pairs(egos, held_out)
        each_style = partners.repeat_styles(self.env, seeds * count)
        returns = self.returns(key, flat_egos, flat_partners, each_style)
        return returns.reshape(styles, seeds, count)


@jax.jit
def _all_pairs(egos: Policy, partners: Policy) -> tuple[Policy, Policy]:
    """Each style's egos beside each of its partners, leading axis [style * seed * ego]."""
    count = jax.tree.leaves(egos)[0].shape[1]
    seeds = jax.tree.leaves(partners)[0].shape[1]
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], seeds, axis=1), egos)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), repeated)
    beside = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=1), partners)
    return flat, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), beside)


@jax.jit
def _rows(tree: Any, rows: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)
