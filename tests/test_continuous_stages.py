"""The stages that train players, in a game whose observations must be normalised to be read."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from toy_reach import ToyReach

from experiments import configs
from experiments.run_folder import RunFolder
from experiments.stages import Run, context, load_archive, load_population
from experiments.stages.best_responses import _universal_to_refit, make_best_responses
from experiments.stages.population import make_partners
from experiments.stages.universal import load_universal, train_universal
from haland_jax import mirrors, partners
from haland_jax.partners import PartnersConfig
from haland_jax.ppo_loss import PPOConfig
from haland_jax.universal import TOLD_THE_STYLE, UniversalConfig

TRAINING = PPOConfig(
    total_steps=12_000,
    num_envs=12,
    rollout_steps=10,
    num_minibatches=2,
    entropy=0.0,
    final_entropy=0.0,
    learning_rate=3e-3,
    reward_scale=1.0,
    shaping=0.0,
    confined_until=0.0,
    normalise=True,
)
GUIDED = dataclasses.replace(TRAINING, guidance=1.0, guidance_until=0.25)
SHORT = dataclasses.replace(TRAINING, total_steps=1200)
GOOD = -1.0
"""Mean return of a game; pairs that have learnt nothing earn less than -3."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run after its first three stages."""
    config = dataclasses.replace(
        configs.smoke("toy_reach", 0),
        partners=PartnersConfig(
            train_seeds=1,
            held_out_seeds=1,
            spare_seeds=2,
            updates_together=20,
            joint=TRAINING,
            refit=SHORT,
            oracle=SHORT,
            oracle_candidates=2,
            evaluation_games=16,
        ),
        universal=UniversalConfig(training=GUIDED),
    )
    path = tmp_path_factory.mktemp("toy") / "run"
    task = SimpleNamespace(update=lambda *_: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(context.envs, "make", lambda name, **_: ToyReach())
        with RunFolder.write(path, config) as folder:
            made = Run(config, folder)
            metrics = {
                "partners": make_partners(made, task),
                "universal": train_universal(made, task),
                "best_responses": make_best_responses(made, task),
            }
            yield made, metrics


def replay(env, egos, others):
    """Mean returns of egos with partners, leading axes [style, seed]."""
    play = partners.compile_evaluation(env, 16)
    styles, seeds = jax.tree.leaves(others)[0].shape[:2]
    keys = jax.random.split(jax.random.key(9), styles * seeds)
    pairs = partners.flatten(egos), partners.flatten(others)
    games = play(keys, *pairs, partners.repeat_styles(env, seeds))
    return np.asarray(games.returns.mean(axis=1)).reshape(styles, seeds)


def test_pairs_are_chosen_by_what_the_stored_players_earn(run):
    made, metrics = run
    population = load_population(made)
    again = replay(made.env, population.egos.actor, population.partners)
    assert again.min() > GOOD
    stored = np.array(list(metrics["partners"]["joint_returns"].values()))
    np.testing.assert_allclose(stored, again, atol=0.3)


def test_best_responses_and_oracles_earn_what_is_written_of_them(run):
    made, metrics = run
    population, archive = load_population(made), load_archive(made)
    assert replay(made.env, archive.egos.actor, population.train_partners).min() > GOOD
    oracles = replay(made.env, archive.oracles, population.held_out_partners)
    assert oracles.min() > GOOD
    best = np.max(metrics["best_responses"]["oracle_candidate_returns"], axis=-1)
    np.testing.assert_allclose(best, oracles, atol=0.3)


def test_the_universal_ego_plays_as_it_learnt(run):
    made, metrics = run
    assert metrics["universal"]["guided_steps"] == metrics["universal"]["steps"] / 4
    told = load_universal(made)[TOLD_THE_STYLE].actor
    assert replay(made.env, told, load_population(made).train_partners).min() > GOOD


@pytest.mark.parametrize(("told_start", "egos"), [(False, 2), (True, 1)])
def test_best_responses_may_start_from_the_told_ego_alone(run, told_start, egos):
    made, _ = run
    known = dataclasses.replace(made.config.partners, told_start=told_start)
    asked = Run(dataclasses.replace(made.config, partners=known), made.folder)
    population = load_population(made)
    teachers = mirrors.teachers(made.env, known, population)
    start, chosen = _universal_to_refit(asked, jax.random.key(0), teachers)
    assert np.shape(chosen["universal_start_returns"]) == (len(made.env.style_names), egos)
    if told_start:
        assert set(chosen["universal_starts"].values()) == {TOLD_THE_STYLE}
        told = jax.tree.map(lambda leaf: leaf[:, 0], load_universal(made)[TOLD_THE_STYLE])
        for one, two in zip(jax.tree.leaves(start), jax.tree.leaves(told), strict=True):
            np.testing.assert_array_equal(one, two)
