"""Spread: its start, its rules, what is seen of it, its events and its shaped reward."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.lbf import dynamics, features, reward, scripted, spread
from envs.lbf.dynamics import EAST, LOAD, NONE, NORTH, SOUTH, WEST

FEATURES = jax.jit(features.features, static_argnums=0)
CENTRE = [(row, column) for row in (3, 4, 5) for column in (3, 4, 5)]


@pytest.fixture(scope="module")
def env():
    return envs.make("lbf/spread")


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture(scope="module")
def starts(env):
    """The first states of many games, as NumPy arrays, leading axis [game]."""
    keys = jax.random.split(jax.random.key(0), 2000)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(spread.start_state))(keys))


def drawn_state(places, *, ego=(4, 4), partner=(4, 5), time=0):
    """A moment with the foods of level 1, 2, ... at the given places."""
    return dynamics.State(
        place=jnp.array([ego, partner], jnp.int32),
        level=jnp.full(2, 4, jnp.int32),
        food_place=jnp.asarray(places, jnp.int32),
        food_level=jnp.arange(1, 9, dtype=jnp.int32),
        time=jnp.int32(time),
    )


def play(env, step, state, style, moves):
    """Plays (ego, partner) actions; returns the states and the time steps."""
    states, timesteps = [state], []
    for ego, partner in moves:
        actions = envs.Pair(jnp.int32(ego), jnp.int32(partner))
        state, timestep = step(jax.random.key(0), states[-1], actions, style)
        states.append(state)
        timesteps.append(timestep)
    return states, timesteps


def test_starts_are_drawn_from_all_of_the_centre_and_all_orders_of_the_foods(starts):
    assert (starts.level == 4).all()
    assert (starts.food_level == np.arange(1, 9)).all()
    assert (starts.time == 0).all()
    pairs = {tuple(map(tuple, place)) for place in starts.place.tolist()}
    assert pairs == set(itertools.permutations(CENTRE, 2))
    places = sorted(map(tuple, spread.PLACES.tolist()))
    for food_place in starts.food_place[:50]:
        assert sorted(map(tuple, food_place.tolist())) == places
    # Each food lies at each place in an eighth of the games: 250, give or take 15.
    at = (starts.food_place[:, :, None] == spread.PLACES).all(axis=-1).sum(axis=0)
    assert at.min() > 250 - 75
    assert at.max() < 250 + 75


def test_every_style_pays_its_own_level_and_ends_the_game(env, step):
    assert env.style_names == tuple(f"level_{level}" for level in range(1, 9))
    for target in (1, 8):
        style = env.style(f"level_{target}")
        for level in range(1, 9):
            places = np.roll(spread.PLACES, level - 1, axis=0)  # this food is at the north west
            state = drawn_state(places, ego=(0, 1), partner=(1, 0))
            states, (timestep,) = play(env, step, state, style, [(LOAD, LOAD)])
            assert float(timestep.reward) == (level == target)
            assert bool(timestep.terminated) == (level == target)
            assert not bool(timestep.truncated)
            expected = [0 if one == level else one for one in range(1, 9)]
            assert states[-1].food_level.tolist() == expected


def test_a_food_is_taken_by_both_or_not_at_all(env, step):
    style = env.style("level_1")
    state = drawn_state(spread.PLACES, ego=(0, 1), partner=(1, 0))
    for moves in ((LOAD, NONE), (NONE, LOAD)):
        states, (timestep,) = play(env, step, state, style, [moves])
        assert states[-1].food_level.tolist() == list(range(1, 9))
        assert float(timestep.reward) == 0
    # A food at the upper border is loaded from the row below too.
    below = drawn_state(spread.PLACES, ego=(1, 4), partner=(0, 3))
    states, (timestep,) = play(env, step, below, env.style("level_2"), [(LOAD, LOAD)])
    assert float(timestep.reward) == 1


def test_the_time_is_up_after_max_steps():
    env = envs.make("lbf/spread", max_steps=12)
    step = jax.jit(env.step)
    state = drawn_state(spread.PLACES)
    _, timesteps = play(env, step, state, env.style("level_3"), [(NONE, NONE)] * 12)
    assert [bool(t.truncated) for t in timesteps] == [False] * 11 + [True]
    assert not any(bool(t.terminated) for t in timesteps)


@pytest.mark.parametrize("encoding", ["features", "flat", "grid"])
@pytest.mark.parametrize("sight", [None, 2])
def test_the_ego_is_not_told_the_style_and_the_partner_is(encoding, sight):
    env = envs.make("lbf/spread", encoding=encoding, sight=sight)
    reset = jax.jit(jax.vmap(env.reset, in_axes=(None, 0)))
    state, timestep = reset(jax.random.key(3), env.styles)
    for leaf in (timestep.observation.ego, *jax.tree.leaves(state)):
        np.testing.assert_array_equal(leaf, np.broadcast_to(leaf[:1], leaf.shape))
    partner = np.asarray(timestep.observation.partner).reshape(8, -1)
    assert partner.shape[1] == env.observation_sizes.partner
    assert timestep.observation.ego[0].size == env.observation_sizes.ego
    if encoding != "grid":
        np.testing.assert_array_equal(partner[:, -8:], np.eye(8))
        seen = partner[:, :-8]
        np.testing.assert_array_equal(seen, np.broadcast_to(seen[:1], seen.shape))


def test_the_grid_marks_the_partners_target(env):
    env = envs.make("lbf/spread", encoding="grid")
    state, timestep = jax.jit(env.reset)(jax.random.key(5), env.style("level_6"))
    seen = np.asarray(timestep.observation.partner)
    (where,) = np.argwhere(seen[3])
    expected = np.asarray(state.food_place[5] - state.place[1] + 9)
    np.testing.assert_array_equal(where, expected)
    assert seen[1][tuple(where)] == 6


def test_features_by_hand(env):
    state = drawn_state(spread.PLACES, ego=(0, 1), partner=(2, 4), time=10)
    state = state.replace(food_level=state.food_level.at[6].set(0))
    first, second = np.asarray(FEATURES(env.rules, state))
    names = features.feature_slices(8)
    assert names["time_left"].stop == env.observation_sizes.ego == len(first)
    ego = {name: first[where].tolist() for name, where in names.items()}
    partner = {name: second[where].tolist() for name, where in names.items()}
    assert ego["own_place"] == [-1, -0.75]
    assert ego["blocked"] == [1, 0, 1, 0]
    assert ego["other_away"] == [2 / 8, 3 / 8]
    assert ego["other_side"] == [1, 1]
    assert partner["other_side"] == [-1, -1]
    assert ego["food_there"] == partner["food_there"] == [1, 1, 1, 1, 1, 1, 0, 1]
    assert ego["food_away"][0::8] == [0, -1 / 8]
    assert ego["food_side"][7::8] == [1, 1]
    assert ego["food_away"][6::8] == [0, 0]
    assert ego["own_beside"] == partner["other_beside"] == [1] + [0] * 7
    assert ego["other_steps"] == partner["own_steps"]
    assert partner["own_steps"][1] == pytest.approx(1 / 16)
    assert partner["own_steps"][6] == 0
    assert ego["time_left"] == [pytest.approx(0.8)]
    assert ego["same_food"] == [0]
    both = FEATURES(env.rules, drawn_state(spread.PLACES, ego=(0, 1), partner=(1, 0)))
    np.testing.assert_array_equal(both[:, names["same_food"]], 1)
    # The other player blocks a cell as a food does.
    close = FEATURES(env.rules, drawn_state(spread.PLACES, ego=(4, 4), partner=(4, 5)))
    assert close[:, names["blocked"]].tolist() == [[0, 0, 0, 1], [0, 0, 1, 0]]


def test_limited_sight_hides_what_is_far():
    env = envs.make("lbf/spread", sight=3)
    state = drawn_state(spread.PLACES, ego=(1, 1), partner=(1, 5))
    names = features.feature_slices(8)
    ego, partner = np.asarray(FEATURES(env.rules, state))
    assert ego[names["other_seen"]] == 0
    assert ego[names["food_there"]].tolist() == [1, 1, 0, 1, 0, 0, 0, 0]
    assert partner[names["food_there"]].tolist() == [0, 1, 1, 0, 1, 0, 0, 0]
    moved = state.replace(
        place=state.place.at[1].set(jnp.array([6, 6])),
        food_place=state.food_place[jnp.array([0, 1, 4, 3, 2, 7, 6, 5])],
    )
    np.testing.assert_array_equal(FEATURES(env.rules, moved)[0], ego)


def test_only_the_egos_view_of_the_partner_ends_at_partner_sight():
    near, far = (drawn_state(spread.PLACES, ego=(4, 4), partner=(row, 4)) for row in (6, 7))
    rules = envs.make("lbf/spread").rules
    names = features.feature_slices(8)
    seen = jax.jit(lambda state: features.features(rules, state, 2))
    np.testing.assert_array_equal(seen(near), FEATURES(rules, near))
    ego, partner = np.asarray(seen(far))
    full_ego, full_partner = np.array(FEATURES(rules, far))
    np.testing.assert_array_equal(partner, full_partner)
    assert full_ego[names["other_seen"]] == full_ego[names["other_beside"]].sum() == 1
    for name in ("other_away", "other_side", "other_seen", "other_steps", "other_beside"):
        full_ego[names[name]] = 0
    np.testing.assert_array_equal(ego, full_ego)


def test_events_name_the_food_and_the_place(env, step):
    places = np.roll(spread.PLACES, 1, axis=0)  # level 1 at the south east, level 2 north west
    state = drawn_state(places, ego=(0, 1), partner=(1, 0))
    _, timesteps = play(env, step, state, env.style("level_8"), [(LOAD, LOAD), (SOUTH, SOUTH)])
    named = [
        [{env.event_names[k] for k in np.flatnonzero(timestep.events[player])} for player in (0, 1)]
        for timestep in timesteps
    ]
    taken = {"take_food_2", "take_food@north_west", "stand@north_west"}
    assert named[0] == [taken, taken]
    assert named[1] == [{"stand@north_west"}, set()]
    assert len(set(env.event_names)) == len(env.event_names) == 24


def test_each_term_of_the_shaping_fires(env):
    weights = reward.ShapingWeights()

    @jax.jit
    def all_terms(state, actions, target):
        transition = dynamics.step(env.rules, state, actions)
        return reward.shaping_terms(transition, target, weights)

    def terms(ego, partner, actions, target):
        state = drawn_state(spread.PLACES, ego=ego, partner=partner)
        found = all_terms(state, jnp.array(actions), target)
        return {name: value.tolist() for name, value in found.items() if np.any(value)}

    near, farther = pytest.approx(weights.approach), pytest.approx(-weights.approach)
    # Level 2 lies in the north: one player comes nearer, the other goes away.
    assert terms((4, 4), (4, 5), (NORTH, SOUTH), 2) == {"approach": [near, farther]}
    meet = terms((1, 4), (1, 3), (NONE, NORTH), 2)
    assert meet == {"approach": [0, near], "meet": [pytest.approx(weights.meet)] * 2}
    assert terms((1, 4), (0, 3), (LOAD, LOAD), 2) == {"take": [pytest.approx(weights.take)] * 2}
    assert terms((1, 4), (0, 3), (LOAD, LOAD), 5) == {"waste": [pytest.approx(weights.waste)] * 2}


def test_the_shaping_of_a_way_that_ends_where_it_began_is_zero(env, step):
    style = env.style("level_2")
    state = drawn_state(spread.PLACES, ego=(1, 4), partner=(1, 3))
    there = [(NONE, NORTH), (WEST, NONE), (SOUTH, WEST)]
    back = [(NORTH, EAST), (EAST, NONE), (NONE, SOUTH)]
    states, timesteps = play(env, step, state, style, there + back)
    np.testing.assert_array_equal(states[-1].place, state.place)
    shaped = np.array([timestep.shaped_reward for timestep in timesteps])
    assert (np.abs(shaped) > 0).sum() >= 6
    np.testing.assert_allclose(shaped.sum(axis=0), 0, atol=1e-6)


def test_training_starts_at_random_moments_that_can_still_be_won(env):
    keys = jax.random.split(jax.random.key(1), 1500)
    reset = jax.jit(jax.vmap(env.training_reset, in_axes=(0, None, None)))
    style = env.style("level_5")
    state, timestep = jax.tree.map(np.asarray, reset(keys, style, 1.0))
    assert (state.food_level[:, 4] == 5).all()
    gone = (state.food_level == 0).mean(axis=0)
    assert gone[4] == 0
    np.testing.assert_allclose(np.delete(gone, 4), spread.TAKEN_SHARE, atol=0.06)
    assert state.time.min() == 0
    assert state.time.max() == env.max_steps - spread.LEAST_TIME_LEFT
    assert not timestep.done.any()
    assert (state.place[:, 0] != state.place[:, 1]).any(axis=1).all()
    on_a_place = (state.place[:, :, None] == spread.PLACES).all(axis=-1).any()
    assert not on_a_place
    cells = {tuple(cell) for cell in state.place.reshape(-1, 2).tolist()}
    assert len(cells) == 81 - 8
    usual, _ = jax.tree.map(np.asarray, reset(keys, style, 0.0))
    assert (usual.time == 0).all()
    assert (usual.food_level == np.arange(1, 9)).all()
    mixed, _ = jax.tree.map(np.asarray, reset(keys, style, 0.25))
    assert 0.2 < (mixed.time > 0).mean() < 0.3


def test_the_ego_has_no_role_to_be_confined_to(env):
    style = env.style("level_4")
    assert env.confine(style) is style


def test_the_scripted_pair_wins_every_game_of_every_style(env):
    """All starts with the target at every place; the other foods' levels play no part."""
    pairs = list(itertools.permutations(CENTRE, 2))
    shifts = [np.roll(spread.PLACES, shift, axis=0) for shift in range(8)]
    games = [drawn_state(p, ego=e, partner=q) for p in shifts for e, q in pairs]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *games)

    def game(state, style):
        def one(carry, _):
            state, on = carry
            actions = scripted.choose_actions(state, style.target)
            state, timestep = env.step(jax.random.key(0), state, actions, style)
            return (state, on & ~timestep.done), (timestep.reward * on, on)

        _, (rewards, on) = jax.lax.scan(one, (state, True), None, length=env.max_steps)
        return rewards.sum(), on.sum()

    every = jax.jit(jax.vmap(jax.vmap(game, in_axes=(0, None)), in_axes=(None, 0)))
    returns, lengths = every(states, env.styles)
    assert returns.shape == (8, 8 * 72)
    np.testing.assert_array_equal(returns, 1.0)
    assert int(lengths.max()) <= 12


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: envs.make("lbf/gather"), "unknown environment 'lbf/gather'"),
        (lambda: envs.make("lbf/spread", size=9), "unknown option 'size'"),
        (lambda: envs.make("lbf/spread", encoding="pixels"), "encoding is 'pixels'"),
        (lambda: envs.make("lbf/spread", max_steps=9), "max_steps is 9"),
        (lambda: envs.make("lbf/spread", max_steps=20.5), "max_steps is 20.5"),
        (lambda: envs.make("lbf/spread", sight=0), "sight is 0"),
        (lambda: envs.make("lbf/spread", sight="far"), "sight is 'far'"),
        (lambda: envs.make("lbf/spread", partner_sight=-1), "partner_sight is -1"),
        (
            lambda: envs.make("lbf/spread", partner_sight=2, encoding="flat"),
            "partner_sight is 2 with encoding 'flat'",
        ),
        (lambda: envs.make("lbf/spread").style("level_9"), "unknown style 'level_9'"),
    ],
)
def test_wrong_names_and_options_are_refused(make, message):
    with pytest.raises(ValueError, match=f"{message}.*expected"):
        make()


def test_the_registry_knows_spread(env):
    assert env.name == "lbf/spread"
    assert "lbf/spread" in envs.names()
    assert "lbf/spread" in envs.names(styled_only=True)
    assert env.task_language_source == "labels"
