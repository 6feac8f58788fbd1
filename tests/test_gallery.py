"""Pictures of recorded games: they stop where the game does."""

import json

import jax
import numpy as np
import pytest
from PIL import Image

import envs
from envs.base import Pair
from envs.lbf import viewer
from experiments import gallery
from experiments.figures import strips
from haland_jax.rollout import Recording

STEPS = 20


@pytest.fixture(scope="module")
def env():
    return envs.make("lbf/spread", max_steps=STEPS)


def recording(env, length):
    """A game that ends after `length` steps by taking food 1; what follows repeats its end."""
    state, _ = env.reset(jax.random.key(0), env.style("level_1"))
    state = jax.tree.map(np.asarray, state)
    states = [state.replace(time=np.array(min(t, length))) for t in range(STEPS)]
    left = np.where(state.food_level == 1, 0, state.food_level)
    states[length:] = [moment.replace(food_level=left) for moment in states[length:]]
    steps = np.arange(STEPS)
    nothing = Pair(np.zeros(STEPS), np.zeros(STEPS))
    return Recording(
        states=jax.tree.map(lambda *leaves: np.stack(leaves), *states),
        observations=nothing,
        actions=nothing,
        rewards=(steps == length - 1).astype(np.float32),
        events=(steps == length - 1)[:, None, None] * counted_at_the_end(env),
        alive=steps < length,
    )


def counted_at_the_end(env):
    """Both players take food 1; the partner also stands somewhere, which is no skill."""
    events = np.zeros((2, len(env.event_names)), np.float32)
    events[:, env.event_names.index("take_food_1")] = 1
    events[:, env.event_names.index("take_food@north")] = 1
    events[1, env.event_names.index("stand@north")] = 1
    return events


@pytest.fixture
def drawn(monkeypatch):
    """(time, foods left, score) of every moment that is drawn."""
    seen = []
    draw = viewer.draw_state

    def spy(env, state, **options):
        seen.append((int(state.time), int((state.food_level > 0).sum()), options["score"]))
        return draw(env, state, **options)

    monkeypatch.setattr(viewer, "draw_state", spy)
    return seen


def test_an_episode_stops_at_the_games_end_and_holds_it(tmp_path, env, drawn):
    path = tmp_path / "a.gif"
    assert gallery.save_episode(env, path, recording(env, 6), "level_1", "The smallest.") == 1
    assert drawn == [(t, 8, 0) for t in range(6)] + [(6, 7, 1)]
    gif = Image.open(path)
    assert gif.n_frames == 7
    gif.seek(6)
    assert gif.info["duration"] >= 1000


@pytest.mark.parametrize("length", [STEPS - 1, STEPS])
def test_an_episode_that_used_its_time_shows_every_recorded_moment(env, length, tmp_path):
    path = tmp_path / "a.gif"
    gallery.save_episode(env, path, recording(env, length), "level_1", "The smallest.")
    assert Image.open(path).n_frames == STEPS


def test_an_episode_may_be_cut_to_its_first_steps(env, drawn, tmp_path):
    game = recording(env, 6)
    gallery.save_episode(env, tmp_path / "a.gif", game, "level_1", "The smallest.", steps=4)
    assert [time for time, _, _ in drawn] == [0, 1, 2, 3]


@pytest.mark.parametrize(("length", "step", "expected"), [(6, 100, 3), (6, 2, 2), (STEPS, 100, 10)])
def test_a_moment_is_of_the_game_and_not_of_what_follows(
    env, drawn, tmp_path, length, step, expected
):
    path = tmp_path / "a.png"
    game = recording(env, length)
    gallery.save_moment(env, path, game, "level_1", "The smallest.", step=step)
    assert drawn == [(expected, 8, 0)]
    assert path.is_file()
    assert path.with_suffix(".svg").is_file()


def test_the_moments_of_a_game_are_its_skills_and_some_in_between(env):
    found = gallery.moments(env, recording(env, 6))
    assert len(found) == gallery.STRIP
    named = [(moment["step"], moment["skill"], moment["score"]) for moment in found]
    assert named[-1] == (6, "both: take food 1", 1.0)
    steps = [step for step, _, _ in named]
    assert steps == sorted(steps)
    assert [skill for _, skill, _ in named[:-1]] == [""] * 5


def test_each_skill_is_shown_when_it_came_first_and_too_many_are_thinned_out(env):
    game = recording(env, STEPS)
    events = np.zeros((STEPS, 2, len(env.event_names)), np.float32)
    for food in range(1, 9):  # one after the other, and again
        for step in (food, food + 9):
            events[step, 0, env.event_names.index(f"take_food_{food}")] = 1
    found = gallery.moments(env, game.replace(events=events))
    skills = [moment["skill"] for moment in found]
    assert skills == [f"ego: take food {food}" for food in (1, 2, 4, 5, 7, 8)]
    assert [moment["step"] for moment in found] == [2, 3, 5, 6, 8, 9]


def test_a_state_comes_back_from_json(env):
    game = recording(env, 6)
    moment = json.loads(json.dumps(gallery.moments(env, game)))[-1]
    state = gallery.state_of(env, moment["state"])
    expected = jax.tree.map(lambda leaf: leaf[6], game.states)
    jax.tree.map(np.testing.assert_array_equal, state, expected)
    start, _ = env.reset(jax.random.key(0), env.style("level_1"))
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(start), strict=True)
    assert all(back.dtype == made.dtype for back, made in pairs)


def test_strips_show_the_moments_of_the_styles(env):
    episode = {"sentence": "The smallest.", "return": 1.0}
    episode["moments"] = json.loads(json.dumps(gallery.moments(env, recording(env, 6))))
    results = {
        "environment": "lbf/spread",
        "styles": ["level_1", "level_8"],
        "episodes": {"level_1": episode, "level_8": episode},
    }
    figure = strips.strip_of_two(results)
    assert [part.get_suptitle()[:8] for part in figure.subfigs] == ["level 1:", "level 8:"]
    titles = [axes.get_title() for axes in figure.subfigs[0].axes]
    assert titles[-1] == "step 6\nboth: take food 1"
    assert titles[0].strip() == "step 0"
    assert len(strips.strip_of_all(results).subfigs) == 2
