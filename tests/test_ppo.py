"""PPO: advantages and loss against hand-worked numbers, schedules, frozen partners, learning."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_game import ToyGame, always

import envs
from haland_jax import ppo
from haland_jax.learner import init_learner, make_networks
from haland_jax.networks import MLPActor, MLPCritic
from haland_jax.ppo import PPOConfig
from haland_jax.ppo_loss import Batch, generalised_advantages, ppo_loss

TINY = PPOConfig(
    total_steps=80, num_envs=4, rollout_steps=5, num_minibatches=1, epochs=1, confined_until=0.0
)


def fresh_pair(game, config, frozen=None):
    """The state of one pair that begins to learn; `frozen` partners do not."""
    actors, critic = make_networks(game)
    sizes = game.observation_sizes
    ego_key, partner_key, key = jax.random.split(jax.random.key(0), 3)
    ego = init_learner(ego_key, actors.ego, critic, sizes.ego, config)
    partner = init_learner(partner_key, actors.partner, critic, sizes.partner, config)
    if frozen is not None:
        partner = frozen
    return ppo.init_train_state(game, config, key, ego, partner, game.style("long"))


def train(game, config, state, num_updates=1):
    step = jax.jit(partial(ppo.train_chunk, game, config, num_updates))
    return step(state, game.style("long"))


def after(state, update: int):
    return state.replace(update=jnp.int32(update))


def test_advantages_by_hand():
    # γ = 0.5, λ = 0.5: δ_t = r_t + 0.5 V(s_{t+1}) - V(s_t), A_t = δ_t + 0.25 A_{t+1}.
    found = generalised_advantages(
        rewards=jnp.array([1.0, 0.0, 2.0]),
        values=jnp.array([4.0, 2.0, 8.0]),
        last_value=jnp.array(6.0),
        ended=jnp.zeros(3, bool),
        discount=0.5,
        gae_lambda=0.5,
    )
    # δ = -2, 2, -3.
    np.testing.assert_allclose(found, [-2 + 0.25 * 1.25, 2 - 0.75, -3.0])


def test_nothing_is_carried_over_a_games_end():
    found = generalised_advantages(
        rewards=jnp.array([[1.0, 1.0], [3.0, 3.0], [2.0, 2.0]]),
        values=jnp.array([[4.0, 4.0], [2.0, 2.0], [8.0, 8.0]]),
        last_value=jnp.array([6.0, 6.0]),
        ended=jnp.array([[False, False], [True, False], [False, True]]),
        discount=0.5,
        gae_lambda=1.0,
    )
    # First game, ended with step 1: δ = 1 + 1 - 4, 3 - 2, 2 + 3 - 8.
    np.testing.assert_allclose(found[:, 0], [-2 + 0.5 * 1, 1, -3])
    # Second game, ended with step 2: δ = -2, 3 + 4 - 2, 2 - 8.
    np.testing.assert_allclose(found[:, 1], [-2 + 0.5 * (5 - 3), 5 - 3, -6])


def numpy_network(params, x):
    layers = jax.tree.map(np.asarray, params["params"])
    hidden = np.tanh(x @ layers["dense_0"]["kernel"] + layers["dense_0"]["bias"])
    return hidden @ layers["dense_1"]["kernel"] + layers["dense_1"]["bias"]


def test_the_loss_by_hand():
    random = np.random.default_rng(0)
    actor, critic = MLPActor(3, (4,)), MLPCritic((4,))
    observation = random.normal(size=(5, 2, 6))
    actor_params = actor.init(jax.random.key(0), observation)
    actor_params = jax.tree.map(lambda leaf: 3 * leaf + 0.1, actor_params)
    critic_params = critic.init(jax.random.key(1), observation)
    action = random.integers(0, 3, (5, 2))
    old_log_prob = np.log(random.uniform(0.1, 0.9, (5, 2)))
    advantage, target = random.normal(size=(5, 2)), random.normal(size=(5, 2))
    config = PPOConfig(clip=0.2, value_weight=0.7)

    logits = numpy_network(actor_params, observation)
    log_probs = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    chosen = np.take_along_axis(log_probs, action[..., None], -1)[..., 0]
    ratio = np.exp(chosen - old_log_prob)
    assert (ratio > 1.2).any()
    assert (ratio < 0.8).any()
    normalised = (advantage - advantage.mean()) / advantage.std()
    surrogate = np.minimum(ratio * normalised, np.clip(ratio, 0.8, 1.2) * normalised)
    value = numpy_network(critic_params, observation)[..., 0]
    entropy = -(np.exp(log_probs) * log_probs).sum(-1)
    expected = -surrogate.mean() + 0.7 * 0.5 * ((value - target) ** 2).mean() - 0.3 * entropy.mean()

    batch = Batch(
        observation=jnp.asarray(observation),
        action=jnp.asarray(action),
        log_prob=jnp.asarray(old_log_prob),
        value=jnp.zeros((5, 2)),
        advantage=jnp.asarray(advantage),
        target=jnp.asarray(target),
    )
    params = actor_params, critic_params
    found = ppo_loss(params, batch, actor, critic, config, 0.3)
    assert float(found) == pytest.approx(expected, rel=1e-5)

    # A guide that would play the first action with chance 1/2, the others with 1/4 each.
    guide = np.log([0.5, 0.25, 0.25])
    divergence = (np.exp(guide) * (guide - log_probs)).sum(-1).mean()
    guided = batch.replace(guide=jnp.broadcast_to(jnp.asarray(guide), (5, 2, 3)))
    found = ppo_loss(params, guided, actor, critic, config, 0.3, 0.4)
    assert float(found) == pytest.approx(expected + 0.4 * divergence, rel=1e-5)


@pytest.mark.parametrize("update", [0, 1, 3])
def test_the_shaped_reward_falls_linearly_to_zero(update):
    # With no discount and a critic that says 0, the value loss is half the squared reward. Its
    # weight dwarfs the surrogate, which normalises the rounding errors of equal advantages.
    game = ToyGame(ego_weight=0.0, shaped=2.0)
    config = dataclasses.replace(
        TINY,
        discount=0.0,
        entropy=0.0,
        final_entropy=0.0,
        reward_scale=0.1,
        shaping=3.0,
        shaping_until=0.5,
        value_weight=1e5,
    )
    state = after(fresh_pair(game, config), update)
    silent = jax.tree.map(jnp.zeros_like, (state.ego.critic, state.partner.critic))
    state = state.replace(
        ego=state.ego.replace(critic=silent[0]), partner=state.partner.replace(critic=silent[1])
    )
    assert config.num_updates == 4
    _, metrics = train(game, config, state)
    factor = 3.0 * max(0.0, 1 - (update / 4) / 0.5)
    expected = 1e5 * 0.5 * (0.1 * factor * 2.0) ** 2
    assert float(metrics["loss"][0]) == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert float(metrics["shaped"][0]) == 2.0


def weights_of(learner):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(learner.actor)])


def test_the_learning_rate_falls_linearly():
    # The first step of Adam is proportional to the rate; both runs see the same games.
    rates = {"learning_rate": 1e-2, "final_learning_rate": 2e-3}
    steps = []
    for total in (40, 80):
        config = dataclasses.replace(
            TINY, total_steps=total, entropy=0.0, final_entropy=0.0, **rates
        )
        state = after(fresh_pair(ToyGame(), config), 1)
        trained, _ = train(ToyGame(), config, state)
        steps.append(weights_of(trained.ego) - weights_of(state.ego))
    assert np.abs(steps[0]).max() > 1e-4
    # Progress 1/2 and 1/4.
    ratio = (1e-2 - 8e-3 / 2) / (1e-2 - 8e-3 / 4)
    np.testing.assert_allclose(steps[0], ratio * steps[1], rtol=2e-3, atol=1e-7)


def test_the_entropy_bonus_falls_linearly():
    losses = []
    for total in (40, 80):
        config = dataclasses.replace(TINY, total_steps=total, entropy=0.8, final_entropy=0.0)
        state = after(fresh_pair(ToyGame(), config), 1)
        losses.append(float(train(ToyGame(), config, state)[1]["loss"][0]))
    # Fresh actors are nearly uniform over 3 and 2 actions; the loss is the players' mean.
    entropy = (np.log(3) + np.log(2)) / 2
    assert losses[0] - losses[1] == pytest.approx((0.6 - 0.4) * entropy, rel=0.02)


def test_the_ego_is_confined_at_first_and_then_released():
    game = ToyGame(ego_weight=0.0, confined_bonus=1.0)
    config = dataclasses.replace(TINY, confined_until=0.5)
    _, metrics = train(game, config, fresh_pair(game, config), 4)
    np.testing.assert_array_equal(metrics["reward"], [1, 1, 0, 0])


def test_frozen_partners_share_the_games_and_do_not_change():
    game = ToyGame(ego_weight=0.0, partner_weight=1.0)
    members = [always(action, 2, 4, hidden=64) for action in (0, 1)]
    frozen = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    state = fresh_pair(game, TINY, frozen)
    trained, metrics = train(game, TINY, state, 3)
    # One partner plays 0 always, the other 1, in half of the games each.
    np.testing.assert_array_equal(metrics["reward"], 0.5)
    for before, now in zip(jax.tree.leaves(frozen), jax.tree.leaves(trained.partner), strict=True):
        np.testing.assert_array_equal(before, now)
    assert (weights_of(state.ego) != weights_of(trained.ego)).any()


def test_two_chunks_equal_one_of_double_length():
    config = dataclasses.replace(TINY, num_minibatches=2, epochs=2)
    state = fresh_pair(ToyGame(), config)
    once, metrics = train(ToyGame(), config, state, 4)
    half, first = train(ToyGame(), config, state, 2)
    twice, second = train(ToyGame(), config, half, 2)
    joined = np.concatenate([first["loss"], second["loss"]])
    np.testing.assert_allclose(metrics["loss"], joined, rtol=1e-6)
    assert int(twice.update) == 4
    for one, two in zip(jax.tree.leaves(once), jax.tree.leaves(twice), strict=True):
        if not jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-7)


def test_both_players_learn_the_toy_game():
    game = ToyGame(ego_weight=1.0, partner_weight=1.0)
    config = PPOConfig(
        total_steps=16 * 10 * 30,
        num_envs=16,
        rollout_steps=10,
        num_minibatches=2,
        learning_rate=1e-2,
        entropy=0.0,
        final_entropy=0.0,
        reward_scale=1.0,
    )
    _, metrics = train(game, config, fresh_pair(game, config), config.num_updates)
    # Uniform play earns 1 + 0.5 a step, the best 2 + 1.
    assert float(metrics["reward"][0]) < 1.9
    assert float(metrics["reward"][-3:].mean()) > 2.8


@pytest.mark.slow
def test_a_pair_learns_to_cook_in_the_cramped_room():
    env = envs.make("overcooked/cramped_room", shaping="reference")
    config = PPOConfig(
        total_steps=64_000,
        learning_rate=2.5e-3,
        entropy=0.01,
        shaping_until=1.0,
        random_start=0.0,
        confined_until=0.0,
    )
    state, style = fresh_pair_in(env, config), env.style("free")
    step = jax.jit(partial(ppo.train_chunk, env, config, config.num_updates))
    _, metrics = step(state, style)
    shaped = np.asarray(metrics["shaped"])
    # A step earns 0.009 at first: about one thing potted in 170 steps of either player.
    assert shaped[-5:].mean() > 2 * shaped[:5].mean()


def fresh_pair_in(env, config):
    actors, critic = make_networks(env)
    keys = jax.random.split(jax.random.key(0), 3)
    learners = [
        init_learner(key, actor, critic, size, config)
        for key, actor, size in zip(keys, actors, env.observation_sizes, strict=False)
    ]
    return ppo.init_train_state(env, config, keys[2], *learners, env.style("free"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 30}, "num_minibatches is 4; expected a divisor of num_envs = 30"),
        ({"total_steps": 1000}, "total_steps is 1000; expected at least one batch .* = 1600"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        PPOConfig(**settings)
