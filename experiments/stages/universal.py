"""Universal egos, which say how much knowing the style is worth."""

from typing import Any

import jax

from envs.base import Environment
from envs.labelled import Labelled
from experiments.progress import StageProgress
from experiments.stages.context import Run
from experiments.stages.population import load_population
from experiments.training import Saver, curves_of, train_population
from haland_jax import checkpoint, partners, universal
from haland_jax.partners import Player

STAGE = "universal"


def train_universal(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1b: trains egos with the partners of all styles, told the style or not."""
    return train_universal_in(run, run.env, STAGE, task)


def train_universal_in(
    run: Run, game: Environment, stage: str, task: StageProgress
) -> dict[str, Any]:
    """Trains such egos in a variant of the run's environment.

    Args:
        run: whose partners they learn with, but those held out.
        game: the variant; it differs in what the ego sees at most.
        stage: folder of the run that keeps the egos.
        task: the progress.
    """
    config, env = run.config.universal, Labelled(game)
    population = load_population(run)
    teachers = partners.teachers(run.env, run.config.partners, population)
    # Egos of pairs are at a loss where they see less than they are used to.
    guided = config.training.guidance > 0 and game == run.env
    guides = population.best_train_egos.actor if guided else None
    key = run.key(STAGE)
    players, returns = train_population(
        env,
        config.training,
        lambda: universal.init_universal(env, config, key, teachers, guides),
        universal.member_styles(env, config.seeds),
        Saver(run.path(stage, "unfinished")),
        task.update,
        "universal egos",
    )
    checkpoint.save(run.path(stage, "egos"), players.ego)
    return {
        "steps": config.training.num_updates * config.training.steps_per_update,
        "seeds": config.seeds,
        **curves_of(config.training, universal.VARIANTS, returns),
    }


def load_universal(run: Run) -> dict[str, Player]:
    """By variant, the egos as they play with each style, leading axes [style, seed]."""
    return load_universal_in(run, run.env, STAGE)


def load_universal_in(run: Run, game: Environment, stage: str) -> dict[str, Player]:
    """The same for the egos of `train_universal_in`."""
    config, env = run.config.universal, Labelled(game)
    teachers = partners.teachers(run.env, run.config.partners, load_population(run))
    shapes = jax.eval_shape(
        lambda key: universal.init_universal(env, config, key, teachers), jax.random.key(0)
    )
    like = jax.eval_shape(Player.of, shapes.ego)
    egos = checkpoint.restore(run.path(stage, "egos"), like)
    return universal.players_by_style(env, egos)
