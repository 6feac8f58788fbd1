"""Universal egos, which say how much knowing the style is worth."""

from typing import Any

import jax

from envs.base import Environment
from envs.labelled import Labelled
from experiments.progress import StageProgress
from experiments.stages.context import Run
from experiments.stages.population import load_population
from experiments.training import Saver, curves_of, train_population
from haland_jax import checkpoint, mirrors, universal
from haland_jax.learner import TrainState
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
    training = config.training
    players, returns = train_population(
        env,
        training,
        lambda: _start(run, env),
        universal.member_styles(env, config.seeds),
        Saver(run.path(stage, "unfinished")),
        task.update,
        "universal egos",
    )
    checkpoint.save(run.path(stage, "egos"), players.ego)
    steps = training.num_updates * training.steps_per_update
    return {
        "steps": steps,
        "guided_steps": int(training.guidance_until * steps) if training.guidance else 0,
        "seeds": config.seeds,
        **curves_of(training, universal.VARIANTS, returns),
    }


def _start(run: Run, env: Labelled) -> TrainState:
    """The egos before they learn; the egos of pairs guide them, where anybody does."""
    config, population = run.config.universal, load_population(run)
    teachers = mirrors.teachers(run.env, run.config.partners, population)
    guides = population.best_train_egos.actor if config.training.guidance else None
    return universal.init_universal(env, config, run.key(STAGE), teachers, guides)


def load_universal(run: Run) -> dict[str, Player]:
    """By variant, the egos as they play with each style, leading axes [style, seed]."""
    return load_universal_in(run, run.env, STAGE)


def load_universal_in(run: Run, game: Environment, stage: str) -> dict[str, Player]:
    """The same for the egos of `train_universal_in`."""
    env = Labelled(game)
    like = jax.eval_shape(lambda: Player.of(_start(run, env).ego))
    egos = checkpoint.restore(run.path(stage, "egos"), like)
    return universal.players_by_style(env, egos)
