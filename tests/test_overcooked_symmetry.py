"""Mirrors of the kitchens: a mirrored game is the same game, and a mirrored partner plays it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Pair
from envs.overcooked import dynamics
from envs.overcooked.layouts import CLASSIC, STYLED
from haland_jax import mirrors, networks, partners
from haland_jax.normalisation import Normaliser

# By kitchen: the mirror of a place, and whether onions are tomatoes in it. Worked out by hand.
MIRRORS = {
    "center_pots": (lambda x, y: (6 - x, y), False),
    "crossway": (lambda x, y: (6 - x, 6 - y), False),
    "diverse_coordination": (lambda x, y: (8 - x, y), False),
    "diverse_orders": (lambda x, y: (8 - x, y), True),
}
STEPS = 60


def mirrored_item(code: int, swap: bool) -> int:
    """Onions for tomatoes, in soups too."""
    if not swap or code == dynamics.DISH:
        return code
    if code in (dynamics.ONION, dynamics.TOMATO):
        return dynamics.ONION + dynamics.TOMATO - code
    content = code - dynamics.SOUP
    return dynamics.SOUP + mirrored_content(content, swap) if content >= 0 else code


def mirrored_content(content: int, swap: bool) -> int:
    """4 * onions + tomatoes, exchanged."""
    return 4 * (content & 3) + (content >> 2) if swap else content


def mirrored_state(env, kitchen: str, state: dynamics.State) -> dynamics.State:
    """The state as it looks in the mirror, place by place."""
    image, swap = MIRRORS[kitchen]
    layout = env.layout
    stations = [tuple(place) for place in layout.stations.tolist()]
    to = [stations.index(image(*place)) for place in stations]
    cells = [layout.floor_index(*image(*place)) for place in layout.floor.tolist()]
    turned = {0: 0, 1: 1, 2: 3, 3: 2} if kitchen != "crossway" else {0: 1, 1: 0, 2: 3, 3: 2}
    counters = np.zeros_like(state.counters)
    content, timer = np.zeros_like(state.pot_content), np.zeros_like(state.pot_timer)
    for here in range(layout.num_counters):
        counters[to[here]] = mirrored_item(int(state.counters[here]), swap)
    for pot in range(layout.num_pots):
        there = to[layout.num_counters + pot] - layout.num_counters
        content[there] = mirrored_content(int(state.pot_content[pot]), swap)
        timer[there] = state.pot_timer[pot]
    return state.replace(
        cell=jnp.array([cells[int(cell)] for cell in state.cell]),
        orientation=jnp.array([turned[int(way)] for way in state.orientation]),
        held=jnp.array([mirrored_item(int(item), swap) for item in state.held]),
        counters=jnp.asarray(counters),
        pot_content=jnp.asarray(content),
        pot_timer=jnp.asarray(timer),
    )


def one_policy(policies, style: int, seed: int):
    """One of policies with the leading axes [style, seed]."""
    return jax.tree.map(lambda leaf: leaf[style, seed], policies)


@pytest.mark.parametrize("kitchen", STYLED)
def test_each_styled_kitchen_has_its_mirror(kitchen):
    env = envs.make(f"overcooked/{kitchen}")
    (mirror,) = env.symmetries
    assert sorted(mirror.observation) == list(range(env.observation_sizes.partner))
    np.testing.assert_array_equal(mirror.styles[mirror.styles], np.arange(8))  # twice is nothing


def test_styles_appear_as_their_mirror_images():
    def images(kitchen):
        env = envs.make(f"overcooked/{kitchen}")
        return {
            name: env.style_names[image]
            for name, image in zip(env.style_names, env.symmetries[0].styles, strict=True)
        }

    assert images("crossway")["upper_no_dish"] == "lower_no_dish"
    assert images("crossway")["upper_left"] == "lower_right"
    assert images("center_pots")["upper"] == "upper"
    assert images("center_pots")["lower_left"] == "lower_right"
    assert images("diverse_orders")["onion_1"] == "tomato_4"


@pytest.mark.parametrize("kitchen", STYLED)
def test_a_mirrored_game_is_the_same_game(kitchen):
    env = envs.make(f"overcooked/{kitchen}")
    (mirror,) = env.symmetries
    rng = np.random.default_rng(0)
    step, reset = jax.jit(env.step), jax.jit(env.training_reset)
    paid = 0.0
    for number in range(0, len(env.style_names), 3):
        style, image = (
            jax.tree.map(lambda leaf, i=i: leaf[i], env.styles)
            for i in (number, mirror.styles[number])
        )
        for start in range(6):
            key = jax.random.key(10 * number + start)
            state, timestep = reset(key, style, 1.0)
            other = mirrored_state(env, kitchen, jax.tree.map(np.asarray, state))
            for _ in range(STEPS):
                # Interactions more often than the six actions' share, so that much happens.
                actions = rng.choice(6, size=2, p=[0.15, 0.15, 0.15, 0.15, 0.05, 0.35])
                state, timestep = step(key, state, Pair(*actions), style)
                other, seen = step(key, other, Pair(*mirror.actions[actions]), image)
                assert float(seen.reward) == float(timestep.reward)
                np.testing.assert_array_equal(
                    np.asarray(seen.observation.partner)[mirror.observation],
                    np.asarray(timestep.observation.partner),
                )
                paid += float(timestep.reward)
    assert paid > 0  # soups were delivered, or the rewards said little


@pytest.mark.parametrize("kitchen", CLASSIC)
def test_kitchens_of_one_style_may_have_mirrors_too(kitchen):
    for mirror in envs.make(f"overcooked/{kitchen}").symmetries:
        np.testing.assert_array_equal(mirror.styles, [0])


def test_the_grid_has_no_mirrors():
    assert envs.make("overcooked/center_pots", encoding="grid").symmetries == ()


def test_a_mirrored_partner_does_in_the_mirror_what_the_partner_does():
    env = envs.make("overcooked/diverse_orders")
    (mirror,) = env.symmetries
    actor = networks.MLPActor(env.num_actions.partner)
    observations = jax.random.uniform(jax.random.key(0), (5, env.observation_sizes.partner))
    policies = jax.vmap(jax.vmap(lambda key: actor.init(key, observations[0])))(
        jax.random.split(jax.random.key(1), (8, 2))
    )
    both = mirrors.with_mirror_images(env, policies)
    assert jax.tree.leaves(both)[0].shape[:2] == (8, 4)
    seen = jnp.zeros_like(observations).at[:, mirror.observation].set(observations)
    for style, image in enumerate(mirror.styles):
        for seed in range(2):
            own = one_policy(policies, style, seed)
            kept = one_policy(both, style, seed)
            mirrored = one_policy(both, image, 2 + seed)
            np.testing.assert_array_equal(
                actor.apply(kept, observations), actor.apply(own, observations)
            )
            np.testing.assert_allclose(
                np.asarray(actor.apply(mirrored, seen))[:, mirror.actions],
                actor.apply(own, observations),
                atol=1e-6,
            )


def test_a_mirrored_ego_does_and_expects_in_the_mirror_what_the_ego_does():
    env = envs.make("overcooked/diverse_orders")
    (mirror,) = env.symmetries
    actor, critic = networks.MLPActor(env.num_actions.ego), networks.MLPCritic()
    # The ego does not see the partner's task, with which the partner's observation ends.
    size = env.observation_sizes.ego
    assert size < env.observation_sizes.partner
    observations = jax.random.normal(jax.random.key(0), (5, size))
    seen = jnp.zeros_like(observations).at[:, mirror.observation[:size]].set(observations)
    keys = jax.random.split(jax.random.key(1), (8, 2))
    egos = partners.Player(
        *(
            jax.vmap(jax.vmap(lambda key, network=network: network.init(key, observations[0])))(
                keys
            )
            for network in (actor, critic)
        ),
        Normaliser(
            mean=jax.random.normal(jax.random.key(2), (8, 2, size)),
            variance=jnp.ones((8, 2, size)),
            count=jnp.ones((8, 2)),
        ),
    )
    images = mirrors.egos_seen_in(mirror, egos)
    for style, image in enumerate(mirror.styles):
        for seed in range(2):
            own, mirrored = (
                jax.tree.map(lambda leaf, at=(number, seed): leaf[at], players)
                for players, number in ((egos, style), (images, image))
            )
            np.testing.assert_allclose(
                np.asarray(actor.apply(mirrored.actor, seen))[:, mirror.actions],
                actor.apply(own.actor, observations),
                atol=1e-6,
            )
            np.testing.assert_allclose(
                critic.apply(mirrored.critic, seen),
                critic.apply(own.critic, observations),
                atol=1e-6,
            )
            np.testing.assert_array_equal(
                seen - mirrored.normaliser.mean,
                jnp.zeros_like(seen)
                .at[:, mirror.observation[:size]]
                .set(observations - own.normaliser.mean),
            )
