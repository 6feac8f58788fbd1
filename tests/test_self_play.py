"""Self-play and fictitious co-play: who plays which style, and that both learn."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from toy_game import ToyGame

from experiments.methods.self_play import training_config
from haland_jax import partners, self_play
from haland_jax.learner import Learner
from haland_jax.ppo import PPOConfig
from haland_jax.universal import universal_config

CONFIG = PPOConfig(
    total_steps=400,
    num_envs=12,
    rollout_steps=5,
    num_minibatches=2,
    epochs=1,
    confined_until=0.0,
)


@pytest.fixture(scope="module")
def game():
    # What both earn is 1 when both act as they should: ego 1 or 2, partner 1.
    return ToyGame(ego_weight=1.0, partner_weight=1.0)


@pytest.mark.parametrize(
    ("sharing", "games"),
    [(8, 192), (72, 216), (7, 224)],
    ids=["self-play", "co-play", "neither divides the other"],
)
def test_games_are_as_few_as_partners_and_minibatches_can_share(sharing, games):
    universal = SimpleNamespace(training=universal_config(10**6, num_envs=192, num_minibatches=8))
    run: Any = SimpleNamespace(config=SimpleNamespace(universal=universal))
    assert training_config(run, 10**6, sharing).num_envs == games


def test_the_games_of_a_pair_are_of_all_styles_in_equal_parts(game):
    state = self_play.init_self_play(game, CONFIG, jax.random.key(0), 3)
    assert isinstance(state.partner, Learner)
    lengths = self_play.all_styles_for(game, 3).styles.length
    np.testing.assert_array_equal(lengths, [[3, 5]] * 3)
    train = partners.compile_training(game, CONFIG, 1)
    after, _ = train(state, self_play.all_styles_for(game, 3))
    # After a rollout of 5 steps games of 3 steps are at their second step, those of 5 at the first.
    np.testing.assert_array_equal(after.env_states.time, [[2] * 6 + [0] * 6] * 3)


def test_pairs_of_self_play_start_apart_and_both_learn(game):
    long = dataclasses.replace(CONFIG, total_steps=6000, learning_rate=3e-3)
    state = self_play.init_self_play(game, long, jax.random.key(0), 2)
    first = state.ego.actor["params"]["dense_0"]["kernel"]
    assert np.abs(np.diff(first, axis=0)).max() > 0
    styles = self_play.all_styles_for(game, 2)
    _, metrics = partners.compile_training(game, long, long.num_updates)(state, styles)
    reward = np.asarray(metrics["reward"])
    assert reward[:, -5:].mean() > 2.7, "3 is the most: 2 for the ego's action, 1 for the partner's"
    assert reward[:, :5].mean() < 2.2


def test_each_frozen_partner_plays_every_style(game):
    pool = partners.trained_players(
        self_play.init_self_play(game, CONFIG, jax.random.key(0), 3)
    ).partner.actor
    state = self_play.init_co_play(game, CONFIG, jax.random.key(1), pool, 2)
    bias = np.asarray(state.partner["params"]["dense_0"]["kernel"][:, :, 0, 0])
    own = np.asarray(pool["params"]["dense_0"]["kernel"][:, 0, 0])
    # Games lie in the order of the styles; of each, all three partners.
    np.testing.assert_array_equal(bias, [[*own, *own]] * 2)
    assert len(set(own.tolist())) == 3


def test_shares_that_are_not_equal_are_refused(game):
    odd = dataclasses.replace(CONFIG, num_envs=10, num_minibatches=1)
    pool = partners.trained_players(
        self_play.init_self_play(game, odd, jax.random.key(0), 3)
    ).partner.actor
    with pytest.raises(ValueError, match=r"co_play\.num_envs is 10; expected a multiple of 6"):
        self_play.init_co_play(game, odd, jax.random.key(0), pool, 1)
    with pytest.raises(ValueError, match=r"self_play\.num_envs is 9; expected a multiple of 2"):
        self_play.init_self_play(game, dataclasses.replace(odd, num_envs=9), jax.random.key(0), 1)
