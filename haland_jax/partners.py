"""Styled partners, and the egos that learn beside them.

Partner and ego learn together, many seeds of every style in one program (`init_pairs`). The best
seeds of each style are kept, by one rule for training and held-out seeds alike
(`haland_jax.seeds`): partners that never learnt their style are no partners.

Everything is flattened to members [style * seed] for `over_population`.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.base import Environment, Pair
from haland_jax import normalisation, ppo, rollout
from haland_jax.learner import Learner, TrainState, init_learner, learner_from, make_networks
from haland_jax.networks import Policy
from haland_jax.normalisation import Normaliser
from haland_jax.population import over_population
from haland_jax.ppo import PPOConfig
from haland_jax.seeds import meet_next_partners, select_from_circles, select_seeds, take_seeds


def best_response_config(total_steps: int, num_envs: int = 32) -> PPOConfig:
    """Returns settings for an ego that has learnt already and meets further partners: no shaping.

    Most games start at random moments: so the ego meets more than the conventions that the
    partners it trains with have in common.

    Args:
        total_steps: environment steps of one ego.
        num_envs: games in parallel; a multiple of the partners that share them.
    """
    return PPOConfig(
        total_steps=total_steps,
        num_envs=num_envs,
        entropy=0.01,
        shaping=0.0,
        confined_until=0.0,
        final_random_start=0.6,
    )


def oracle_config(total_steps: int) -> PPOConfig:
    """Returns settings for an ego that is fitted to one partner: gentle, mostly from the start.

    Args:
        total_steps: environment steps of one ego.
    """
    return PPOConfig(
        total_steps=total_steps,
        learning_rate=3e-4,
        entropy=0.01,
        shaping=0.0,
        confined_until=0.0,
        random_start=0.3,
        final_random_start=0.3,
    )


@dataclasses.dataclass(frozen=True)
class PartnersConfig:
    """How many partners, and how each stage trains.

    Attributes:
        train_seeds: partners of each style that the method learns from.
        held_out_seeds: partners of each style that it is judged with.
        spare_seeds: further seeds of each style, so that the worst pairs can be rejected; best
            responses learn with their partners too.
        updates_together: updates after which every ego moves on to the next partner of its circle,
            so that partners learn to do with more than one ego; 0: pairs stay together. A style
            has two circles, which never meet: one of those that may become training partners, one
            of those that may be held out. They share the spare seeds; an odd one is the former's.
        joint: training of partner and ego together.
        refit: training of an ego against all frozen partners of its style that are not held
            out.
        universal_rate: learning rate at the start of a universal ego's refit. A higher one costs
            it what it has learnt with partners of other styles.
        oracle: training of an ego against one frozen held-out partner.
        oracle_candidates: egos that are refitted for each held-out partner.
        mirror: also learn with the partners of other styles as they look in the environment's
            mirrors, where it has any, and take other styles' egos that are clearly better there.
        universal_start: also refit a universal ego for each style (`choose_universal`), and keep
            that start, unless the style's own is clearly better.
        told_start: it is always the one that is told the style, and only its steps are counted.
        evaluation_games: games of each pair in an evaluation.
    """

    train_seeds: int = 5
    held_out_seeds: int = 5
    spare_seeds: int = 2
    updates_together: int = 0
    joint: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    refit: PPOConfig = dataclasses.field(
        default_factory=lambda: best_response_config(2_000_000, num_envs=84)
    )
    universal_rate: float = 3e-4
    oracle: PPOConfig = dataclasses.field(default_factory=lambda: oracle_config(300_000))
    oracle_candidates: int = 3
    mirror: bool = True
    universal_start: bool = True
    told_start: bool = False
    evaluation_games: int = 32

    def __post_init__(self):
        for name in ("train_seeds", "held_out_seeds", "oracle_candidates", "evaluation_games"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 1")
        for name in ("spare_seeds", "updates_together"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected 0 or more")
        if self.universal_rate <= 0:
            raise ValueError(f"universal_rate is {self.universal_rate}; expected > 0")
        ppo.expect_equal_shares(
            "refit", self.refit, self.known_seeds, "partners that egos learn with"
        )

    @property
    def universal_refit(self) -> PPOConfig:
        """Training of a universal ego against the partners that `refit` has."""
        return dataclasses.replace(self.refit, learning_rate=self.universal_rate)

    @property
    def refits(self) -> tuple[PPOConfig, ...]:
        """One for each start: the partners' own egos, and the universal ego where it is one."""
        return (self.refit, self.universal_refit) if self.universal_start else (self.refit,)

    @property
    def refit_updates(self) -> int:
        """Updates of all refits, one start after the other."""
        return sum(training.num_updates for training in self.refits)

    @property
    def num_seeds(self) -> int:
        """Seeds of each style that are trained."""
        return self.train_seeds + self.held_out_seeds + self.spare_seeds

    @property
    def known_seeds(self) -> int:
        """Seeds of each style that the method may learn with.

        All that are not held out, or, with `updates_together`, those of the training circle.
        """
        spare = (self.spare_seeds + 1) // 2 if self.updates_together else self.spare_seeds
        return self.train_seeds + spare


