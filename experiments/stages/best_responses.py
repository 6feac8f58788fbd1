"""Best responses, Oracles and what they do: the data that the method learns from."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

import envs
from experiments.progress import StageProgress
from experiments.stages.context import Run
from experiments.stages.population import load_population, mean_returns
from experiments.stages.universal import load_universal
from experiments.training import Saver, train_population
from haland_jax import best_responses, checkpoint, mirrors, partners, task_language
from haland_jax.networks import Policy
from haland_jax.partners import Player, Population
from haland_jax.seeds import all_pairs
from haland_jax.task_language import TaskLanguage
from haland_jax.universal import start_variants

OWN, UNIVERSAL = "own ego", "universal ego"
"""Where the refits of best responses start."""
IMAGE = "mirror image of {}"
"""The same of another style's refits, as they look in a mirror."""


class Archive(PyTreeNode):
    """Best responses and the Oracles.

    Attributes:
        egos: refitted egos, leading axes [style, train_seeds].
        oracles: the best ego for each held-out partner, actors [style, held_out_seeds].
        oracle_returns: their mean return in selection games, [style, held_out_seeds, candidate].
    """

    egos: Player
    oracles: Policy
    oracle_returns: jax.Array


def make_best_responses(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1c: refits egos, which become the archive, and finds the Oracles."""
    refit_key, choice_key, oracle_key, play_key = jax.random.split(run.key("best_responses"), 4)
    population = load_population(run)
    egos, chosen = _refit_egos(run, refit_key, choice_key, population, task)
    oracles, returns = _find_oracles(run, oracle_key, play_key, population, egos, task)
    archive = Archive(egos=egos, oracles=oracles, oracle_returns=jnp.asarray(returns, jnp.float32))
    checkpoint.save(run.path("best_responses", "archive"), archive)
    return {**chosen, "oracle_candidate_returns": returns}


def _refit_egos(
    run: Run,
    refit_key: jax.Array,
    choice_key: jax.Array,
    population: Population,
    task: StageProgress,
) -> tuple[Player, dict[str, Any]]:
    """The archive's egos [style, train_seeds], and what each start brought them."""
    config, env = run.config.partners, run.env
    teachers = mirrors.teachers(env, config, population)
    starts, of_universal = {OWN: population.train_egos}, {}
    if config.universal_start:
        key = jax.random.fold_in(choice_key, 1)
        universal, of_universal = _universal_to_refit(run, key, teachers)
        starts[UNIVERSAL] = partners.copies(universal, config.train_seeds)
    refitted: dict[str, Player] = {}
    done = 0
    for (name, egos), training in zip(starts.items(), config.refits, strict=True):
        refit = partial(best_responses.best_response_refits, env, training, refit_key)
        trained, _ = train_population(
            env,
            training,
            partial(refit, egos, teachers),
            partners.repeat_styles(env, config.train_seeds),
            Saver(run.path("best_responses", f"unfinished_refits_of_{name.replace(' ', '_')}")),
            lambda updates, metrics, before=done: task.update(before + updates, metrics),
            f"best responses from the {name}",
        )
        own = partners.unflatten(trained.ego, len(env.style_names))
        refitted |= _images(run, name, own) | {name: own}
        done += training.num_updates
    egos = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *refitted.values())
    returns = _returns_with_all(run, choice_key, egos.actor, teachers).reshape(
        len(env.style_names), len(refitted), config.train_seeds
    )
    kept, places = best_responses.best_egos(egos, returns)
    names, chosen = list(refitted), places[:, 0] // config.train_seeds
    return kept, {
        "starts": {style: names[i] for style, i in zip(env.style_names, chosen, strict=True)},
        "start_returns": {name: returns[:, index] for index, name in enumerate(names)},
        "kept_egos": places % config.train_seeds,
        **of_universal,
    }


def _images(run: Run, start: str, egos: Player) -> dict[str, Player]:
    """What refits [style, seed] are for other styles in the mirrors, where they learnt with images.

    An ego may have found out what its image has not, at no cost in steps.
    """
    if not run.config.partners.mirror:
        return {}
    images = [mirrors.egos_seen_in(mirror, egos) for mirror in run.env.symmetries]
    name = IMAGE.format(start)
    numbers = [""] if len(images) == 1 else [f" {i + 1}" for i in range(len(images))]
    return {f"{name}{number}": one for number, one in zip(numbers, images, strict=True)}


def _universal_to_refit(
    run: Run, key: jax.Array, teachers: Policy
) -> tuple[Player, dict[str, Any]]:
    """The universal ego to refit for each style, leading axis [style], and which it is."""
    trained = load_universal(run)
    by_variant = {name: trained[name] for name in start_variants(run.config.partners)}
    egos = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *by_variant.values())
    returns = _returns_with_all(run, key, egos.actor, teachers)
    best, variant = best_responses.choose_universal(returns, len(by_variant))
    names = list(by_variant)
    chosen = {style: names[i] for style, i in zip(run.env.style_names, variant, strict=True)}
    return (
        jax.tree.map(lambda leaf: leaf[np.arange(len(best)), best], egos),
        {"universal_starts": chosen, "universal_start_returns": returns},
    )


