"""The arm as an environment: what is seen, whole random games, what is refused, pictures."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters.partial_eval import dce_jaxpr

import envs
from envs.assistive import control, model, physics, scene, viewer
from envs.base import Pair

STEPS = 40


@pytest.fixture(scope="module")
def env():
    return envs.make("assistive/jaco", max_steps=STEPS)


@pytest.fixture(scope="module")
def games(env):
    """A whole game of each style from the same start with the same random actions, [style, T]."""

    def play(style):
        state, first = env.reset(jax.random.key(3), style)

        def one_step(state, key):
            ego, partner = jax.random.split(key)
            actions = Pair(
                jax.random.uniform(ego, (7,), minval=-2, maxval=2),
                jax.random.uniform(partner, (6,), minval=-2, maxval=2),
            )
            state, timestep = env.step(key, state, actions, style)
            return state, (state, timestep)

        keys = jax.random.split(jax.random.key(4), STEPS)
        return state, first, *jax.lax.scan(one_step, state, keys)[1]

    program = jax.jit(jax.vmap(play), compiler_options=env.compiler_options)
    return jax.tree.map(np.asarray, program(env.styles))


def test_the_ego_s_first_observation_is_the_same_for_all_styles(games):
    _, first, _, _ = games
    ego, partner = first.observation
    np.testing.assert_array_equal(ego, np.broadcast_to(ego[:1], ego.shape))
    assert ego.std(axis=1).min() > 0.1
    # The partner sees what it wants.
    assert len(np.unique(partner, axis=0)) == len(partner)


def test_observations_have_their_sizes_and_parts(env, games):
    _, first, _, later = games
    assert env.observation_sizes == Pair(31, 46)
    for observed in (first.observation, later.observation):
        assert observed.ego.shape[-1] == 31
        assert observed.partner.shape[-1] == 46
        assert np.isfinite(observed.ego).all()
        assert np.isfinite(observed.partner).all()
    parts = env.feature_slices("ego")
    norms = np.linalg.norm(later.observation.ego[..., parts["tool_orientation"]], axis=-1)
    np.testing.assert_allclose(norms, 1.0, atol=1e-5)
    styles = later.observation.partner[..., env.feature_slices("partner")["style"]]
    np.testing.assert_array_equal(styles, np.repeat(np.eye(8)[:, None], STEPS, axis=1))


@pytest.mark.parametrize(
    ("options", "size"),
    [({"reveal_target": True}, 37), ({"tool": "per_task"}, 35), ({"tasks": ("feed",)}, 31)],
)
def test_options_change_what_the_ego_sees(options, size):
    assert envs.make("assistive/jaco", **options).observation_sizes.ego == size


def test_what_a_step_pays_the_learners_besides_the_reward(env, games):
    """The person for coming nearer to presenting, less what it costs not to present."""
    start, _, states, later = games
    before = np.concatenate([start.effort[:, None], states.effort[:, :-1]], axis=1)
    tilted, shown = later.shaped_reward.transpose(2, 0, 1)
    np.testing.assert_allclose(
        shown, 1.7 * (before - states.effort) - 0.1 * states.effort, atol=1e-5
    )
    assert (states.effort > 0.1).any()
    assert (tilted <= 0).all()
    of_task = {name.split("_")[0]: row for name, row in zip(env.style_names, tilted, strict=True)}
    assert (of_task["scratch"] == 0).all()
    assert (of_task["bathe"] == 0).all()


def test_a_style_pays_at_most_its_bonus():
    bounds = envs.make("assistive/jaco").upper_bounds()
    assert bounds["scratch_forearm"] == 5 * 200
    assert bounds["bathe_up"] == 5 * 20
    assert bounds["feed_left"] == 20 * 8
    assert bounds["drink_right"] == 10 * 64


def test_the_ego_may_be_shown_the_target_and_the_task():
    from envs.assistive import observation, tasks
    from envs.assistive.physics import Poses

    eye, zero = jnp.eye(3), jnp.zeros(3)
    tool = jnp.array([0.1, 0.2, 0.3])
    poses = Poses(tool, eye, zero, zero, zero, eye, eye, zero, eye, zero)
    target = tasks.Target(tool + jnp.array([0.0, 0.0, 0.5]), jnp.array(True), zero[0], zero, 20)
    from_tool, place = np.split(np.asarray(observation.target_features(poses, target)), 2)
    np.testing.assert_allclose(from_tool, [0, 0, 0.5], atol=1e-6)
    # The base stands at (-0.35, -0.3, 0.36) and is turned by -90 degrees about the vertical.
    np.testing.assert_allclose(place, [-0.5, 0.45, 0.44], atol=1e-5)
    parts = envs.make("assistive/jaco", reveal_target=True, tool="per_task").feature_slices("ego")
    assert parts["target_from_tool"] == slice(31, 34)
    assert parts["tool_kind"] == slice(37, 41)


def test_a_game_ends_with_its_time_and_never_before(games):
    _, _, states, later = games
    assert not later.terminated.any()
    np.testing.assert_array_equal(later.truncated[:, :-1], False)
    np.testing.assert_array_equal(later.truncated[:, -1], True)
    np.testing.assert_array_equal(states.time[0], np.arange(1, STEPS + 1))


def test_joints_stay_within_what_their_style_and_the_game_allow(env, games):
    _, _, states, _ = games
    moved = np.abs(np.diff(states.body.angles, axis=1)).max(axis=(0, 1))
    assert moved.min() > 0.01
    ranges = np.asarray(env.styles.ranges)[:, None] + states.habit[..., None]
    lowest, highest = ranges[:, STEPS // 2 :].transpose(3, 0, 1, 2)
    # A servo keeps its speed nearly, so a joint may pass its limit by a little.
    late = states.body.angles[:, STEPS // 2 :]
    assert (late > lowest - 0.03).all()
    assert (late < highest + 0.03).all()


def test_speeds_stay_below_those_of_the_servos(games):
    _, _, states, _ = games
    assert np.abs(states.body.speeds).max() < 0.63 * 1.1


@pytest.fixture(scope="module")
def starts(env):
    """Starts of bathing by the share of random moments: states, [game]."""
    seated = dataclasses.replace(env, seat_spread=0.1)
    style = seated.style("bathe_down")

    @functools.partial(jax.jit, compiler_options=env.compiler_options)
    def draw(keys, share):
        return jax.vmap(lambda key: seated.training_reset(key, style, share)[0])(keys)

    keys = jax.random.split(jax.random.key(8), 200)
    return {share: jax.tree.map(np.asarray, draw(keys, share)) for share in (0.0, 0.5, 1.0)}


def test_training_starts_as_games_do_or_at_random_moments(env, starts):
    usual, mixed, random = (starts[share] for share in (0.0, 0.5, 1.0))
    assert usual.time.max() == usual.progress.done.max() == 0
    assert np.abs(usual.body.angles - model.HOME).max() < 0.5
    assert 60 < (mixed.time > 0).sum() < 140
    assert random.time.min() >= 0
    assert STEPS // 2 < random.time.max() < 3 * STEPS // 4
    assert random.progress.done.max() == random.progress.reached.max() == 19
    apart = (random.body.angles - model.HOME)[:, :7]
    assert 0.35 < apart.std() < 0.45
    person = random.body.angles[:, 7:]
    low, high = np.asarray(env.style("bathe_down").ranges)[7:].T
    assert (person >= low - 1e-4).all()
    assert (person <= high + 1e-4).all()
    assert person.std(axis=0).min() > 0.01


def test_the_person_sits_elsewhere_and_holds_itself_otherwise_in_every_game(env, starts):
    seats, habits = starts[0.0].body.seat, starts[0.0].habit
    assert np.abs(seats).max() <= 0.1
    np.testing.assert_allclose(seats.std(axis=0), 0.2 / np.sqrt(12), rtol=0.2)
    assert (habits[:, :7] == 0).all()
    assert np.abs(habits).max() <= env.posture_spread
    most = 2 * env.posture_spread
    np.testing.assert_allclose(habits[:, 7:].std(axis=0), most / np.sqrt(12), rtol=0.2)


@pytest.mark.parametrize("still", [None, "ego", "partner"])
def test_actions_of_one_that_stays_still_count_for_nothing(env, still):
    """Nothing that a step makes depends on them: found in the traced program, so not compiled."""
    env = dataclasses.replace(env, still=still)
    style = env.style("feed_left")
    state, _ = jax.eval_shape(lambda key: env.reset(key, style), jax.random.key(0))
    actions = Pair(*(jax.ShapeDtypeStruct((size,), jnp.float32) for size in env.num_actions))

    def step(actions, state):
        return env.step(jax.random.key(0), state, actions, style)

    traced = jax.make_jaxpr(step)(actions, state).jaxpr
    _, used = dce_jaxpr(traced, [True] * len(traced.outvars))
    assert used[:2] == [still != "ego", still != "partner"]


def test_tasks_can_be_chosen():
    env = envs.make("assistive/jaco", tasks=("feed", "bathe"))
    assert env.style_names == ("bathe_down", "bathe_up", "feed_left", "feed_right")
    assert set(env.upper_bounds()) == set(env.style_names)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": ("iron",)}, "tasks has 'iron'; expected some of scratch, bathe"),
        ({"tasks": ()}, "tasks has nothing"),
        ({"tool": "spoon"}, "tool is 'spoon'; expected one of universal, per_task"),
        ({"max_steps": 0}, "max_steps is 0; expected at least 1"),
        ({"still": "robot"}, "still is 'robot'; expected ego, partner or None"),
        ({"seat_spread": 0.5}, r"seat_spread is 0\.5; expected 0 to 0\.2 m"),
        ({"posture_spread": -1.0}, r"posture_spread is -1\.0; expected 0 to 0\.13 rad"),
        ({"gravity": 1}, "unknown option 'gravity' of assistive; expected one of max_steps"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        envs.make("assistive/jaco", **options)


def test_an_unknown_robot_and_style_are_refused(env):
    with pytest.raises(ValueError, match="unknown environment 'assistive/sawyer'"):
        envs.make("assistive/sawyer")
    with pytest.raises(ValueError, match="unknown style 'feed_me'"):
        env.style("feed_me")


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (Pair(np.full(7, np.nan), np.zeros(6)), "the ego's action is .*; expected finite numbers"),
        (Pair(np.zeros(7), np.array([0, 0, np.inf, 0, 0, 0])), "the partner's action is"),
        (Pair(np.zeros(6), np.zeros(6)), r"the ego's action has shape \(6,\); expected \(7,\)"),
    ],
)
def test_bad_actions_are_refused_before_anything_is_compiled(env, games, actions, message):
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), games[0])
    with pytest.raises(ValueError, match=message):
        env.step(jax.random.key(0), state, actions, env.style("feed_left"))


def test_a_picture_shows_both_and_what_is_wanted(env, games, tmp_path):
    states = games[2]
    style = env.style("scratch_forearm")
    moments = jax.tree.map(lambda leaf: leaf[1, ::10], states)
    one = jax.tree.map(lambda leaf: leaf[0], moments)
    seen = viewer.draw_state(env, one, style=style, score=-1.25, caption="My forearm itches.")
    unseen = viewer.draw_state(env, one)
    shapes = seen.panels[1].shapes
    assert len(shapes) > len(unseen.panels[1].shapes) > model.mujoco_model().ngeom
    texts = [shape.text for shape in shapes if hasattr(shape, "text")]
    assert texts == ["strokes 0, success from 25"]
    ring = next(shape for shape in shapes if getattr(shape, "stroke", None) == scene.PROGRESS)
    assert 0 < ring.x < scene.WIDTH
    assert 0 < ring.y < scene.HEIGHT
    viewer.save_gif(tmp_path / "game.gif", env, moments, style=style)
    assert (tmp_path / "game.gif").stat().st_size > 5000


def test_a_page_holds_the_episode(env, games, tmp_path):
    path = tmp_path / "game.html"
    viewer.save_html(path, env, jax.tree.map(lambda leaf: leaf[0, :3], games[2]))
    assert "<html" in Path(path).read_text(encoding="utf-8").lower()


def test_an_impossible_moment_is_not_drawn(env, games):
    moment = jax.tree.map(lambda leaf: leaf[0, 0], games[2])
    broken = moment.replace(body=moment.body.replace(angles=np.full(13, np.nan)))
    with pytest.raises(ValueError, match="expected 13 finite numbers"):
        viewer.draw_state(env, broken)


def test_one_that_stays_still_comes_back_to_where_games_start():
    home = jnp.asarray(model.HOME)
    away = jnp.zeros(len(model.JOINTS)).at[7].set(0.02).at[8].set(-0.3)
    body = physics.at_rest(home + away, jnp.zeros(3))
    back = control.speeds_back_home(body)
    # What is 0.02 rad away is back after a step of 0.1 s at 0.2 of 0.63 rad/s, the other as fast
    # as it can.
    expected = np.zeros(len(model.JOINTS))
    expected[7], expected[8] = -0.2 / control.FULL_SPEED, 1.0
    np.testing.assert_allclose(back, expected, atol=1e-5)