class Player(PyTreeNode):
    """What is kept of a learner; both networks read raw observations.

    Attributes:
        actor: the policy.
        critic: for later refits.
        normaliser: with which it learnt, for later refits; None if it read raw observations.
    """

    actor: Policy
    critic: Any
    normaliser: Normaliser | None = None

    @classmethod
    def of(cls, learners: Learner) -> "Player":
        """What is kept of learners with leading axis [member]."""

        def keep(learner: Learner) -> Player:
            actor, critic = (
                normalisation.fold(learner.normaliser, network)
                for network in (learner.actor, learner.critic)
            )
            return cls(actor, critic, learner.normaliser)

        return jax.vmap(keep)(learners)

    def learner(self, config: PPOConfig) -> Learner:
        """A learner that goes on from one player."""
        return learner_from(self.actor, self.critic, config, self.normaliser)


def trained_players(state: TrainState) -> Pair:
    """What is kept of trained pairs, leading axis [member]: a `Player` each, None if frozen.

    A learner's own networks read normalised observations; nobody should play with those.
    """
    return Pair(
        *(
            Player.of(learner) if isinstance(learner, Learner) else None
            for learner in (state.ego, state.partner)
        )
    )


class Population(PyTreeNode):
    """The partners and egos of an environment; leading axes [style, seed].

    Attributes:
        partners: actors of all partners that were trained.
        egos: the egos that learnt beside them.
        joint_returns: mean return of each pair, float32 [style, num_seeds].
        train_index: which seeds became training partners, the best of a style first, int32
            [style, train_seeds].
        held_out_index: which became held-out partners, int32 [style, held_out_seeds].
        known_index: which the method may learn with, int32 [style, known_seeds].
    """

    partners: Policy
    egos: Player
    joint_returns: jax.Array
    train_index: jax.Array
    held_out_index: jax.Array
    known_index: jax.Array

    @property
    def train_partners(self) -> Policy:
        """Actors of the training partners, [style, train_seeds]."""
        return take_seeds(self.partners, self.train_index)

    @property
    def held_out_partners(self) -> Policy:
        """Actors of the held-out partners, [style, held_out_seeds]."""
        return take_seeds(self.partners, self.held_out_index)

    @property
    def known_partners(self) -> Policy:
        """Actors of all that the method may learn with, [style, known_seeds].

        The rejected ones are among them: the more ways of sharing the work an ego has met, the
        better it serves those it has not.
        """
        return take_seeds(self.partners, self.known_index)

    @property
    def train_egos(self) -> Player:
        """The egos that learnt beside the training partners, [style, train_seeds]."""
        return take_seeds(self.egos, self.train_index)

    @property
    def best_train_egos(self) -> Player:
        """The ego of each style's best training pair, [style]."""
        return jax.tree.map(lambda leaf: leaf[:, 0], self.train_egos)

    @property
    def held_out_egos(self) -> Player:
        """The egos that learnt beside the held-out partners, [style, held_out_seeds]."""
        return take_seeds(self.egos, self.held_out_index)