def _returns_with_all(run: Run, key: jax.Array, egos: Policy, teachers: Policy) -> np.ndarray:
    """Mean return of each ego [style, ego] with all its style's teachers [style, teacher]."""
    count, times = (jax.tree.leaves(players)[0].shape[1] for players in (teachers, egos))
    each, everyone = all_pairs(egos, teachers)
    returns = mean_returns(run, key, each, everyone, times * count)
    return returns.reshape(-1, count, times).mean(axis=1)


def _find_oracles(
    run: Run,
    oracle_key: jax.Array,
    play_key: jax.Array,
    population: Population,
    egos: Player,
    task: StageProgress,
) -> tuple[Policy, np.ndarray]:
    """The best ego for each held-out partner [style, seed], and all candidates' returns."""
    config, env = run.config.partners, run.env
    num_styles, offset = len(env.style_names), config.refit_updates
    candidates = config.held_out_seeds * config.oracle_candidates
    trained, _ = train_population(
        env,
        config.oracle,
        lambda: best_responses.oracle_refits(env, config, oracle_key, population, egos),
        partners.repeat_styles(env, candidates),
        Saver(run.path("best_responses", "unfinished_oracles")),
        lambda done, metrics: task.update(offset + done, metrics),
        "oracles",
    )
    repeated = jax.tree.map(
        lambda leaf: jnp.repeat(leaf, config.oracle_candidates, axis=1),
        population.held_out_partners,
    )
    returns = mean_returns(
        run, play_key, trained.ego.actor, partners.flatten(repeated), candidates
    ).reshape(num_styles, config.held_out_seeds, config.oracle_candidates)
    best = returns.argmax(axis=2)
    actors = jax.tree.map(
        lambda leaf: leaf.reshape(*returns.shape, *leaf.shape[1:]), trained.ego.actor
    )
    rows, columns = np.indices(best.shape)
    return jax.tree.map(lambda leaf: leaf[rows, columns, best], actors), returns


def load_archive(run: Run) -> Archive:
    """The best responses and Oracles that `make_best_responses` kept."""
    config = run.config.partners
    population = load_population(run)
    shape = (len(run.env.style_names), config.held_out_seeds, config.oracle_candidates)
    like = Archive(
        egos=population.train_egos,
        oracles=population.held_out_egos.actor,
        oracle_returns=jnp.zeros(shape),
    )
    return checkpoint.restore(run.path("best_responses", "archive"), like)


def make_task_language(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 2: what tells the styles apart, as frequencies of events or as labels."""
    times = run.config.partners.train_seeds
    if run.env.task_language_source == "labels":
        language = task_language.build_label_language(len(run.env.style_names), times)
    else:
        language = _count_events(run)
    task.update(1)
    checkpoint.save(
        run.path("task_language", "language"),
        {"v_hat": language.v_hat, "by_seed": language.v_hat_by_seed, "scale": language.scale},
        {"events": list(language.event_names), "dropped": list(language.dropped_event_names)},
    )
    return {"events": len(language.event_names), "dropped": len(language.dropped_event_names)}


def _count_events(run: Run) -> TaskLanguage:
    """Counts events in games of the best responses with their training partners."""
    env, games = run.env, run.config.task_language_games
    population, archive = load_population(run), load_archive(run)
    times = run.config.partners.train_seeds
    play = partners.compile_evaluation(env, games)
    keys = jax.random.split(run.key("task_language"), len(env.style_names) * times)
    played = play(
        keys,
        partners.flatten(archive.egos.actor),
        partners.flatten(population.train_partners),
        partners.repeat_styles(env, times),
    )
    counts = partners.unflatten(played.events, len(env.style_names))
    lengths = partners.unflatten(played.lengths, len(env.style_names))
    names = task_language.agent_event_names(env.event_names, envs.AGENTS)
    return task_language.build_task_language(
        task_language.event_frequencies(counts, lengths), names
    )


def load_task_language(run: Run) -> TaskLanguage:
    """What `make_task_language` counted."""
    path = run.path("task_language", "language")
    arrays, names = checkpoint.restore(path), checkpoint.read_metadata(path)
    return TaskLanguage(
        v_hat=jnp.asarray(arrays["v_hat"]),
        v_hat_by_seed=jnp.asarray(arrays["by_seed"]),
        scale=jnp.asarray(arrays["scale"]),
        event_names=tuple(names["events"]),
        dropped_event_names=tuple(names["dropped"]),
    )
