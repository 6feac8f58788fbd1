"""Partners: how seeds are chosen and dealt out, and what each kind of training starts from."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_game import ToyGame, always

from experiments.configs import CompressionConfig
from experiments.stages.model import Visits
from haland_jax import best_responses, mirrors, partners
from haland_jax.partners import PartnersConfig, Player
from haland_jax.ppo import PPOConfig
from haland_jax.seeds import (
    all_pairs,
    meet_next_partners,
    select_from_circles,
    select_seeds,
    take_seeds,
)

TINY = PPOConfig(
    total_steps=80, num_envs=4, rollout_steps=5, num_minibatches=2, epochs=1, confined_until=0.0
)
CONFIG = PartnersConfig(
    train_seeds=2,
    held_out_seeds=2,
    spare_seeds=1,
    joint=TINY,
    refit=dataclasses.replace(TINY, num_envs=6, total_steps=120),
    oracle=TINY,
    oracle_candidates=2,
    evaluation_games=3,
)
# By style and seed; the third seed of the first style and the first of the second are the worst.
RETURNS = np.array([[10.0, 40.0, 5.0, 30.0, 20.0], [1.0, 2.0, 3.0, 4.0, 5.0]])


@pytest.fixture(scope="module")
def game():
    return ToyGame()


@pytest.fixture(scope="module")
def pairs(game):
    return partners.init_pairs(game, CONFIG.joint, CONFIG.num_seeds, jax.random.key(0))


@pytest.fixture(scope="module")
def population(game, pairs):
    # Egos differ after training; here each is marked by its member's number.
    marks = jnp.arange(10, dtype=jnp.float32)
    marked = jax.tree.map(
        lambda leaf: leaf + marks.reshape(-1, *[1] * (leaf.ndim - 1)), pairs.ego.actor
    )
    pairs = pairs.replace(ego=pairs.ego.replace(actor=marked))
    return partners.make_population(game, CONFIG, partners.trained_players(pairs), RETURNS)


def mark(actor) -> np.ndarray:
    """The member's number that the fixture wrote into the last bias."""
    return np.asarray(actor["params"]["dense_2"]["bias"][..., 0]).round().astype(int)


def test_the_best_seeds_are_kept_and_dealt_out_in_turn():
    train, held_out = select_seeds(RETURNS, 2, 2)
    # Ranks: 40 (seed 1), 30 (3), 20 (4), 10 (0); 5, 4, 3, 2.
    np.testing.assert_array_equal(train, [[1, 4], [4, 2]])
    np.testing.assert_array_equal(held_out, [[3, 0], [3, 1]])


@pytest.mark.parametrize("num_train", range(1, 6))
@pytest.mark.parametrize("num_held_out", range(1, 6))
def test_every_kept_seed_is_dealt_once_and_neither_group_is_the_better(num_train, num_held_out):
    kept = num_train + num_held_out
    returns = np.random.default_rng(0).permuted(np.arange(3 * 12.0).reshape(3, 12), axis=1)
    train, held_out = select_seeds(returns, num_train, num_held_out)
    assert train.shape == (3, num_train)
    assert held_out.shape == (3, num_held_out)
    for style in range(3):
        together = [*train[style], *held_out[style]]
        best = np.argsort(-returns[style])[:kept]
        assert sorted(together) == sorted(best)
    if num_train == num_held_out:
        rank = np.argsort(np.argsort(-returns, axis=1), axis=1)
        ranks = [np.take_along_axis(rank, index, 1).mean() for index in (train, held_out)]
        assert abs(ranks[0] - ranks[1]) <= 1


def test_equal_returns_are_taken_in_the_order_of_the_seeds():
    train, held_out = select_seeds(np.zeros((1, 4)), 1, 1)
    assert (train.tolist(), held_out.tolist()) == ([[0]], [[1]])


def test_each_circle_keeps_its_own_best_seeds():
    train, held_out = select_from_circles(RETURNS, 3, 2, 1)
    # Seeds 0 to 2 of the first style: 10, 40, 5; seeds 3 and 4: 30, 20.
    np.testing.assert_array_equal(train, [[1, 0], [2, 1]])
    np.testing.assert_array_equal(held_out, [[3], [4]])


