"""PPO with continuous actions and observations that are read by their running statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_reach import OFFSET, SCALE, ToyReach

from haland_jax import networks, normalisation, ppo, rollout
from haland_jax.learner import init_learner, make_networks
from haland_jax.networks import DistributionKind
from haland_jax.partners import Player
from haland_jax.ppo import PPOConfig

ENV = ToyReach()
CONFIG = PPOConfig(
    total_steps=16_000,
    num_envs=16,
    rollout_steps=10,
    entropy=0.0,
    final_entropy=0.0,
    learning_rate=3e-3,
    reward_scale=1.0,
    normalise=True,
)


def start(config, style):
    actors, critic = make_networks(ENV)
    keys = jax.random.split(jax.random.key(0), 3)
    learners = [
        init_learner(key, actor, critic, size, config)
        for key, actor, size in zip(keys, actors, ENV.observation_sizes, strict=False)
    ]
    return ppo.init_train_state(ENV, config, keys[2], *learners, style)


@pytest.fixture(scope="module")
def trained():
    """Both players after training with style `high`, and each update's mean return."""
    style = ENV.style("high")
    chunk = jax.jit(lambda state: ppo.train_chunk(ENV, CONFIG, CONFIG.num_updates, state, style))
    state, metrics = chunk(start(CONFIG, style))
    return state, np.asarray(metrics["return"])


def kept(learner):
    """The actor that is stored of one learner; it reads raw observations."""
    alone = Player.of(jax.tree.map(lambda leaf: leaf[None], learner))
    return jax.tree.map(lambda leaf: leaf[0], alone.actor)


def test_continuous_environments_get_gaussian_actors():
    actors, _ = make_networks(ENV)
    assert {actor.kind for actor in actors} == {DistributionKind.GAUSSIAN}


def test_both_players_learn_to_reach_and_the_stored_ones_play_as_well(trained):
    state, returns = trained
    # Five steps, each player 0.4 away and as uncertain as at first: -2 * 5 * (0.16 + 0.37).
    assert returns[0] < -3.0
    ego, partner = kept(state.ego), kept(state.partner)
    play = jax.jit(lambda key: rollout.play(ENV, key, ego, partner, ENV.style("high"), num_games=8))
    assert play(jax.random.key(1)).returns.mean() > -0.6


def test_a_stored_policy_reads_raw_observations_as_its_learner_normalised_ones(trained):
    state, _ = trained
    raw = jnp.array([[0.2, OFFSET + 0.7 * SCALE], [0.8, OFFSET]])
    actors, _ = make_networks(ENV)
    seen = normalisation.normalise(state.ego.normaliser, raw)
    assert np.abs(seen).max() < 3
    expected = actors.ego.apply(state.ego.actor, seen)
    found = networks.act(kept(state.ego), raw)
    np.testing.assert_allclose(found.mean, expected.mean, atol=2e-4)
    np.testing.assert_allclose(found.log_std, expected.log_std)


def test_the_statistics_are_those_of_all_that_was_seen(trained):
    state, _ = trained
    assert float(state.ego.normaliser.count) == CONFIG.total_steps
    # Times 0 to 4 of 5 steps, and a number between 0 and 1.
    np.testing.assert_allclose(state.ego.normaliser.mean[0], 0.4, atol=1e-3)
    np.testing.assert_allclose(state.ego.normaliser.mean[1], OFFSET + SCALE / 2, rtol=2e-3)
    np.testing.assert_allclose(state.ego.normaliser.std[1], SCALE / np.sqrt(12), rtol=0.05)


def test_a_learner_that_goes_on_starts_from_what_was_stored(trained):
    state, _ = trained
    again = jax.tree.map(lambda leaf: leaf[None], state.ego)
    player = jax.tree.map(lambda leaf: leaf[0], Player.of(again))
    learner = player.learner(CONFIG)
    for one, two in zip(
        jax.tree.leaves((learner.actor, learner.critic)),
        jax.tree.leaves((state.ego.actor, state.ego.critic)),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, atol=1e-4)
