"""Universal egos with a memory: who is told what, what they play, and that they learn to use it."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_game import ToyGame, always

from envs.base import Pair
from haland_jax import normalisation, partners, recurrent_egos, recurrent_ppo
from haland_jax.ppo import PPOConfig
from haland_jax.recurrent_egos import ADAPTIVE, GENERAL, INSTRUCTED, VARIANTS, Tells

TINY = PPOConfig(
    total_steps=4 * 8 * 5,
    num_envs=8,
    rollout_steps=5,
    num_minibatches=2,
    epochs=1,
    confined_until=0.0,
)


@dataclasses.dataclass(frozen=True)
class HiddenPreference(ToyGame):
    """A step pays 1 where the ego's action is 0 in the style `short`, 2 in the style `long`.

    The ego sees nothing at all.
    """

    def reset(self, key, style):
        state, timestep = super().reset(key, style)
        return state, self._blind(timestep)

    def step(self, key, state, actions, style):
        state, timestep = super().step(key, state, actions, style)
        reward = (actions.ego == jnp.where(style.length == 3, 0, 2)).astype(jnp.float32)
        return state, self._blind(timestep.replace(reward=reward))

    @staticmethod
    def _blind(timestep):
        ego, partner = timestep.observation
        return timestep.replace(observation=Pair(jnp.zeros_like(ego), partner))


def frozen():
    """One partner a style: the first always plays 0, the second 1; leading axes [style, seed]."""
    pair = [always(action, 2, 4, 64) for action in (0, 1)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[:, None], *pair)


def begin(game, config=TINY):
    return recurrent_ppo.init_recurrent(game, config, jax.random.key(0), frozen(), seeds=1)


def test_an_ego_is_told_the_style_the_last_action_or_nothing():
    label, action = jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    tells = recurrent_egos.tells_of(1)
    told = {
        name: jax.tree.map(lambda leaf, i=i: leaf[i], tells)(label, action).tolist()
        for i, name in enumerate(VARIANTS)
    }
    assert told == {
        GENERAL: [0, 0, 0, 0, 0],
        INSTRUCTED: [0, 1, 0, 0, 0],
        ADAPTIVE: [0, 0, 1, 0, 0],
    }


def test_a_rollout_knows_styles_beginnings_and_what_partners_did():
    game = ToyGame()
    state = jax.tree.map(lambda leaf: leaf[0], begin(game))
    state = state.replace(tells=Tells(jnp.ones(()), jnp.ones(())))
    roll = jax.jit(partial(recurrent_ppo._rollout, game, TINY, share=0.0))
    state, steps = roll(state)
    # Games 0 to 3 are short ones and end every third step; games 4 to 7 end with the fifth.
    began = np.array(steps["began"])
    np.testing.assert_array_equal(began[:, 0], [1, 0, 0, 1, 0])
    np.testing.assert_array_equal(began[:, 4], [1, 0, 0, 0, 0])
    np.testing.assert_array_equal(state.began, [False] * 4 + [True] * 4)
    label, last = np.split(np.asarray(steps["told"]), [2], axis=-1)
    np.testing.assert_array_equal(label, np.tile(np.repeat(np.eye(2), 4, axis=0), (5, 1, 1)))
    action = np.repeat(np.eye(2), 4, axis=0)
    np.testing.assert_array_equal(last, np.where(began[..., None], 0.0, action))
    np.testing.assert_array_equal(state.partner_action[:4], action[:4])
    assert not state.partner_action[4:].any()
    _, again = roll(state.replace(update=state.update + 1))
    np.testing.assert_array_equal(again["began"][:, 0], [0, 1, 0, 0, 1])


def test_learning_starts_from_what_was_played(monkeypatch):
    """Before the first change, the sequences give the probabilities that the rollout had.

    Two sequences of a rollout, with games that begin within both.
    """
    seen = []

    def watched(distribution, value, batch, *_):
        log_prob = recurrent_ppo.networks.log_prob(distribution, batch.action)
        jax.debug.callback(
            lambda *pairs: seen.append(pairs), log_prob, batch.log_prob, value, batch.value
        )
        return jnp.sum(log_prob) * 0.0 + jnp.sum(value) * 0.0

    monkeypatch.setattr(recurrent_ppo, "clipped_loss", watched)
    game = ToyGame()
    rollout = 2 * recurrent_ppo.SEQUENCE
    config = dataclasses.replace(
        TINY, normalise=True, rollout_steps=rollout, total_steps=4 * 8 * rollout
    )
    state = jax.tree.map(lambda leaf: leaf[2], begin(game, config))
    noise = iter(jax.random.split(jax.random.key(5), 100))
    actor, critic = jax.tree.map(
        lambda leaf: leaf + 0.3 * jax.random.normal(next(noise), leaf.shape),
        (state.ego.actor, state.ego.critic),
    )
    state = state.replace(ego=state.ego.replace(actor=actor, critic=critic))
    update = jax.jit(partial(recurrent_ppo._update, game, config))
    state, _ = update(state)
    state, _ = update(state)  # starts in the middle of games, from memories, and normalises
    jax.effects_barrier()
    assert all(float(jnp.abs(part).min(axis=0).max()) > 0 for part in state.memories[0])
    assert len(seen) == 2 * config.num_minibatches
    for played_again, played, valued_again, valued in seen:
        np.testing.assert_allclose(played_again, played, atol=1e-5)
        np.testing.assert_allclose(valued_again, valued, atol=1e-5)
        assert np.std(played) > 0.01
        assert np.std(valued) > 0.01


def test_settings_that_do_not_fit_are_refused():
    config = dataclasses.replace(TINY, num_envs=9, num_minibatches=3)
    with pytest.raises(ValueError, match="is 9; expected a multiple of 2, the number of partners"):
        begin(ToyGame(), config)
    with pytest.raises(ValueError, match=r"confined_until is 0\.5; expected 0"):
        begin(ToyGame(), dataclasses.replace(TINY, confined_until=0.5))
    with pytest.raises(ValueError, match="rollout_steps is 12; expected a multiple of 10"):
        begin(ToyGame(), dataclasses.replace(TINY, rollout_steps=12))


def test_egos_use_what_they_remember_and_what_they_are_told():
    game = HiddenPreference()
    config = PPOConfig(
        total_steps=16 * 10 * 60,
        num_envs=16,
        rollout_steps=10,
        num_minibatches=2,
        learning_rate=3e-3,
        entropy=0.0,
        final_entropy=0.0,
        reward_scale=1.0,
        confined_until=0.0,
        normalise=True,
    )
    start = begin(game, config)
    before = jax.tree.map(np.asarray, (start.ego.actor, start.partners))
    half = recurrent_ppo.compile_recurrent(game, config, config.num_updates // 2)
    state, metrics = half(half(start)[0])
    assert metrics["return"].shape == (3, config.num_updates // 2)
    # All start alike; what an ego is not told, it learns nothing of. Partners stay as they are.
    actor, stayed = jax.tree.map(np.asarray, (state.ego.actor, state.partners))
    jax.tree.map(np.testing.assert_array_equal, stayed, before[1])
    first = before[0]["params"]["body"]["told"]["kernel"]
    assert (first == first[0]).all()
    moved = np.abs(actor["params"]["body"]["told"]["kernel"] - first).max(axis=2) > 0
    np.testing.assert_array_equal(
        moved, [[False] * 4, [True, True, False, False], [False, False, True, True]]
    )
    egos = recurrent_ppo.egos_by_style(game, recurrent_ppo.raw_actors(state))
    assert tuple(egos) == VARIANTS
    play = partners.compile_evaluation(game, 32)
    shares = {}
    for variant, ego in egos.items():
        games = play(
            jax.random.split(jax.random.key(1), 2),
            partners.flatten(ego),
            partners.flatten(frozen()),
            game.styles,
        )
        shares[variant] = np.asarray(games.returns.mean(axis=1) / game.styles.length)
    assert shares[INSTRUCTED].min() > 0.9
    # Without memory and told nothing, half of the steps are right. One who counts them knows that
    # a game is long after the third: then 3 of 3 and 2 of 5 are right.
    assert 0.65 < shares[GENERAL].mean() < 0.75
    # The partner's first action tells which it is, after a step in which it must guess.
    assert 0.78 < shares[ADAPTIVE].mean() < 0.95


def test_a_stored_ego_reads_raw_observations():
    game = ToyGame()
    state = jax.tree.map(lambda leaf: leaf[0], begin(game))
    normaliser = normalisation.update(normalisation.fresh(3), jnp.array([[1.0, 2, 3], [5, 2.5, 0]]))
    actor, _ = recurrent_egos.networks_of(game)
    seen = jax.random.normal(jax.random.key(2), (4, 1, 3))
    rest = jnp.ones((4, 1, 4)), jnp.zeros((4, 1), bool), recurrent_ppo.recurrent.no_memory(1)
    expected, _ = actor.apply(state.ego.actor, normalisation.normalise(normaliser, seen), *rest)
    raw = recurrent_egos.raw_actor(state.ego.actor, normaliser)
    np.testing.assert_allclose(actor.apply(raw, seen, *rest)[0], expected, rtol=1e-4, atol=1e-6)