def test_egos_meet_all_partners_of_their_circle_in_turn_and_no_others(game, pairs):
    def met(state):
        return np.asarray(state.ego.actor["params"]["dense_2"]["bias"][:, 0]).astype(int)

    numbers = jnp.arange(10)[:, None] + jnp.zeros_like(pairs.ego.actor["params"]["dense_2"]["bias"])
    layers = {**pairs.ego.actor["params"]}
    layers["dense_2"] = {**layers["dense_2"], "bias": numbers}
    state = pairs.replace(ego=pairs.ego.replace(actor={"params": layers}))
    order = []
    for _ in range(6):
        order.append(met(state))
        moved = meet_next_partners(state, 2, (3, 2))
        jax.tree.map(np.testing.assert_array_equal, moved.partner, state.partner)
        state = moved
    np.testing.assert_array_equal(order[1], [2, 0, 1, 4, 3, 7, 5, 6, 9, 8])
    np.testing.assert_array_equal(met(state), order[0])
    assert [{egos[member] for egos in order} for member in range(10)] == [
        *[{0, 1, 2}] * 3,
        *[{3, 4}] * 2,
        *[{5, 6, 7}] * 3,
        *[{8, 9}] * 2,
    ]


def test_partners_of_two_circles_share_the_spare_seeds(game, pairs):
    config = dataclasses.replace(CONFIG, held_out_seeds=1, spare_seeds=2, updates_together=5)
    assert (config.known_seeds, config.num_seeds) == (3, 5)
    kept = partners.make_population(game, config, partners.trained_players(pairs), RETURNS)
    np.testing.assert_array_equal(kept.train_index, [[1, 0], [2, 1]])
    np.testing.assert_array_equal(kept.held_out_index, [[3], [4]])
    np.testing.assert_array_equal(kept.known_index, [[0, 1, 2], [0, 1, 2]])


@pytest.mark.parametrize("name", ["spare_seeds", "updates_together"])
def test_a_negative_count_is_refused(name):
    with pytest.raises(ValueError, match=rf"{name} is -1; expected 0 or more"):
        dataclasses.replace(CONFIG, **{name: -1})


def test_flatten_and_unflatten_are_inverse_and_take_seeds_picks_by_style():
    tree = {"a": jnp.arange(24).reshape(2, 4, 3), "b": jnp.arange(8).reshape(2, 4)}
    flat = partners.flatten(tree)
    np.testing.assert_array_equal(flat["b"], np.arange(8))
    assert flat["a"].shape == (8, 3)
    back = partners.unflatten(flat, 2)
    jax.tree.map(np.testing.assert_array_equal, back, tree)
    picked = take_seeds(tree, np.array([[3, 0], [1, 1]]))
    np.testing.assert_array_equal(picked["b"], [[3, 0], [5, 5]])
    np.testing.assert_array_equal(picked["a"][0, 0], tree["a"][0, 3])


def test_members_are_ordered_by_style_then_seed(game):
    np.testing.assert_array_equal(partners.repeat_styles(game, 3).length, [3, 3, 3, 5, 5, 5])


def test_all_egos_start_alike_and_all_partners_apart(pairs):
    for leaf in jax.tree.leaves((pairs.ego.actor, pairs.ego.critic)):
        assert leaf.shape[0] == 10
        np.testing.assert_array_equal(leaf, np.broadcast_to(leaf[:1], leaf.shape))
    kernels = np.asarray(pairs.partner.actor["params"]["dense_0"]["kernel"]).reshape(10, -1)
    assert len({kernel.tobytes() for kernel in kernels}) == 10
    keys = np.asarray(jax.random.key_data(pairs.key))
    assert len({key.tobytes() for key in keys}) == 10


