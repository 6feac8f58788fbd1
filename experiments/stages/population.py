"""Partners, best responses and what they do: the data that the method learns from."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

import envs
from experiments.progress import StageProgress
from experiments.stages.context import Run
from experiments.training import Saver, train_population
from haland_jax import checkpoint, partners, task_language
from haland_jax.networks import Policy
from haland_jax.partners import Player, Population
from haland_jax.task_language import TaskLanguage

CURVE_POINTS = 40


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


def make_partners(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1a: trains pairs of every style and seed together and keeps the best."""
    config, env = run.config.partners, run.env
    train_key, play_key = jax.random.split(run.key("partners"))
    state, curve = train_population(
        env,
        config.joint,
        lambda: partners.init_pairs(env, config, train_key),
        partners.repeat_styles(env, config.num_seeds),
        Saver(run.path("partners", "unfinished")),
        task.update,
        "partners",
    )
    returns = _mean_returns(run, play_key, state.ego.actor, state.partner.actor, config.num_seeds)
    population = partners.make_population(env, config, state, returns)
    checkpoint.save(run.path("partners", "population"), population)
    points = np.linspace(0, len(curve), min(CURVE_POINTS, len(curve)) + 1).astype(int)
    smooth = [curve[a:b].mean(0) for a, b in itertools.pairwise(points)]
    by_style = np.array(smooth).reshape(len(smooth), len(env.style_names), -1)
    return {
        "joint_returns": dict(zip(env.style_names, returns.tolist(), strict=True)),
        "kept_for_training": np.asarray(population.train_index),
        "kept_held_out": np.asarray(population.held_out_index),
        "curve_steps": points[1:] * config.joint.steps_per_update,
        "curve_returns": {name: by_style[:, index].T for index, name in enumerate(env.style_names)},
    }


def load_population(run: Run) -> Population:
    """The partners that `make_partners` kept."""
    config, env = run.config.partners, run.env
    shapes = jax.eval_shape(lambda key: partners.init_pairs(env, config, key), jax.random.key(0))

    def seeds(tree: Any, count: int) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(
                (len(env.style_names), count, *leaf.shape[1:]), leaf.dtype
            ),
            tree,
        )

    egos = Player(shapes.ego.actor, shapes.ego.critic)
    train, held_out = config.train_seeds, config.held_out_seeds
    styles = len(env.style_names)
    shape: Any = jax.ShapeDtypeStruct
    like = Population(
        train_partners=seeds(shapes.partner.actor, train),
        held_out_partners=seeds(shapes.partner.actor, held_out),
        train_egos=seeds(egos, train),
        held_out_egos=seeds(egos, held_out),
        joint_returns=shape((styles, config.num_seeds), jnp.float32),
        train_index=shape((styles, train), jnp.int32),
        held_out_index=shape((styles, held_out), jnp.int32),
    )
    return checkpoint.restore(run.path("partners", "population"), like)


def make_best_responses(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1b: refits the egos, which become the archive, and finds the Oracles."""
    config, env = run.config.partners, run.env
    population = load_population(run)
    refit_key, oracle_key, play_key = jax.random.split(run.key("best_responses"), 3)
    refitted, _ = train_population(
        env,
        config.refit,
        lambda: partners.best_response_refits(env, config, refit_key, population),
        partners.repeat_styles(env, config.train_seeds),
        Saver(run.path("best_responses", "unfinished_refits")),
        task.update,
        "best responses",
    )
    num_styles = len(env.style_names)
    egos = partners.unflatten(Player(refitted.ego.actor, refitted.ego.critic), num_styles)
    candidates = config.held_out_seeds * config.oracle_candidates
    offset = config.refit.num_updates
    trained, _ = train_population(
        env,
        config.oracle,
        lambda: partners.oracle_refits(env, config, oracle_key, population, egos),
        partners.repeat_styles(env, candidates),
        Saver(run.path("best_responses", "unfinished_oracles")),
        lambda done, metrics: task.update(offset + done, metrics),
        "oracles",
    )
    repeated = jax.tree.map(
        lambda leaf: jnp.repeat(leaf, config.oracle_candidates, axis=1),
        population.held_out_partners,
    )
    returns = _mean_returns(
        run, play_key, trained.ego.actor, partners.flatten(repeated), candidates
    ).reshape(num_styles, config.held_out_seeds, config.oracle_candidates)
    best = returns.argmax(axis=2)
    actors = jax.tree.map(
        lambda leaf: leaf.reshape(*returns.shape, *leaf.shape[1:]), trained.ego.actor
    )
    rows, columns = np.indices(best.shape)
    archive = Archive(
        egos=egos,
        oracles=jax.tree.map(lambda leaf: leaf[rows, columns, best], actors),
        oracle_returns=jnp.asarray(returns, jnp.float32),
    )
    checkpoint.save(run.path("best_responses", "archive"), archive)
    return {"oracle_candidate_returns": returns}


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


def _mean_returns(
    run: Run, key: jax.Array, egos: Policy, partner_policies: Policy, seeds: int
) -> np.ndarray:
    """Mean return of each pair [style * seeds], as [style, seeds]."""
    env = run.env
    play = partners.compile_evaluation(env, run.config.partners.evaluation_games)
    keys = jax.random.split(key, len(env.style_names) * seeds)
    games = play(keys, egos, partner_policies, partners.repeat_styles(env, seeds))
    return np.asarray(games.returns.mean(axis=1)).reshape(len(env.style_names), seeds)
