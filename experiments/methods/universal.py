"""Universal egos: the paper's, with a memory (App. C.3), and the same without one.

The paper's General, Instructed and Adaptive Ego remember, which makes their steps several times as
long as those of egos without a memory.
"""

import dataclasses

import jax

from envs.labelled import Labelled
from experiments.configs import RunConfig
from experiments.methods.base import Given, MakeEgo, Told, Trained
from experiments.stages import Run
from experiments.training import curves_of, train_in_pieces, train_population
from experiments.worth import steps_in_words
from haland_jax import recurrent_ppo, universal
from haland_jax.networks import Policy
from haland_jax.ppo_loss import PPOConfig
from haland_jax.recurrent_egos import ADAPTIVE, GENERAL, INSTRUCTED, VARIANTS, UniversalEgo
from haland_jax.rollout import Agent
from haland_jax.universal import TOLD_NOTHING, TOLD_THE_STYLE

GENERAL_MLP, INSTRUCTED_MLP = f"{GENERAL} (MLP)", f"{INSTRUCTED} (MLP)"
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
    """The three with a memory, which learn in one program."""

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
            given.saver_of(training),
            given.task.update,
            "universal egos with a memory",
        )
        actors = recurrent_ppo.raw_actors(state)
        given.keep(actors)
        egos = recurrent_ppo.egos_by_style(env, actors)
        steps = training.num_updates * training.steps_per_update
        what = "one ego with a memory for all styles, {}, " + f"{steps_in_words(steps)} steps"
        return Trained(
            egos={name: one_after_another(agents, given.seeds) for name, agents in egos.items()},
            descriptions={name: what.format(knows) for name, knows in KNOWS.items()},
            steps=steps,
            notes=curves_of(training, VARIANTS, returns),
        )


class FeedForwardEgos:
    """A General and an Instructed Ego without a memory: the run's universal egos, for `steps`.

    Nobody guides them (`PPOConfig.guidance`): what they know they have found out for themselves.
    """

    budgeted = True

    def num_updates(self, run: Run, steps: int) -> int:
        """Updates of each."""
        return self._training(run.config, steps).num_updates

    def train(self, given: Given) -> Trained:
        """Trains them by PPO with the partners of all styles together."""
        env, training = Labelled(given.env), self._training(given.run.config, given.steps)
        config = dataclasses.replace(
            given.run.config.universal, seeds=given.seeds, training=training
        )
        players, returns = train_population(
            env,
            training,
            lambda: universal.init_universal(env, config, given.key, given.partners),
            universal.member_styles(env, given.seeds),
            given.saver_of(training),
            given.task.update,
            "universal egos without a memory",
        )
        given.keep(players.ego)
        by_variant = universal.players_by_style(env, players.ego)
        egos = {
            GENERAL_MLP: by_variant[TOLD_NOTHING].actor,
            INSTRUCTED_MLP: by_variant[TOLD_THE_STYLE].actor,
        }
        steps = training.num_updates * training.steps_per_update
        what = "one ego without a memory for all styles, {}, " + f"{steps_in_words(steps)} steps"
        told = {GENERAL_MLP: KNOWS[GENERAL], INSTRUCTED_MLP: KNOWS[INSTRUCTED]}
        return Trained(
            egos={name: one_after_another(actors, given.seeds) for name, actors in egos.items()},
            descriptions={name: what.format(knows) for name, knows in told.items()},
            steps=steps,
            notes=curves_of(training, tuple(told), returns),
        )

    def _training(self, config: RunConfig, steps: int) -> PPOConfig:
        return dataclasses.replace(config.universal.training, total_steps=steps, guidance=0.0)


def one_after_another(egos: Policy | UniversalEgo, seeds: int) -> MakeEgo:
    """Gives trained egos, leading axes [style, seed], one after the other."""

    def make(told: Told, key: jax.Array) -> Policy | Agent:
        del key
        return jax.tree.map(lambda leaf: leaf[told.style, told.number % seeds], egos)

    return make