def test_the_population_holds_the_chosen_pairs(pairs, population):
    np.testing.assert_array_equal(mark(population.train_egos.actor), [[1, 4], [9, 7]])
    np.testing.assert_array_equal(mark(population.held_out_egos.actor), [[3, 0], [8, 6]])
    np.testing.assert_array_equal(mark(population.best_train_egos.actor), [1, 9])
    for kept, members in (
        (population.train_partners, [[1, 4], [9, 7]]),
        (population.held_out_partners, [[3, 0], [8, 6]]),
        # All but the held-out ones, in the order of the seeds; 2 and 5 are the worst.
        (population.known_partners, [[1, 2, 4], [5, 7, 9]]),
    ):
        jax.tree.map(
            lambda leaf, every, index=members: np.testing.assert_array_equal(
                leaf, np.asarray(every)[np.array(index)]
            ),
            kept,
            pairs.partner.actor,
        )
    np.testing.assert_array_equal(population.joint_returns, RETURNS)
    np.testing.assert_array_equal(population.train_index, [[1, 4], [4, 2]])


def refits(game, population, egos=None, training=CONFIG.refit):
    egos = population.train_egos if egos is None else egos
    everyone = mirrors.teachers(game, CONFIG, population)
    return best_responses.best_response_refits(game, training, jax.random.key(1), egos, everyone)


def test_each_ego_is_refitted_against_all_known_partners_of_its_style(game, population):
    state = refits(game, population)
    np.testing.assert_array_equal(mark(state.ego.actor), [1, 4, 9, 7])
    for frozen, trained in zip(
        jax.tree.leaves(state.partner), jax.tree.leaves(population.known_partners), strict=True
    ):
        # [member, partner, ...]: all partners of the member's style that are not held out.
        np.testing.assert_array_equal(frozen, np.asarray(trained)[[0, 0, 1, 1]])


def test_copies_of_the_universal_ego_are_refitted_with_the_same_partners(game, population):
    told = jax.tree.map(lambda leaf: leaf[:, 0] + 100, population.train_egos)
    copies = partners.copies(told, 3)
    state = refits(game, population, copies, CONFIG.universal_refit)
    np.testing.assert_array_equal(mark(state.ego.actor), [101] * 3 + [109] * 3)
    for frozen, trained in zip(
        jax.tree.leaves(state.partner), jax.tree.leaves(population.known_partners), strict=True
    ):
        np.testing.assert_array_equal(frozen, np.asarray(trained)[[0, 0, 0, 1, 1, 1]])


def test_a_universal_ego_is_refitted_gently_and_that_counts_as_further_updates():
    both = dataclasses.replace(CONFIG, universal_start=True, universal_rate=2e-4)
    assert both.universal_refit == dataclasses.replace(CONFIG.refit, learning_rate=2e-4)
    assert both.refits == (CONFIG.refit, both.universal_refit)
    assert both.refit_updates == 2 * CONFIG.refit.num_updates
    alone = dataclasses.replace(CONFIG, universal_start=False)
    assert alone.refits == (CONFIG.refit,)
    with pytest.raises(ValueError, match="universal_rate is 0; expected > 0"):
        dataclasses.replace(CONFIG, universal_rate=0)


def test_the_universal_ego_that_is_told_the_style_is_refitted_unless_it_earns_clearly_less():
    returns = np.array(
        [
            [100.0, 90.0, 97.5, 96.0],  # as good, so the better one that is told
            [387.0, 300.0, 257.0, 250.0],  # 257 is 66% of 387
            [0.0, 2.0, 1.0, 250.0],
        ]
    )
    places, variants = best_responses.choose_universal(returns, 2)
    np.testing.assert_array_equal(places, [2, 0, 3])
    np.testing.assert_array_equal(variants, [1, 0, 1])


def test_each_style_keeps_one_start_and_what_is_as_good():
    egos = Player({"bias": jnp.arange(16.0).reshape(4, 4)}, {"bias": jnp.zeros((4, 4, 3))})
    returns = np.array(
        [
            [[5.0, 6.0], [9.0, 1.0]],  # the second start's first ego; its second one is worse
            [[300.0, 292.0], [290.0, 0.0]],  # both of the first start: 292 is 97.3% of 300
            [[-50.0, -10.0], [-10.3, -9.9]],  # 3% of 9.9 below -9.9 is -10.197
            [[100.0, 99.0], [95.0, 97.5]],  # as good, so the second start; 95 is 97.4% of 97.5
        ]
    )
    kept, places = best_responses.best_egos(egos, returns)
    np.testing.assert_array_equal(places, [[2, 2], [0, 1], [3, 3], [2, 3]])
    np.testing.assert_array_equal(kept.actor["bias"], [[2, 2], [4, 5], [11, 11], [14, 15]])
    assert kept.critic["bias"].shape == (4, 2, 3)


