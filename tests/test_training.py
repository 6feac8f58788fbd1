"""Training that is interrupted between two pieces ends as if it had not been."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.struct import PyTreeNode
from toy_game import ToyGame

from experiments import training
from haland_jax import partners
from haland_jax.population import over_population
from haland_jax.ppo import PPOConfig

CONFIG = PPOConfig(total_steps=80, num_envs=4, rollout_steps=5, num_minibatches=2, epochs=1)
COUNTS = partners.PartnersConfig(
    train_seeds=1, held_out_seeds=1, spare_seeds=0, joint=CONFIG, refit=CONFIG, oracle=CONFIG
)


class Killed(BaseException):
    """Stands for a process that dies."""


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


class Counter(PyTreeNode):
    """A state that adds up what its own key draws."""

    update: jax.Array
    key: jax.Array
    total: jax.Array


def count(updates: int, state: Counter, weight: jax.Array):
    def one(state, _):
        drawn = weight * jax.random.uniform(jax.random.fold_in(state.key, state.update))
        state = state.replace(update=state.update + 1, total=state.total + drawn)
        return state, {"return": state.total, "loss": drawn}

    return jax.lax.scan(one, state, length=updates)


@pytest.mark.parametrize("members", [2, 3, 5])
def test_members_that_take_turns_end_as_they_would_side_by_side(monkeypatch, tmp_path, members):
    """Five members take turns in groups of four, each of them four times in a round."""
    monkeypatch.setattr(training, "UPDATES_PER_PIECE", 6)
    config, sizes = dataclasses.replace(CONFIG, total_steps=11 * CONFIG.steps_per_update), []

    def compiled(updates):
        program = over_population(partial(count, updates), donate=(0,))

        def noted(state, weights):
            sizes.append((len(weights), updates))
            return program(state, weights)

        return noted

    weights = jnp.arange(1.0, members + 1)
    keys = jax.random.split(jax.random.key(3), members)
    state, returns = training.train_in_pieces(
        config,
        Counter(jnp.zeros(members, jnp.int32), keys, jnp.zeros(members)),
        compiled,
        training.Saver(tmp_path),
        lambda done, metrics: None,
        "counting",
        by_member=(weights,),
    )
    drawn = np.array(
        [
            [jax.random.uniform(jax.random.fold_in(key, update)) for update in range(11)]
            for key in keys
        ]
    )
    np.testing.assert_allclose(returns, np.cumsum(weights[:, None] * drawn, axis=1).T, rtol=1e-5)
    np.testing.assert_allclose(state.total, returns[-1], rtol=1e-6)
    assert state.update.tolist() == [11] * members
    assert (
        sizes
        == {
            2: [(2, 6), (2, 5)],
            3: [(2, 3)] * 3 + [(2, 2)] * 3 + [(3, 1)],
            5: [(4, 1)] * 5 + [(4, 1)] * 5 + [(5, 3)],
        }[members]
    )


def test_members_that_take_turns_go_on_where_they_were(monkeypatch, tmp_path):
    config = dataclasses.replace(CONFIG, total_steps=10 * CONFIG.steps_per_update)

    def run(path, die_after=None):
        reported = []

        def report(done, metrics):
            reported.append(done)
            if done == die_after:
                raise Killed

        state, returns = training.train_in_pieces(
            config,
            Counter(jnp.zeros(3, jnp.int32), jax.random.split(jax.random.key(3), 3), jnp.zeros(3)),
            lambda updates: over_population(partial(count, updates), donate=(0,)),
            training.Saver(path),
            report,
            "counting",
            by_member=(jnp.arange(3.0),),
        )
        return state.total, returns, reported

    monkeypatch.setattr(training, "UPDATES_PER_PIECE", 4)
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    *whole, _ = run(tmp_path / "whole")
    with pytest.raises(Killed):
        run(tmp_path / "resumed", die_after=8)
    *resumed, reported = run(tmp_path / "resumed")
    assert reported == [8, 10]
    assert_alike(resumed, whole)


def test_pieces_of_a_given_size_are_kept_where_turns_would_change_them(tmp_path):
    sizes = []

    def compiled(updates):
        sizes.append(updates)
        return over_population(partial(count, updates), donate=(0,))

    training.train_in_pieces(
        dataclasses.replace(CONFIG, total_steps=10 * CONFIG.steps_per_update),
        Counter(jnp.zeros(3, jnp.int32), jax.random.split(jax.random.key(3), 3), jnp.zeros(3)),
        compiled,
        training.Saver(tmp_path),
        lambda done, metrics: None,
        "counting",
        by_member=(jnp.arange(3.0),),
        updates_per_piece=5,
    )
    assert sizes == [5], "not four updates in two turns"


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
