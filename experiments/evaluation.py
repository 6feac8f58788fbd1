"""What is measured: every method's return with partners that no method has met.

Returns are means over games and over the policies that a method offers for a style; they are
given by style and held-out seed, so that any statistic can be computed later.
"""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.gates import gates, policy_vae_gate
from experiments.judge import Judge, Scores, by_style, over_egos
from experiments.progress import StageProgress
from experiments.stages import (
    Run,
    load_archive,
    load_haland,
    load_population,
    load_task_language,
    load_universal,
    load_vae,
)
from experiments.summary import BEST_RESPONSE, COMPARISONS, ORACLE
from experiments.summary import HEADLINE as TEST_SENTENCES
from experiments.summary import WRONG as WRONG_SENTENCE
from haland_jax import partners, policy_vae
from haland_jax.deployment import Haland
from haland_jax.networks import Policy

RECONSTRUCTION = "VAE reconstruction"
TRUE_LANGUAGE = "Diffusion, true task language"
TRAINING_SENTENCES = "Haland, training sentences"


def evaluate(run: Run, task: StageProgress) -> dict[str, Any]:
    """Measures every method; returns what `results.json` is made of."""
    config, env = run.config.evaluation, run.env
    population, archive = load_population(run), load_archive(run)
    run.expect_learnt_sentences()
    haland = load_haland(run)
    language = load_task_language(run)
    judge = Judge(env, config.games, config.batch)
    key = jax.random.fold_in(jax.random.key(run.config.seed), 1000)
    keys = iter(jax.random.split(key, 16))
    styles, held_out = len(env.style_names), population.held_out_partners
    egos: dict[str, Policy] = {
        ORACLE: archive.oracles,
        BEST_RESPONSE: archive.egos.actor,
    }
    vae, vae_params, posterior = load_vae(run)
    decoded = policy_vae.decode(vae, vae_params, posterior.mean)
    egos[RECONSTRUCTION] = partners.unflatten(decoded, styles)
    samples = jnp.repeat(language.v_hat, 4 * config.samples, axis=0)
    egos[TRUE_LANGUAGE], _ = _generate(haland, next(keys), samples, styles)
    instructions = run.instructions()
    spoken = {
        TRAINING_SENTENCES: [list(style.training_sample()) for style in instructions.values()],
        TEST_SENTENCES: [list(style.test) for style in instructions.values()],
    }
    translated, latents = {}, {}
    for method, sentences in spoken.items():
        translated[method] = translate_by_style(haland, sentences)
        repeated = jnp.repeat(translated[method], config.samples, axis=1)
        egos[method], latents[method] = _generate(
            haland, next(keys), repeated.reshape(-1, repeated.shape[-1]), styles
        )
    results: dict[str, Scores] = {}
    for index, (method, policies) in enumerate(egos.items()):
        if method == ORACLE:
            results[method] = _own_partner(judge, next(keys), policies, held_out)
        else:
            results[method] = over_egos(judge.with_held_out(next(keys), policies, held_out))
        task.update(index + 1)
    results[WRONG_SENTENCE] = wrong_sentences(judge, next(keys), egos[TEST_SENTENCES], held_out)
    cross = cross_play(judge, next(keys), archive.egos.actor, held_out)
    right = nearest_is_right(haland, translated[TEST_SENTENCES])
    upper_bounds = env.upper_bounds()
    gate = policy_vae_gate(run, judge, next(keys))
    for method, players in zip(COMPARISONS, load_universal(run).values(), strict=True):
        results[method] = over_egos(judge.with_held_out(next(keys), players.actor, held_out))
        task.update(task.done + 1)
    return {
        "methods": {
            method: by_style(scores, env.style_names) for method, scores in results.items()
        },
        "oracle": dict(zip(env.style_names, results[ORACLE].returns, strict=True)),
        "gates": gates(results, gate, list(upper_bounds.values())),
        "upper_bounds": upper_bounds,
        "policy_vae": gate,
        "translator": {
            "accuracy": float(right.mean()),
            "by_style": dict(zip(env.style_names, right.mean(axis=1).tolist(), strict=True)),
        },
        "cross_play": cross,
        "memorisation": memorisation(posterior.mean, latents[TEST_SENTENCES], haland),
        "generation": time_generation(haland, instructions[env.style_names[0]].test[0]),
        "task_language": {"events": list(language.event_names), "v_hat": language.v_hat},
        "games": config.games,
    }


