"""The gates of a run: the bars that each stage sets itself, with what was measured.

A missed gate bounds everything that is built on its stage.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.judge import Judge, Scores
from experiments.stages import Run, load_archive, load_population, load_vae
from experiments.summary import (
    BEST_RESPONSE,
    HEADLINE,
    MOST_FROM_A_WRONG_SENTENCE,
    ORACLE,
    WRONG,
    mean,
    shares,
)
from haland_jax import partners, policy_vae

GATE_PERTURBATION = 0.1


def gates(
    results: Mapping[str, Scores], vae: Mapping[str, Any], upper_bounds: Sequence[float]
) -> dict[str, Any]:
    """The bars that the method sets itself, with what was measured.

    Where games can succeed, the Oracle is held against success and not against an upper bound,
    and Haland against the Oracle's successes too.

    Args:
        results: scores by method, each [style, seed].
        vae: what `policy_vae_gate` measured.
        upper_bounds: a return that nobody can exceed, by style.
    """
    oracle = results[ORACLE].returns

    def at_least(value: float, bar: float) -> dict[str, Any]:
        return {"value": value, "bar": bar, "met": bool(value >= bar)}

    def at_most(value: float, bar: float) -> dict[str, Any]:
        return {"value": value, "bar": bar, "at_most": True, "met": bool(value <= bar)}

    share = {method: _mean_share(scores.returns, oracle) for method, scores in results.items()}
    by_style = _finite_shares(results[BEST_RESPONSE].returns.mean(axis=1), oracle.mean(axis=1))
    succeeded = results[ORACLE].successes
    if succeeded is None:
        lowest = float((oracle.mean(axis=1) / np.asarray(upper_bounds)).min())
        first = {"Oracle / upper bound, lowest style": at_least(lowest, 0.75)}
        last = {}
    else:
        success = {
            method: _mean_share(scores.successes, succeeded)
            for method, scores in results.items()
            if scores.successes is not None
        }
        lowest = float(succeeded.mean(axis=1).min())
        first = {"Oracle, games that succeed, lowest style": at_least(lowest, 0.8)}
        last = {
            "Haland from test sentences / Oracle, games that succeed": at_least(
                success[HEADLINE], 0.90
            ),
            "Haland from a wrong sentence / Oracle, games that succeed": at_most(
                success[WRONG], MOST_FROM_A_WRONG_SENTENCE
            ),
        }
    return {
        **first,
        "best responses / Oracle, mean": at_least(share[BEST_RESPONSE], 0.90),
        "best responses / Oracle, lowest style": at_least(float(by_style.min()), 0.75),
        "decoded / original policy, lowest": at_least(float(np.min(vae["decoded_share"])), 0.95),
        "decoded / original policy, z perturbed, lowest": at_least(
            float(np.min(vae["perturbed_share"])), 0.95
        ),
        "Haland from test sentences / Oracle": at_least(share[HEADLINE], 0.90),
        "Haland from a wrong sentence / Oracle": at_most(share[WRONG], MOST_FROM_A_WRONG_SENTENCE),
        **last,
    }


def policy_vae_gate(run: Run, judge: Judge, key: jax.Array) -> dict[str, Any]:
    """Whether decoded policies earn what their originals earn, with training partners.

    Returns:
        Shares of the original's return, decoded / original: the mean and the lowest over the
        archive, as decoded and with z perturbed by 0.1 of the latents' standard deviation.
    """
    population, archive = load_population(run), load_archive(run)
    vae, params, posterior = load_vae(run)
    times, env = run.config.partners.train_seeds, run.env
    play_key, noise_key = jax.random.split(key)
    originals = partners.flatten(archive.egos.actor)
    perturbed = policy_vae.perturb(noise_key, posterior.mean, GATE_PERTURBATION)
    versions = {
        "original": originals,
        "decoded": policy_vae.decode(vae, params, posterior.mean),
        "perturbed": policy_vae.decode(vae, params, perturbed),
    }
    repeats = max(1, run.config.compression.gate_games // run.config.evaluation.games)
    everyone = jax.tree.map(
        lambda leaf: jnp.tile(leaf, (1, repeats) + (1,) * (leaf.ndim - 2)),
        population.train_partners,
    )
    earned = {}
    for name, policies in versions.items():
        by_style = partners.unflatten(policies, len(env.style_names))
        returns = judge.with_held_out(play_key, by_style, everyone).returns
        earned[name] = returns.mean(axis=1)
    kept = {
        name: _finite_shares(earned[name], earned["original"]) for name in ("decoded", "perturbed")
    }
    return {
        "partners": times,
        "games": repeats * run.config.evaluation.games,
        "original_returns": earned["original"],
        **{f"{name}_share": share for name, share in kept.items()},
    }


def _finite_shares(returns: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """returns / reference; 0, which meets no bar, where the reference earns nothing."""
    return np.nan_to_num(shares(returns, reference))


def _mean_share(returns: np.ndarray, oracle: np.ndarray) -> float:
    """Mean of return / Oracle; 0, which meets no bar, where no Oracle earns anything."""
    return mean(shares(returns, oracle)) if (oracle > 0).any() else 0.0
