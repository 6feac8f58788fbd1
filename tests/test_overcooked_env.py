"""The environment's protocol: reset and step under jit, vmap and scan, and how games end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.overcooked import layouts
from envs.overcooked.moments import POOL_SIZE

MAX_STEPS = 60


@pytest.fixture(scope="module")
def orders():
    env = envs.make("overcooked/diverse_orders", max_steps=MAX_STEPS)
    assert env.styles.cells.shape[0] == 8
    return env


@pytest.fixture(scope="module")
def random_games(orders):
    """One game of random actions in every style: TimeSteps [style, T, ...], and the first."""

    def game(key, style):
        state, first = orders.reset(key, style)

        def one_step(state, key):
            action = jax.random.randint(key, (2,), 0, 6)
            state, timestep = orders.step(key, state, envs.Pair(action[0], action[1]), style)
            return state, timestep

        return first, jax.lax.scan(one_step, state, jax.random.split(key, MAX_STEPS))[1]

    keys = jnp.repeat(jax.random.key(0)[None], 8)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(game))(keys, orders.styles))


def test_shapes_are_those_that_the_environment_announces(orders, random_games):
    first, steps = random_games
    sizes = orders.observation_sizes
    assert steps.observation.ego.shape == (8, MAX_STEPS, sizes.ego)
    assert steps.observation.partner.shape == (8, MAX_STEPS, sizes.partner)
    assert steps.events.shape == (8, MAX_STEPS, 2, len(orders.event_names))
    assert steps.shaped_reward.shape == (8, MAX_STEPS, 2)
    for one, many in zip(jax.tree.leaves(first), jax.tree.leaves(steps), strict=True):
        assert one.dtype == many.dtype
    assert first.observation.ego.shape == (8, sizes.ego)
    assert orders.num_actions == envs.Pair(6, 6)


def test_a_game_is_truncated_at_its_last_step_and_never_terminated(random_games):
    first, steps = random_games
    assert not steps.terminated.any()
    assert not steps.truncated[:, :-1].any()
    assert steps.truncated[:, -1].all()
    assert not first.truncated.any()
    assert not first.terminated.any()


def test_the_egos_observation_does_not_hold_the_order_and_the_partners_does(orders, random_games):
    # The same actions in all styles: only deliveries differ, and these do not show.
    first, steps = random_games
    ego, partner = steps.observation
    assert (ego == ego[:1]).all()
    assert (first.observation.ego == first.observation.ego[:1]).all()
    tasks = np.asarray(orders.styles.task)
    size = ego.shape[-1]
    assert (partner[..., :size] == partner[:1, :, :size]).all()
    np.testing.assert_array_equal(
        partner[..., size:], np.broadcast_to(tasks[:, None], (8, MAX_STEPS, tasks.shape[1]))
    )


def test_a_first_timestep_holds_nothing_earned(random_games):
    first, _ = random_games
    assert not first.reward.any()
    assert not first.shaped_reward.any()
    assert not first.events.any()


def test_a_delivery_pays_the_team_once(orders):
    style = orders.style("tomato_1")
    state, _ = orders.reset(jax.random.key(0), style)
    state = state.replace(
        cell=jnp.array([orders.layout.floor_index(1, 1), state.cell[1]]), held=jnp.array([7, 0])
    )
    interact = envs.Pair(jnp.int32(5), jnp.int32(4))
    state, timestep = orders.step(jax.random.key(0), state, interact, style)
    assert float(timestep.reward) == 20
    assert float(timestep.events[0, orders.event_names.index("deliver_tomato_soup@1")]) == 1
    _, timestep = orders.step(jax.random.key(0), state, interact, style)
    assert float(timestep.reward) == 0


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_training_starts_at_a_random_moment_with_the_given_chance(orders, share):
    style = orders.style("onion_1")
    keys = jax.random.split(jax.random.key(1), 2000)
    reset = jax.jit(jax.vmap(orders.training_reset, in_axes=(0, None, None)))
    states, timesteps = jax.tree.map(np.asarray, reset(keys, style, share))
    usual, _ = orders.reset(jax.random.key(0), style)
    same = [
        (getattr(states, name) == np.asarray(getattr(usual, name))).reshape(2000, -1).all(axis=1)
        for name in ("cell", "orientation", "held", "counters", "pot_content", "time")
    ]
    is_usual = np.all(same, axis=0)
    assert abs((1 - is_usual.mean()) - share) < 0.04
    if share:
        moments = {state.tobytes() for state in states.counters[~is_usual]}
        assert len(moments) > 100, "one moment is drawn again and again"
        assert not timesteps.reward.any()
        assert states.time.max() <= MAX_STEPS - 40, "some of the game is left"


def test_random_moments_obey_the_style(orders):
    for env, name in (
        (orders, "onion_1"),
        (envs.make("overcooked/center_pots"), "upper_left"),
    ):
        style = jax.tree.map(np.asarray, env.style(name))
        pool = style.pool
        assert pool.cell.shape == (POOL_SIZE, 2)
        assert style.cells[1][pool.cell[:, 1]].all()
        assert style.role_cells[pool.cell[:, 0]].all()
        assert (pool.cell[:, 0] != pool.cell[:, 1]).all()
        assert pool.held.max() > 3, "some hold a soup"


def test_old_dynamics_and_grid_encoding_are_options():
    new, old = (
        envs.make("overcooked/cramped_room", dynamics=which, encoding="grid")
        for which in ("new", "old")
    )
    style = new.style("free")
    state, first = new.reset(jax.random.key(0), style)
    assert first.observation.ego.shape == (5, 4, 26)
    full = state.replace(pot_content=jnp.array([12]))
    stay = envs.Pair(jnp.int32(4), jnp.int32(4))
    for env, timer in ((new, -1), (old, 1)):
        after, _ = env.step(jax.random.key(0), full, stay, style)
        assert int(after.pot_timer[0]) == timer


def test_styles_first_used_inside_a_compiled_function_stay_usable():
    env = envs.make("overcooked/cramped_room")
    jax.jit(lambda key: env.reset(key, env.style("free"))[1].reward)(jax.random.key(0))
    assert np.asarray(env.styles.cells).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: envs.make("overcooked/canteen"), "unknown environment 'overcooked/canteen'"),
        (lambda: envs.make("crossway"), "unknown environment 'crossway'"),
        (lambda: envs.make("overcooked/crossway", dynamics="newer"), "dynamics is 'newer'"),
        (lambda: envs.make("overcooked/crossway", encoding="pixels"), "encoding is 'pixels'"),
        (lambda: envs.make("overcooked/crossway", shaping="none"), "shaping is 'none'"),
        (lambda: envs.make("overcooked/crossway", max_steps=50), "max_steps is 50"),
        (lambda: envs.make("overcooked/crossway").style("middle"), "unknown style 'middle'"),
    ],
)
def test_wrong_names_and_options_are_refused(make, message):
    with pytest.raises(ValueError, match=f"{message}.*expected"):
        make()


def test_the_registry_lists_all_kitchens():
    kitchens = tuple(f"overcooked/{name}" for name in layouts.STYLED + layouts.CLASSIC)
    styled = tuple(f"overcooked/{name}" for name in layouts.STYLED)
    assert tuple(name for name in envs.names() if name.startswith("overcooked/")) == kitchens
    found = envs.names(styled_only=True)
    assert tuple(name for name in found if name.startswith("overcooked/")) == styled
    for name in envs.names():
        assert envs.make(name).name == name