@jax.jit
def flatten(tree: Any) -> Any:
    """Merges the leading axes [style, seed] into [member]."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


@partial(jax.jit, static_argnums=1)
def unflatten(tree: Any, num_styles: int) -> Any:
    """Splits the leading axis [member] into [style, seed]."""
    return jax.tree.map(lambda leaf: leaf.reshape(num_styles, -1, *leaf.shape[1:]), tree)


def copies(by_style: Any, times: int) -> Any:
    """Repeats what each style has: leading axis [style] -> [style, times]."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], times, axis=1), by_style)


def repeat_styles(env: Environment, times: int) -> Any:
    """Returns the style of each member, leading axis [style * times]."""
    return _repeat(env.styles, times)


@partial(jax.jit, static_argnums=1)
def _repeat(tree: Any, times: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, times, axis=0), tree)


def init_pairs(env: Environment, config: PPOConfig, num_seeds: int, key: jax.Array) -> TrainState:
    """Starts partner and ego of every style and seed.

    All egos start from the same parameters: policies that share their initialisation are
    near each other up to what they learnt, which the policy VAE needs.

    Args:
        env: the environment.
        config: settings of their training.
        num_seeds: pairs of each style.
        key: consumed.

    Returns:
        Training states with leading axis [style * num_seeds].
    """
    ego_key, pair_key = jax.random.split(key)
    actors, critic = make_networks(env)
    sizes = env.observation_sizes
    styles = repeat_styles(env, num_seeds)

    def init_pair(ego_key, pair_key, style):
        partner_key, train_key = jax.random.split(pair_key)
        ego = init_learner(ego_key, actors.ego, critic, sizes.ego, config)
        partner = init_learner(partner_key, actors.partner, critic, sizes.partner, config)
        return ppo.init_train_state(env, config, train_key, ego, partner, style)

    keys = jax.random.split(pair_key, len(env.style_names) * num_seeds)
    start = over_population(init_pair, shared=1, compiler_options=env.compiler_options)
    return start(ego_key, keys, styles)


def compile_training(
    env: Environment, config: PPOConfig, num_updates: int
) -> Callable[[TrainState, Any], tuple[TrainState, dict[str, jax.Array]]]:
    """Compiles `ppo.train_chunk` for a population; the given state is consumed."""
    chunk = partial(ppo.train_chunk, env, config, num_updates)
    return over_population(chunk, donate=(0,), compiler_options=env.compiler_options)


def compile_moving_on(
    env: Environment, config: PartnersConfig
) -> Callable[[TrainState], TrainState]:
    """Compiles `seeds.meet_next_partners` for `config`'s circles; the given state is consumed."""
    circles = config.known_seeds, config.num_seeds - config.known_seeds
    return jax.jit(
        lambda pairs: meet_next_partners(pairs, len(env.style_names), circles), donate_argnums=0
    )


def compile_evaluation(
    env: Environment, num_games: int
) -> Callable[[jax.Array, Policy, Policy, Any], rollout.Games]:
    """Compiles the evaluation of pairs: keys, egos, partners, styles [member] -> `Games`."""
    play = partial(rollout.play, env, num_games=num_games)
    return over_population(play, compiler_options=env.compiler_options)


def make_population(
    env: Environment, config: PartnersConfig, players: Pair, returns: np.ndarray
) -> Population:
    """Says which pairs train and which are held out, by the rules of `haland_jax.seeds`.

    Args:
        env: the environment.
        config: how many.
        players: the trained pairs, leading axis [style * num_seeds].
        returns: mean return of each pair, [style, num_seeds].
    """
    num_styles = len(env.style_names)
    counts = config.train_seeds, config.held_out_seeds
    if config.updates_together:
        train, held_out = select_from_circles(returns, config.known_seeds, *counts)
        known = np.tile(np.arange(config.known_seeds), (num_styles, 1))
    else:
        train, held_out = select_seeds(returns, *counts)
        known = np.stack([np.setdiff1d(np.arange(config.num_seeds), one) for one in held_out])
    return Population(
        partners=unflatten(players.partner.actor, num_styles),
        egos=unflatten(players.ego, num_styles),
        joint_returns=jnp.asarray(returns),
        train_index=jnp.asarray(train),
        held_out_index=jnp.asarray(held_out),
        known_index=jnp.asarray(known, jnp.int32),
    )
