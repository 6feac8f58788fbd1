"""Which seeds of a style learn together, who trains, who is held out, and who plays with whom."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from haland_jax.learner import TrainState
from haland_jax.networks import Policy


def select_seeds(
    returns: np.ndarray, num_train: int, num_held_out: int
) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the best seeds of each style and deals them out.

    The seeds with the highest returns are kept; by rank they go in turn to the training and
    to the held-out partners, so that neither group is the better one by choice.

    Args:
        returns: mean return of each pair, [style, seed].
        num_train: training partners of each style.
        num_held_out: held-out partners of each style.

    Returns:
        Indices of seeds, int32 [style, num_train] and [style, num_held_out].
    """
    kept = np.argsort(-returns, axis=1, kind="stable")[:, : num_train + num_held_out]
    train, held_out = [], []
    for rank in range(kept.shape[1]):
        wants_train = len(train) * num_held_out <= len(held_out) * num_train
        (train if wants_train and len(train) < num_train else held_out).append(rank)
    while len(held_out) > num_held_out:
        train.append(held_out.pop())
    return kept[:, sorted(train)].astype(np.int32), kept[:, held_out].astype(np.int32)


def select_from_circles(
    returns: np.ndarray, training_circle: int, num_train: int, num_held_out: int
) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the best seeds of the two circles in which the pairs of each style learnt.

    Args:
        returns: mean return of each pair, [style, seed].
        training_circle: how many seeds, the first ones, the circle of training partners has.
        num_train: training partners of each style.
        num_held_out: held-out partners of each style, from the other circle.

    Returns:
        Indices of seeds, int32 [style, num_train] and [style, num_held_out].
    """
    train = np.argsort(-returns[:, :training_circle], axis=1, kind="stable")
    held_out = training_circle + np.argsort(-returns[:, training_circle:], axis=1, kind="stable")
    return train[:, :num_train].astype(np.int32), held_out[:, :num_held_out].astype(np.int32)


def meet_next_partners(
    state: TrainState, num_styles: int, circle_sizes: tuple[int, ...]
) -> TrainState:
    """Moves each ego on to the next partner of its circle; games go on where they are.

    Args:
        state: pairs, leading axis [style * seed].
        num_styles: how many styles there are.
        circle_sizes: seeds of a style in each circle, in order; their sum is the number of seeds.
    """
    begins = np.cumsum((0, *circle_sizes[:-1]))
    of_style = [
        begin + np.roll(np.arange(size), 1)
        for begin, size in zip(begins, circle_sizes, strict=True)
    ]
    seeds = sum(circle_sizes)
    members = (seeds * np.arange(num_styles)[:, None] + np.concatenate(of_style)).reshape(-1)
    return state.replace(ego=jax.tree.map(lambda leaf: jnp.take(leaf, members, axis=0), state.ego))


@jax.jit
def all_pairs(egos: Policy, partners: Policy) -> tuple[Policy, Policy]:
    """Puts each ego of a style beside each partner of it.

    Args:
        egos: leading axes [style, ego].
        partners: leading axes [style, seed].

    Returns:
        Egos and partners of the pairs, leading axis [style * seed * ego].
    """
    count, seeds = (jax.tree.leaves(players)[0].shape[1] for players in (egos, partners))
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], seeds, axis=1), egos)
    beside = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=1), partners)
    return (
        jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), repeated),
        jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), beside),
    )


@jax.jit
def take_seeds(tree: Any, index: np.ndarray | jax.Array) -> Any:
    """Picks seeds by style: leaves [style, seed, ...], index [style, n] -> [style, n, ...]."""
    rows = np.arange(index.shape[0])[:, None]
    return jax.tree.map(lambda leaf: leaf[rows, index], tree)