def translate_by_style(haland: Haland, sentences: Sequence[Sequence[str]]) -> jax.Array:
    """Task language of equally many sentences a style, [style, sentence, U]."""
    flat = [sentence for style in sentences for sentence in style]
    v_hat, _ = haland.translate(flat)
    return v_hat.reshape(len(sentences), -1, v_hat.shape[-1])


def nearest_is_right(haland: Haland, v_hat: jax.Array) -> np.ndarray:
    """Whether each translation is nearest to its own style's task language, [style, sentence]."""
    found = np.asarray(haland.nearest_style(v_hat))
    return found == np.arange(len(found))[:, None]


def _generate(haland: Haland, key: jax.Array, v_hat: jax.Array, styles: int) -> tuple[Policy, Any]:
    """One policy for each row [style * n, U]: policies [style, n], latents [style, n, D]."""
    policies, latents = haland.generate_from_task_language(
        v_hat, jax.random.split(key, v_hat.shape[0])
    )
    return partners.unflatten(policies, styles), partners.unflatten(latents, styles)


def _own_partner(judge: Judge, key: jax.Array, egos: Policy, held_out: Policy) -> Scores:
    """Scores of ego [style, seed] with the held-out partner of the same place."""
    seeds = np.arange(jax.tree.leaves(held_out)[0].shape[1])
    scores = judge.with_held_out(key, egos, held_out)
    return scores.map(lambda values: values[:, seeds, seeds])


def wrong_sentences(judge: Judge, key: jax.Array, egos: Policy, held_out: Policy) -> Scores:
    """Scores with egos made from the sentences of all *other* styles, [style, seed]."""
    styles, count = jax.tree.leaves(egos)[0].shape[:2]
    others = np.array([[j for j in range(styles) if j != i] for i in range(styles)])
    # One ego of each other style, a different one for each style played with.
    chosen = np.arange(styles)[:, None] % count
    wrong = jax.tree.map(lambda leaf: leaf[others, chosen], egos)
    return over_egos(judge.with_held_out(key, wrong, held_out))


def cross_play(judge: Judge, key: jax.Array, egos: Policy, held_out: Policy) -> np.ndarray:
    """Mean return of the best responses to style i with held-out partners of style j, [i, j]."""
    styles, count = jax.tree.leaves(egos)[0].shape[:2]
    everyone = jax.tree.map(
        lambda leaf: jnp.broadcast_to(
            leaf.reshape(1, -1, *leaf.shape[2:]), (styles, styles * count, *leaf.shape[2:])
        ),
        egos,
    )
    returns = judge.with_held_out(key, everyone, held_out).returns.mean(axis=1)
    return returns.reshape(styles, styles, count).mean(axis=2).T


def memorisation(archive: jax.Array, sampled: jax.Array, haland: Haland) -> dict[str, float]:
    """How near generated latents lie to the archive's, in units of its spread.

    Distances are root mean squares over the latent's dimensions, each divided by its standard
    deviation over the archive.
    """
    std = np.asarray(haland.diffusion_params.statistics.std)
    known = np.asarray(archive) / std
    new = np.asarray(sampled).reshape(-1, known.shape[-1]) / std

    def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sqrt(((a[:, None] - b[None]) ** 2).mean(axis=-1))

    among = distances(known, known) + 1e9 * np.eye(len(known))
    return {
        "nearest_training_latent": float(distances(new, known).min(axis=1).mean()),
        "between_training_latents": float(among.min(axis=1).mean()),
    }


def time_generation(haland: Haland, sentence: str) -> dict[str, float]:
    """Milliseconds from a sentence to a policy, compiled; the median of nine."""
    found = {}
    for sampler, times in (("ddim", 9), ("ddpm", 3)):
        jax.block_until_ready(haland.generate(sentence, jax.random.key(0), sampler=sampler))
        taken = []
        for index in range(times):
            start = time.perf_counter()
            jax.block_until_ready(haland.generate(sentence, jax.random.key(index), sampler=sampler))
            taken.append(1000 * (time.perf_counter() - start))
        found[f"{sampler}_milliseconds"] = float(np.median(taken))
    return found
