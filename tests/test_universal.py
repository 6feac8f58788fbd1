"""Universal egos: who plays with whom in which style, who is told what, and that they learn."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_game import ToyGame, always

import envs
from envs.base import Pair
from envs.labelled import Labelled, LabelledStyle
from experiments import configs, run_all, training
from haland_jax import networks, partners, ppo, rollout, universal
from haland_jax.learner import StylesByGame, init_learner, learner_from, make_networks
from haland_jax.partners import Player
from haland_jax.ppo import PPOConfig
from haland_jax.universal import UniversalConfig

TINY = PPOConfig(
    total_steps=80, num_envs=8, rollout_steps=5, num_minibatches=2, epochs=1, confined_until=0.0
)
CONFIG = UniversalConfig(seeds=2, training=TINY)


@dataclasses.dataclass(frozen=True)
class HiddenPreference(ToyGame):
    """A step pays 1 where the ego's action is 0 in the style `short`, 2 in the style `long`.

    The ego cannot see which it is: told nothing it earns half of the steps at best.
    """

    style_names: tuple[str, ...] = ("short", "long")

    def reset(self, key, style):
        state, timestep = super().reset(key, style)
        return state, self._blind(timestep)

    def step(self, key, state, actions, style):
        state, timestep = super().step(key, state, actions, style)
        wanted = jnp.where(style.length == 3, 0, 2)
        reward = (actions.ego == wanted).astype(jnp.float32)
        return state, self._blind(timestep.replace(reward=reward))

    @staticmethod
    def _blind(timestep):
        ego, partner = timestep.observation
        return timestep.replace(observation=Pair(jnp.zeros_like(ego), partner))


def frozen_partners(actions: list[list[int]]):
    """Partners that always play these actions, leading axes [style, seed]."""
    rows = [
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *[always(a, 2, 4, 64) for a in row])
        for row in actions
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def train(env, config, members, updates):
    return partners.compile_training(env, config.training, updates)(
        members, universal.member_styles(env, config.seeds)
    )


def test_the_ego_sees_the_label_and_everything_else_stays():
    game = ToyGame()
    env = Labelled(game)
    for index, name in enumerate(game.style_names):
        style = env.style(name)
        for leaf, stacked in zip(jax.tree.leaves(style), jax.tree.leaves(env.styles), strict=True):
            np.testing.assert_array_equal(leaf, stacked[index])
        state, first = env.reset(jax.random.key(0), style)
        _, later = env.step(jax.random.key(1), state, Pair(jnp.int32(2), jnp.int32(0)), style)
        plain_state, plain_first = game.reset(jax.random.key(0), style.style)
        _, plain_later = game.step(
            jax.random.key(1), plain_state, Pair(jnp.int32(2), jnp.int32(0)), style.style
        )
        for labelled, plain in ((first, plain_first), (later, plain_later)):
            seen = np.concatenate([plain.observation.ego, np.eye(2)[index]])
            np.testing.assert_array_equal(labelled.observation.ego, seen)
            np.testing.assert_array_equal(labelled.observation.partner, plain.observation.partner)
            assert labelled.reward == plain.reward
        assert env.observation_sizes == Pair(5, 4)
    assert bool(env.confine(env.style("long")).style.bound)
    np.testing.assert_array_equal(env.hidden_styles.label, np.zeros((2, 2)))


def test_each_game_has_its_partners_style():
    # The partner's action pays: the short style's partners play 1 and 0, the long style's 0 and 1.
    env = Labelled(ToyGame(ego_weight=0.0, partner_weight=1.0))
    config = UniversalConfig(seeds=1, training=TINY)
    state = universal.init_universal(
        env, config, jax.random.key(0), frozen_partners([[1, 0], [0, 1]])
    )
    one, styles = jax.tree.map(lambda leaf: leaf[1], (state, universal.member_styles(env, 1)))
    np.testing.assert_array_equal(one.observations.ego[:, 3:], np.repeat(np.eye(2), 4, axis=0))
    _, steps = jax.jit(lambda *given: ppo._rollout(env, TINY, *given, 0.0))(
        one, styles, jax.random.key(1)
    )
    # Games 0 to 3 are short ones and end every third step; games 4 to 7 end with the fifth.
    ended = np.asarray(steps["ended"])
    np.testing.assert_array_equal(ended[:, :4], np.tile([[0], [0], [1], [0], [0]], 4))
    np.testing.assert_array_equal(ended[:, 4:], np.tile([[0], [0], [0], [0], [1]], 4))
    np.testing.assert_array_equal(steps["reward"], np.tile([1, 1, 0, 0, 0, 0, 1, 1], (5, 1)))
    # Restarted games keep their style.
    labels = np.broadcast_to(np.repeat(np.eye(2), 4, axis=0), (5, 8, 2))
    np.testing.assert_array_equal(steps["observations"].ego[..., 3:], labels)


def test_a_style_for_all_games_and_the_same_style_by_game_play_alike():
    game = ToyGame(ego_weight=1.0)
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), game.style("long"))
    actors, critic = make_networks(game)
    ego = init_learner(jax.random.key(0), actors.ego, critic, 3, TINY)
    frozen = partners.flatten(frozen_partners([[0], [1]]))
    found = []
    for style in (game.style("long"), StylesByGame(twice)):
        state = ppo.init_train_state(game, TINY, jax.random.key(1), ego, frozen, style)
        _, metrics = jax.jit(partial(ppo.train_chunk, game, TINY, 1))(state, style)
        found.append(float(metrics["return"][0]))
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_a_minibatch_has_games_of_all_styles(monkeypatch):
    # A batch whose observations are the numbers of its games.
    seen = []

    def watched_loss(params, batch, *_):
        jax.debug.callback(lambda games: seen.append(np.unique(games)), batch.observation)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(params))

    monkeypatch.setattr(ppo, "ppo_loss", watched_loss)
    leaf = jnp.broadcast_to(jnp.arange(8.0), (5, 8))
    batch = ppo.Batch(leaf, leaf, leaf, leaf, leaf, leaf)
    learner = learner_from({"w": jnp.zeros(2)}, {"w": jnp.zeros(2)}, TINY)
    for strided in (False, True):
        learn = partial(ppo._learn, TINY, None, None, learner, batch, strided=strided)
        jax.block_until_ready(learn(learning_rate=jnp.ones(()), entropy_weight=jnp.ones(())))
    jax.effects_barrier()
    assert sorted(map(tuple, seen[:2])) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    assert sorted(map(tuple, seen[2:])) == [(0, 2, 4, 6), (1, 3, 5, 7)]


def test_both_variants_of_a_seed_start_alike_and_only_one_is_told():
    env = Labelled(ToyGame())
    state = universal.init_universal(env, CONFIG, jax.random.key(0), frozen_partners([[0], [1]]))
    kernel = np.asarray(state.ego.actor["params"]["dense_0"]["kernel"])
    np.testing.assert_array_equal(kernel[:2], kernel[2:])
    assert (kernel[0] != kernel[1]).any()
    labels = np.asarray(state.observations.ego[..., 3:])
    assert (labels[:2] == 0).all()
    np.testing.assert_array_equal(labels[2:].sum(axis=-1), 1)
    trained, _ = train(env, CONFIG, state, 2)
    moved = np.asarray(trained.ego.actor["params"]["dense_0"]["kernel"]) - kernel
    # Without a label its weights learn nothing; with it they do.
    assert (moved[:2, 3:] == 0).all()
    assert (np.abs(moved[2:, 3:]).max(axis=(1, 2)) > 0).all()


def test_a_folded_label_plays_as_the_told_ego():
    key = jax.random.key(0)
    policy = networks.MLPActor(3, (4, 4)).init(key, jnp.zeros(7))
    policy = jax.tree.map(lambda leaf: leaf + 0.3, policy)
    seen, label = jnp.array([0.2, -1.0, 0.5]), jnp.array([0.0, 0.0, 1.0, 0.0])
    folded = universal.fold_label(policy, label)
    assert folded["params"]["dense_0"]["kernel"].shape == (3, 4)
    np.testing.assert_allclose(
        networks.act(folded, seen), networks.act(policy, jnp.append(seen, label)), rtol=1e-5
    )


def test_a_folded_label_values_as_the_told_critic():
    critic = networks.MLPCritic((4, 4))
    params = critic.init(jax.random.key(0), jnp.zeros(7))
    seen, label = jnp.array([0.2, -1.0, 0.5]), jnp.array([0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        critic.apply(universal.fold_label(params, label), seen),
        critic.apply(params, jnp.append(seen, label)),
        rtol=1e-5,
    )


def test_partners_that_cannot_share_the_games_are_refused():
    env, config = Labelled(ToyGame()), UniversalConfig(training=TINY)
    with pytest.raises(ValueError, match="is 8; expected a multiple of 6, the number of partners"):
        universal.init_universal(
            env, config, jax.random.key(0), frozen_partners([[0, 1, 0], [1, 0, 1]])
        )


@pytest.mark.parametrize("environment", run_all.asked_environments(run_all.ALL))
@pytest.mark.parametrize("preset", configs.PRESETS)
def test_the_presets_share_the_games_of_eight_styles_in_equal_parts(preset, environment):
    config = configs.PRESETS[preset](environment, 0)
    # Every styled kitchen has one mirror, so each partner has one image.
    images = 1 + len(envs.make(environment).symmetries)
    teachers = images * config.partners.known_seeds
    assert config.partners.refit.num_envs % teachers == 0
    training = config.universal.training
    assert training.num_envs % (8 * teachers) == 0
    # A minibatch takes every n-th game and shall have some of every style.
    assert training.num_minibatches <= training.num_envs // 8


def test_the_told_ego_learns_what_the_other_cannot():
    game = HiddenPreference()
    env = Labelled(game)
    config = UniversalConfig(
        training=PPOConfig(
            total_steps=16 * 10 * 40,
            num_envs=16,
            rollout_steps=10,
            num_minibatches=2,
            learning_rate=2e-2,
            entropy=0.0,
            final_entropy=0.0,
            reward_scale=1.0,
            confined_until=0.0,
        )
    )
    frozen = frozen_partners([[0], [1]])
    state = universal.init_universal(env, config, jax.random.key(0), frozen)
    state, _ = train(env, config, state, config.training.num_updates)
    by_style = universal.players_by_style(env, Player.of(state.ego))
    assert tuple(by_style) == universal.VARIANTS
    shares = {}
    for variant, players in by_style.items():
        flat = partners.flatten(players.actor)
        assert flat["params"]["dense_0"]["kernel"].shape == (2, 3, 64)
        play = partners.compile_evaluation(game, 16)
        games = play(
            jax.random.split(jax.random.key(1), 2), flat, partners.flatten(frozen), game.styles
        )
        shares[variant] = np.asarray(games.returns.mean(axis=1) / game.styles.length)
    assert shares["told the style"].min() > 0.9
    # Whatever one action it prefers, it is wrong in one of the two styles.
    assert shares["told nothing"].mean() < 0.6
    # In the labelled environment the told ego earns the same.
    told = jax.tree.map(lambda leaf: leaf[1], state.ego.actor)
    labelled = rollout.play(
        env, jax.random.key(2), told, always(0, 2, 4), env.style("long"), num_games=16
    )
    assert float(labelled.returns.mean()) / 5 > 0.9


def test_a_guided_ego_plays_as_the_guide_of_its_partners_style():
    # Nothing pays, so all that there is to learn is what the guides say.
    game = ToyGame(ego_weight=0.0)
    env = Labelled(game)
    config = UniversalConfig(
        training=dataclasses.replace(
            TINY, total_steps=8 * 5 * 60, learning_rate=2e-2, guidance=1.0, guidance_until=10.0
        )
    )
    guides = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *[always(action, 3, 3, 64) for action in (0, 2)]
    )
    frozen = frozen_partners([[0], [1]])
    state = universal.init_universal(env, config, jax.random.key(0), frozen, guides)
    state, _ = train(env, config, state, config.training.num_updates)
    told = universal.players_by_style(env, Player.of(state.ego))[universal.TOLD_THE_STYLE].actor
    for style, action in enumerate((0, 2)):
        ego = jax.tree.map(lambda leaf, style=style: leaf[style, 0], told)
        chances = jax.nn.softmax(networks.act(ego, jnp.array([1.0, 0.4, 0.5])))
        assert float(chances[action]) > 0.9


def test_guides_see_what_they_are_used_to_whatever_the_label_is():
    env = Labelled(ToyGame())
    actor = networks.MLPActor(3, (4, 4))
    keys = jax.random.split(jax.random.key(0), 2)
    guides = jax.vmap(lambda key: actor.init(key, jnp.zeros(3)))(keys)
    guides = jax.tree.map(lambda leaf: leaf + 0.3, guides)
    seen, label = jnp.array([0.2, -1.0, 0.5]), jnp.array([0.7, -2.0])
    labelled = universal._with_labels(env, guides)
    for style in range(2):
        plain, told = (
            jax.tree.map(lambda leaf, style=style: leaf[style], policies)
            for policies in (guides, labelled)
        )
        np.testing.assert_allclose(
            networks.act(told, jnp.concatenate([seen, label])), networks.act(plain, seen), rtol=1e-6
        )


@pytest.mark.parametrize("guidance", [0.0, 1.0])
def test_guides_are_given_where_they_are_followed_and_only_there(guidance):
    config = UniversalConfig(training=dataclasses.replace(TINY, guidance=guidance))
    guides = None if guidance else frozen_partners([[0], [1]])
    with pytest.raises(ValueError, match="expected both or neither"):
        universal.init_universal(
            Labelled(ToyGame()), config, jax.random.key(0), frozen_partners([[0], [1]]), guides
        )


def test_guidance_falls_linearly_to_nothing():
    assert [float(ppo.fading(2.0, 0.5, p)) for p in (0.0, 0.25, 0.5, 0.75)] == [2.0, 1.0, 0.0, 0.0]


class Killed(BaseException):
    """Stands for a process that dies."""


@pytest.mark.parametrize("guidance", [0.0, 1.0])
def test_interrupted_training_ends_alike(monkeypatch, tmp_path, guidance):
    env = Labelled(ToyGame())
    config = dataclasses.replace(
        CONFIG, training=dataclasses.replace(TINY, total_steps=160, guidance=guidance), seeds=1
    )
    guides = jax.tree.map(lambda leaf: leaf[None].repeat(2, axis=0), always(2, 3, 3, 64))
    assert config.training.num_updates == 4
    frozen = frozen_partners([[0], [1]])

    def run(path, die_after=None):
        def report(done, metrics):
            if done == die_after:
                raise Killed

        return training.train_population(
            env,
            config.training,
            lambda: universal.init_universal(
                env, config, jax.random.key(0), frozen, guides if guidance else None
            ),
            universal.member_styles(env, config.seeds),
            training.Saver(path),
            report,
            "universal egos",
        )

    monkeypatch.setattr(training, "UPDATES_PER_PIECE", 2)
    # However slow the machine, the uninterrupted training saves nothing.
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", float("inf"))
    whole, returns = run(tmp_path / "whole")
    assert not (tmp_path / "whole").exists()
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    with pytest.raises(Killed):
        run(tmp_path / "resumed", die_after=4)
    assert (tmp_path / "resumed").exists()
    resumed, resumed_returns = run(tmp_path / "resumed")
    np.testing.assert_allclose(resumed_returns, returns, rtol=1e-6)
    for one, two in zip(jax.tree.leaves(whole.ego), jax.tree.leaves(resumed.ego), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-6)
    assert isinstance(env.styles, LabelledStyle)
