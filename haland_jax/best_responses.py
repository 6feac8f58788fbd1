"""Best responses to styled partners, and the Oracles that they are measured against.

1. Each training ego is refitted against *all* frozen partners of its style that are not held
   out, and against those of other styles seen in a mirror (`best_response_refits`): an ego that
   knew one partner only keeps that partner's private conventions. A universal ego
   (`haland_jax.universal`) is refitted too, more gently: it brings what it learnt with others.
   It is the one that is told the style, unless that earns clearly less (`choose_universal`) and
   the other may be it (`PartnersConfig.told_start`).
   What a style's egos have found out, those of the style that is seen in its place in a mirror may
   have missed: their images (`mirrors.egos_seen_in`) are taken where they are clearly better.
   Each style keeps the universal start, unless its own egos are clearly better, and of that start
   the egos that are as good (`best_egos`). These egos are the archive.
2. The Oracle of a held-out partner is the best of a few egos of its style refitted to that very
   partner (`oracle_refits`), chosen on other games than those it is scored on.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from haland_jax import ppo
from haland_jax.learner import TrainState
from haland_jax.networks import Policy
from haland_jax.partners import (
    PartnersConfig,
    Player,
    Population,
    copies,
    flatten,
    repeat_styles,
)
from haland_jax.population import over_population
from haland_jax.ppo import PPOConfig
from haland_jax.seeds import take_seeds

AS_GOOD = 0.97
"""Share of the best ego's return from which another one counts as good."""


def init_refits(
    env: Environment,
    config: PPOConfig,
    key: jax.Array,
    egos: Player,
    partners: Policy,
    styles: Any,
) -> TrainState:
    """Starts the refit of egos against frozen partners.

    Args:
        env: the environment.
        config: settings of the refit.
        key: consumed.
        egos: where each refit starts, leading axis [member].
        partners: frozen actors, leading axes [member, partner]; they share the games.
        styles: style of each member.
    """

    def init_refit(key, ego, partners, style):
        learner = ego.learner(config)
        return ppo.init_train_state(env, config, key, learner, partners, style)

    keys = jax.random.split(key, jax.tree.leaves(styles)[0].shape[0])
    return over_population(init_refit, compiler_options=env.compiler_options)(
        keys, egos, partners, styles
    )


def best_response_refits(
    env: Environment, training: PPOConfig, key: jax.Array, egos: Player, everyone: Policy
) -> TrainState:
    """Starts the refits of which the archive is chosen.

    Args:
        env: the environment.
        training: settings of the refits: one of `PartnersConfig.refits`.
        key: consumed.
        egos: where the refits start, leading axes [style, seed]: the egos that learnt beside the
            training partners, or `copies` of the universal ego as it plays with each style.
        everyone: the partners of each style (`teachers`), leading axes [style, teacher].

    Returns:
        Training states, leading axis [style * seed].

    Raises:
        ValueError: the partners cannot share the games in equal parts.
    """
    times, count = (jax.tree.leaves(players)[0].shape[1] for players in (egos, everyone))
    ppo.expect_equal_shares(
        "partners.refit", training, count, "partners of a style, mirror images included"
    )
    partners = copies(everyone, times)
    return init_refits(
        env, training, key, flatten(egos), flatten(partners), repeat_styles(env, times)
    )


def best_egos(egos: Player, returns: np.ndarray) -> tuple[Player, np.ndarray]:
    """Keeps one start for each style, and of it the egos that are as good as its best.

    Of starts whose best egos are as good (`AS_GOOD`) the last one, which has met most partners:
    returns with partners that it has learnt with say little of those that it will meet. All egos of
    a style have the same start, so that they stay alike. One that learnt something lesser and earns
    clearly less than the best is no best response; a copy of the best takes its place.

    Args:
        egos: refitted egos, leading axes [style, start * seed].
        returns: mean return of each with the style's partners, [style, start, seed].

    Returns:
        The kept egos, leading axes [style, seed], and their places among the given ones,
        int [style, seed].
    """
    styles, _, seeds = returns.shape
    by_start = returns.max(axis=2)
    start = _last_as_good(by_start)
    of_start = returns[np.arange(styles), start]
    best = start * seeds + of_start.argmax(axis=1)
    own_place = start[:, None] * seeds + np.arange(seeds)
    kept = np.where(_as_good(of_start), own_place, best[:, None])
    return take_seeds(egos, kept), kept


def choose_universal(returns: np.ndarray, variants: int) -> tuple[np.ndarray, np.ndarray]:
    """Which universal ego to refit for each style.

    The one that is told the style (`universal.VARIANTS` has it last), unless it earns clearly less
    than the one that is not: that one plays alike with all styles, and so would what is generated.

    Args:
        returns: mean return of each ego with each style's partners, [style, variant * seed].
        variants: how many there are.

    Returns:
        The place of the best ego of the chosen variant, int [style], and the variant, int [style].
    """
    by_variant = returns.reshape(len(returns), variants, -1)
    variant = _last_as_good(by_variant.max(axis=2))
    of_variant = by_variant[np.arange(len(returns)), variant]
    return variant * of_variant.shape[1] + of_variant.argmax(axis=1), variant


def _last_as_good(returns: np.ndarray) -> np.ndarray:
    """The last of each row's returns that counts as good as the highest, int [style]."""
    return returns.shape[1] - 1 - _as_good(returns)[:, ::-1].argmax(axis=1)


def _as_good(returns: np.ndarray) -> np.ndarray:
    """Which of each row's returns count as good as its highest, bool [style, n]."""
    highest = returns.max(axis=1, keepdims=True)
    return returns >= highest - (1 - AS_GOOD) * np.abs(highest)


def oracle_refits(
    env: Environment,
    config: PartnersConfig,
    key: jax.Array,
    population: Population,
    archived: Player,
) -> TrainState:
    """Starts the Oracle's candidates, leading axis [style * held_out_seeds * candidates].

    The candidates of a held-out partner are its own ego and archived best responses of its
    style (in turn), so that no archived ego can beat the Oracle but by chance.

    Args:
        env: the environment.
        config: how many candidates.
        key: consumed.
        population: the held-out partners and their egos.
        archived: the refitted egos, leading axes [style, train_seeds].
    """
    others = config.oracle_candidates - 1
    seeds = config.held_out_seeds
    chosen = (np.arange(seeds)[:, None] + np.arange(others)) % config.train_seeds

    def candidates(own: jax.Array, archive: jax.Array) -> jax.Array:
        return jnp.concatenate([own[:, :, None], archive[:, chosen]], axis=2)

    egos = jax.tree.map(candidates, population.held_out_egos, archived)
    partners = jax.tree.map(
        lambda leaf: jnp.repeat(leaf[:, :, None, None], config.oracle_candidates, axis=2),
        population.held_out_partners,
    )
    return init_refits(
        env,
        config.oracle,
        key,
        flatten(flatten(egos)),
        flatten(flatten(partners)),
        repeat_styles(env, seeds * config.oracle_candidates),
    )
