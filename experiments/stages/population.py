"""Partners of every style: trained in pairs, the best kept."""

import itertools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.progress import StageProgress
from experiments.stages.context import Run
from experiments.training import Saver, train_population
from haland_jax import checkpoint, partners
from haland_jax.networks import Policy
from haland_jax.partners import Player, Population

CURVE_POINTS = 40


def make_partners(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1a: trains pairs of every style and seed together and keeps the best."""
    config, env = run.config.partners, run.env
    train_key, play_key = jax.random.split(run.key("partners"))
    players, curve = train_population(
        env,
        config.joint,
        lambda: partners.init_pairs(env, config.joint, config.num_seeds, train_key),
        partners.repeat_styles(env, config.num_seeds),
        Saver(run.path("partners", "unfinished")),
        task.update,
        "partners",
        updates_per_piece=config.updates_together or None,
        between=partners.compile_moving_on(env, config) if config.updates_together else None,
    )
    returns = mean_returns(
        run, play_key, players.ego.actor, players.partner.actor, config.num_seeds
    )
    population = partners.make_population(env, config, players, returns)
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


def population_shapes(run: Run) -> Population:
    """What `make_partners` keeps, as `jax.ShapeDtypeStruct`s."""
    config, env = run.config.partners, run.env
    start = partial(partners.init_pairs, env, config.joint, config.num_seeds)
    shapes = jax.eval_shape(start, jax.random.key(0))

    styles = len(env.style_names)

    def by_style(tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(
                (styles, config.num_seeds, *leaf.shape[1:]), leaf.dtype
            ),
            tree,
        )

    shape: Any = jax.ShapeDtypeStruct
    return Population(
        partners=by_style(shapes.partner.actor),
        egos=by_style(jax.eval_shape(Player.of, shapes.ego)),
        joint_returns=shape((styles, config.num_seeds), jnp.float32),
        train_index=shape((styles, config.train_seeds), jnp.int32),
        held_out_index=shape((styles, config.held_out_seeds), jnp.int32),
        known_index=shape((styles, config.known_seeds), jnp.int32),
    )


def load_population(run: Run) -> Population:
    """The partners that `make_partners` kept."""
    return checkpoint.restore(run.path("partners", "population"), population_shapes(run))


def mean_returns(
    run: Run, key: jax.Array, egos: Policy, partner_policies: Policy, seeds: int
) -> np.ndarray:
    """Mean return of each pair [style * seeds], as [style, seeds]."""
    env = run.env
    play = partners.compile_evaluation(env, run.config.partners.evaluation_games)
    keys = jax.random.split(key, len(env.style_names) * seeds)
    games = play(keys, egos, partner_policies, partners.repeat_styles(env, seeds))
    return np.asarray(games.returns.mean(axis=1)).reshape(len(env.style_names), seeds)
