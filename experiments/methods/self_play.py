"""Two more universal egos: self-play, and fictitious co-play (FCP)."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from experiments.methods.base import Given, MakeEgo, Told, Trained
from experiments.stages import Run
from experiments.training import curves_of, train_population
from experiments.worth import steps_in_words
from haland_jax import checkpoint, self_play
from haland_jax.learner import TrainState
from haland_jax.networks import Policy
from haland_jax.partners import trained_players
from haland_jax.ppo_loss import PPOConfig

SELF_PLAY, FCP = "Self-play", "FCP"
POOL = 3
"""Pairs of self-play whose partners make FCP's pool, each at `MOMENTS`."""
MOMENTS = ("start", "middle", "end")


def training_config(run: Run, steps: int, sharing: int) -> PPOConfig:
    """Settings as of the run's feed-forward universal egos, for games that some share equally.

    Args:
        run: the run.
        steps: environment steps.
        sharing: how many share the games.

    Raises:
        ValueError: too few steps.
    """
    training = run.config.universal.training
    least = math.lcm(sharing, training.num_minibatches)
    games = -(-training.num_envs // least) * least
    return dataclasses.replace(training, total_steps=steps, num_envs=games)


class SelfPlay:
    """One ego and one partner of all styles learn together."""

    budgeted = True

    def num_updates(self, run: Run, steps: int) -> int:
        """Updates of each pair."""
        return training_config(run, steps, len(run.env.style_names)).num_updates

    def train(self, given: Given) -> Trained:
        """Trains `seeds` pairs."""
        env = given.env
        training = training_config(given.run, given.steps, len(env.style_names))
        players, returns = train_population(
            env,
            training,
            lambda: self_play.init_self_play(env, training, given.key, given.seeds),
            self_play.all_styles_for(env, given.seeds),
            given.saver_of(training),
            given.task.update,
            "self-play",
        )
        steps = training.num_updates * training.steps_per_update
        given.keep(players.ego.actor)
        return Trained(
            egos={SELF_PLAY: _in_turn(players.ego.actor, given.seeds)},
            descriptions={
                SELF_PLAY: "one ego that learnt beside a partner who learnt too, all styles, "
                f"{steps_in_words(steps)} steps"
            },
            steps=steps,
            notes=curves_of(training, (SELF_PLAY,), returns),
        )


class FictitiousCoPlay:
    """An ego learns with partners of self-play as they were at three moments of their learning.

    Half of the steps make the pool, half go into the ego.
    """

    budgeted = True

    def num_updates(self, run: Run, steps: int) -> int:
        """Updates of the pool and of the egos."""
        return sum(config.num_updates for config in self._configs(run, steps))

    def train(self, given: Given) -> Trained:
        """Trains the pool, then `seeds` egos with it."""
        env = given.env
        pool_config, ego_config = self._configs(given.run, given.steps)
        pool_key, ego_key = jax.random.split(given.key)
        pool = self._pool(given, pool_config, pool_key)
        first = pool_config.num_updates
        players, returns = train_population(
            env,
            ego_config,
            lambda: self_play.init_co_play(env, ego_config, ego_key, pool, given.seeds),
            self_play.all_styles_for(env, given.seeds),
            given.saver_of(ego_config),
            lambda done, metrics: given.task.update(first + done, metrics),
            "fictitious co-play",
        )
        ego_steps = ego_config.num_updates * ego_config.steps_per_update
        steps = ego_steps + POOL * first * pool_config.steps_per_update
        given.keep(players.ego.actor)
        return Trained(
            egos={FCP: _in_turn(players.ego.actor, given.seeds)},
            descriptions={
                FCP: f"one ego for {POOL} partners of self-play at {len(MOMENTS)} moments of their "
                f"learning, all styles, {steps_in_words(steps)} steps with theirs"
            },
            steps=steps,
            notes=curves_of(ego_config, (FCP,), returns),
        )

    def _configs(self, run: Run, steps: int) -> tuple[PPOConfig, PPOConfig]:
        styles = len(run.env.style_names)
        least = 4 * POOL * training_config(run, 10**9, styles).steps_per_update
        if steps < least:
            raise ValueError(f"steps is {steps:,}; fictitious co-play needs at least {least:,}")
        pool = training_config(run, steps // 2 // POOL, styles)
        return pool, training_config(run, steps // 2, styles * POOL * len(MOMENTS))

    def _pool(self, given: Given, config: PPOConfig, key: jax.Array) -> Policy:
        """The partners at all moments, leading axis [partner]."""
        env = given.env

        def start() -> TrainState:
            return self_play.init_self_play(env, config, key, POOL)

        # The training consumes its start, so the beginners are of another, equal one.
        beginners = trained_players(start()).partner.actor
        middle = given.path(f"middle_of_{config.num_updates}_updates")

        def keep_middle(state: TrainState) -> TrainState:
            if int(state.update[0]) >= config.num_updates // 2 and not checkpoint.exists(middle):
                checkpoint.save(middle, trained_players(state).partner.actor)
            return state

        players, _ = train_population(
            env,
            config,
            start,
            self_play.all_styles_for(env, POOL),
            given.saver(f"pool_{config.num_updates}_updates"),
            given.task.update,
            "the pool of fictitious co-play",
            updates_per_piece=min(24, max(1, config.num_updates // 20)),
            between=keep_middle,
        )
        moments = (beginners, checkpoint.restore(middle, beginners), players.partner.actor)
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *moments)


def _in_turn(policies: Any, seeds: int) -> MakeEgo:
    """Gives trained egos for all styles, leading axis [seed], one after the other."""

    def make(told: Told, key: jax.Array) -> Policy:
        del key
        return jax.tree.map(lambda leaf: leaf[told.number % seeds], policies)

    return make
