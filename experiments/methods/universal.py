"""The paper's universal egos with a memory: General, Instructed and Adaptive Ego (App. C.3)."""

import dataclasses
import itertools

import jax
import numpy as np

from experiments.configs import RunConfig
from experiments.methods.base import Given, MakeEgo, Told, Trained
from experiments.stages import Run
from experiments.training import train_in_pieces
from experiments.worth import steps_in_words
from haland_jax import recurrent_ppo
from haland_jax.ppo_loss import PPOConfig
from haland_jax.recurrent_egos import ADAPTIVE, GENERAL, INSTRUCTED, VARIANTS, UniversalEgo

CURVE_POINTS = 40
KNOWS = {
    GENERAL: "told nothing",
    INSTRUCTED: "told the style",
    ADAPTIVE: "told the partner's last action",
}
"""What each ego knows besides what it sees."""


def recurrent_config(config: RunConfig, steps: int) -> PPOConfig:
    """Settings of an ego with a memory, from those of the run's feed-forward universal egos.

    One pass in many minibatches at twice the rate: of what was tried with 4 M steps, that earned
    most, in the least time (docs/paper_map.md).

    Raises:
        ValueError: too few steps.
    """
    return dataclasses.replace(
        config.universal.training,
        total_steps=steps,
        epochs=1,
        num_minibatches=16,
        learning_rate=2e-3,
    )


class RecurrentEgos:
    """All three of them, which learn in one program."""

    budgeted = True

    def num_updates(self, run: Run, steps: int) -> int:
        """Updates of each."""
        return recurrent_config(run.config, steps).num_updates

    def train(self, given: Given) -> Trained:
        """Trains them by PPO with the partners of all styles together, one partner a game."""
        env, training = given.env, recurrent_config(given.run.config, given.steps)
        state, returns = train_in_pieces(
            training,
            recurrent_ppo.init_recurrent(env, training, given.key, given.partners, given.seeds),
            lambda updates: recurrent_ppo.compile_recurrent(env, training, updates),
            given.saver(f"{training.num_updates}_updates_{given.seeds}_seeds"),
            given.task.update,
            "universal egos with a memory",
        )
        actors = recurrent_ppo.raw_actors(state)
        given.keep(actors)
        egos = recurrent_ppo.egos_by_style(env, actors)
        steps = training.num_updates * training.steps_per_update
        what = "one ego with a memory for all styles, {}, " + f"{steps_in_words(steps)} steps"
        points = curve_points(len(returns))
        return Trained(
            egos={name: _in_turn(agents, given.seeds) for name, agents in egos.items()},
            descriptions={name: what.format(knows) for name, knows in KNOWS.items()},
            steps=steps,
            notes={
                "curve_steps": points[1:] * training.steps_per_update,
                "curve_returns": {
                    name: smooth(returns, points)[index * given.seeds : (index + 1) * given.seeds]
                    for index, name in enumerate(VARIANTS)
                },
            },
        )


def curve_points(updates: int) -> np.ndarray:
    """Updates between which a learning curve is averaged, with 0 and the last one."""
    return np.linspace(0, updates, min(CURVE_POINTS, updates) + 1).astype(int)


def smooth(returns: np.ndarray, points: np.ndarray) -> np.ndarray:
    """A learning curve [update, member] averaged between points, [member, point]."""
    return np.array([returns[a:b].mean(axis=0) for a, b in itertools.pairwise(points)]).T


def _in_turn(agents: UniversalEgo, seeds: int) -> MakeEgo:
    """Gives trained egos, leading axes [style, seed], one after the other."""

    def make(told: Told, key: jax.Array) -> UniversalEgo:
        del key
        return jax.tree.map(lambda leaf: leaf[told.style, told.number % seeds], agents)

    return make
