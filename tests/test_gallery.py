"""Pictures of recorded games: they stop where the game does."""

import jax
import numpy as np
import pytest
from PIL import Image

import envs
from envs.base import Pair
from envs.lbf import viewer
from experiments import gallery
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
        alive=steps < length,
    )


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
