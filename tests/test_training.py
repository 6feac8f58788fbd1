"""Training that is interrupted between two pieces ends as if it had not been."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from toy_game import ToyGame

from experiments import training
from haland_jax import partners
from haland_jax.ppo import PPOConfig

CONFIG = PPOConfig(total_steps=80, num_envs=4, rollout_steps=5, num_minibatches=2, epochs=1)
COUNTS = partners.PartnersConfig(
    train_seeds=1, held_out_seeds=1, spare_seeds=0, joint=CONFIG, refit=CONFIG, oracle=CONFIG
)


class Killed(BaseException):
    """Stands for a process that dies."""


pytestmark = pytest.mark.light_compilation


def train(path, *, updates_per_piece: int, seeds: int = 2, between=None, die_after=None):
    """Trains a population of the toy game; dies once so many updates are reported."""
    game, reported = ToyGame(), []

    def report(done, metrics):
        reported.append(done)
        if done == die_after:
            raise Killed

    players, returns = training.train_population(
        game,
        CONFIG,
        lambda: partners.init_pairs(game, CONFIG, seeds, jax.random.key(0)),
        partners.repeat_styles(game, seeds),
        training.Saver(path),
        report,
        "partners",
        updates_per_piece=updates_per_piece,
        between=between,
    )
    return players, returns, reported


def assert_alike(one, two):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_a_population_goes_on_where_it_was_and_ends_alike(monkeypatch, tmp_path):
    assert CONFIG.num_updates == 4
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", math.inf)
    *whole, reported = train(tmp_path / "whole", updates_per_piece=25)
    assert reported == [4]
    assert not (tmp_path / "whole").exists(), "nothing is saved before it is due"

    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    with pytest.raises(Killed):
        train(tmp_path / "resumed", updates_per_piece=2, die_after=4)
    *resumed, reported = train(tmp_path / "resumed", updates_per_piece=2)
    assert reported == [4], "the piece after the last checkpoint is done again, no other"
    assert_alike(resumed, whole)


def test_pairs_that_change_partners_go_on_with_the_partners_they_had(monkeypatch, tmp_path):
    circles = dataclasses.replace(COUNTS, spare_seeds=2, updates_together=2)
    move_on, moved = partners.compile_moving_on(ToyGame(), circles), []

    def between(state):
        moved.append(int(state.update[0]))
        return move_on(state)

    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", math.inf)
    *whole, _ = train(tmp_path / "whole", seeds=4, updates_per_piece=2, between=between)
    assert moved == [2], "after a piece that another one follows"
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    with pytest.raises(Killed):
        train(tmp_path / "resumed", seeds=4, updates_per_piece=2, between=between, die_after=4)
    *resumed, _ = train(tmp_path / "resumed", seeds=4, updates_per_piece=2, between=between)
    assert moved == [2, 2], "the state was saved after they had changed partners"
    assert_alike(resumed, whole)