def test_refits_change_the_egos_and_leave_the_partners_alone(game, population):
    state = refits(game, population)
    before = jax.tree.map(np.array, (state.ego.actor, state.partner))
    train = partners.compile_training(game, CONFIG.refit, 2)
    state, metrics = train(state, partners.repeat_styles(game, CONFIG.train_seeds))
    assert metrics["reward"].shape == (4, 2)
    jax.tree.map(np.testing.assert_array_equal, before[1], state.partner)
    for member in range(4):
        moved = [
            np.abs(np.asarray(now)[member] - old[member]).max()
            for now, old in zip(
                jax.tree.leaves(state.ego.actor), jax.tree.leaves(before[0]), strict=True
            )
        ]
        assert max(moved) > 0, member


def test_the_oracles_candidates_are_the_own_ego_and_archived_ones(game, population):
    archived = Player(
        jax.tree.map(lambda leaf: leaf + 100, population.train_egos.actor),
        population.train_egos.critic,
    )
    state = best_responses.oracle_refits(game, CONFIG, jax.random.key(2), population, archived)
    # [style, held-out partner, candidate]: the own ego, then an archived one, in turn.
    np.testing.assert_array_equal(
        mark(state.ego.actor).reshape(2, 2, 2),
        [[[3, 101], [0, 104]], [[8, 109], [6, 107]]],
    )
    for frozen, held_out in zip(
        jax.tree.leaves(state.partner), jax.tree.leaves(population.held_out_partners), strict=True
    ):
        # [member, 1, ...]: each held-out partner with each of its candidates.
        expected = np.repeat(np.asarray(held_out).reshape(4, 1, *held_out.shape[2:]), 2, axis=0)
        np.testing.assert_array_equal(frozen, expected)


def test_evaluation_plays_every_pair_with_its_style(game):
    egos = [always(action, 3, 3) for action in (0, 1, 2)]
    egos = jax.tree.map(lambda *leaves: jnp.stack(leaves), *egos)
    idle = jax.tree.map(lambda leaf: jnp.stack(3 * [leaf]), always(0, 2, 4))
    styles = jax.tree.map(lambda leaf: leaf[np.array([0, 1, 0])], game.styles)
    keys = jax.random.split(jax.random.key(0), 3)
    played = partners.compile_evaluation(game, 2)(keys, egos, idle, styles)
    np.testing.assert_array_equal(played.returns, [[0, 0], [5, 5], [6, 6]])


def test_few_of_the_policy_vae_s_states_are_drawn_twice(game, population):
    wanted = CompressionConfig(own_states=100, other_states=20, decoded_states=20)
    config = SimpleNamespace(partners=CONFIG, compression=wanted, max_steps=game.max_steps)
    visits = Visits(SimpleNamespace(env=game, config=config), population)
    policies = partners.flatten(population.train_egos.actor)
    states = np.asarray(visits.own_partners(jax.random.key(0), policies, 100))
    assert states.shape == (4, 100, 3)
    # 400 steps of full games: 3 in 5 are played in `short`, so 100 of 240 or more are drawn.
    assert min(len(np.unique(one, axis=0)) for one in states) > 70


@pytest.mark.parametrize("name", ["train_seeds", "held_out_seeds", "oracle_candidates"])
def test_numbers_below_one_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 0; expected at least 1"):
        PartnersConfig(**{name: 0})


def test_refit_games_must_be_shared_by_the_partners():
    odd = dataclasses.replace(CONFIG.refit, num_envs=32, total_steps=160)
    message = r"refit\.num_envs is 32; expected a multiple of 7, .* that egos learn with"
    with pytest.raises(ValueError, match=message):
        PartnersConfig(train_seeds=5, refit=odd)


def test_each_ego_of_a_style_meets_each_of_its_partners():
    # Two styles, three egos and two partners of each.
    egos = jnp.array([[0, 1, 2], [3, 4, 5]])
    frozen = jnp.array([[10, 11], [12, 13]])
    each, beside = all_pairs(egos, frozen)
    assert each.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5]
    assert beside.tolist() == [10, 10, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13]
