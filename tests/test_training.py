"""Training that is interrupted between two pieces ends as if it had not been."""

import math

import jax
import numpy as np
import pytest
from toy_game import ToyGame

from experiments import training
from haland_jax import partners
from haland_jax.ppo import PPOConfig

CONFIG = PPOConfig(total_steps=100, num_envs=4, rollout_steps=5, num_minibatches=2, epochs=1)
COUNTS = partners.PartnersConfig(
    train_seeds=1, held_out_seeds=1, spare_seeds=0, joint=CONFIG, refit=CONFIG, oracle=CONFIG
)


class Killed(BaseException):
    """Stands for a process that dies."""


def train(path, *, die_after: int | None = None):
    """Trains a population of the toy game; dies once so many updates are reported."""
    game, reported = ToyGame(), []

    def report(done, metrics):
        reported.append(done)
        if done == die_after:
            raise Killed

    players, returns = training.train_population(
        game,
        CONFIG,
        lambda: partners.init_pairs(game, COUNTS.joint, COUNTS.num_seeds, jax.random.key(0)),
        partners.repeat_styles(game, 2),
        training.Saver(path),
        report,
        "partners",
    )
    return players, returns, reported


def test_a_population_goes_on_where_it_was_and_ends_alike(monkeypatch, tmp_path):
    assert CONFIG.num_updates == 5
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", math.inf)
    whole, returns, reported = train(tmp_path / "whole")
    assert reported == [5]
    assert not (tmp_path / "whole").exists(), "nothing is saved before it is due"

    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    monkeypatch.setattr(training, "UPDATES_PER_PIECE", 2)
    with pytest.raises(Killed):
        train(tmp_path / "resumed", die_after=4)
    resumed, resumed_returns, reported = train(tmp_path / "resumed")
    assert reported == [4, 5], "the piece after the last checkpoint is done again, no other"
    np.testing.assert_allclose(resumed_returns, returns, rtol=1e-6)
    for one, two in zip(
        jax.tree.leaves(whole),
        jax.tree.leaves(resumed),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-6)
