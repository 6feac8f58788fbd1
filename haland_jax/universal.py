"""Universal egos: one ego for the partners of all styles, told the style or not.

What an ego that is told nothing reaches says how much knowing the style is worth. One ego
learns by PPO with the frozen partners of all styles together, but those held out; each partner
has an equal share of the games, and the games of each partner have that partner's style.

Egos that are told the style's one-hot and egos that are told nothing learn in one program:
members [variant, seed], in the order of `VARIANTS`. Both have a slot for the label. The same
seed starts both from the same parameters. Early in training both may be drawn to what guides do,
one for the games of each style (`PPOConfig.guidance`).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from envs.labelled import Labelled
from haland_jax import ppo
from haland_jax.learner import StylesByGame, TrainState, init_learner, make_networks
from haland_jax.networks import Policy
from haland_jax.partners import PartnersConfig, Player, flatten
from haland_jax.population import over_population
from haland_jax.ppo import PPOConfig

TOLD_NOTHING, TOLD_THE_STYLE = "told nothing", "told the style"
VARIANTS = (TOLD_NOTHING, TOLD_THE_STYLE)


def universal_config(total_steps: int, num_envs: int = 192, num_minibatches: int = 8) -> PPOConfig:
    """Returns settings for an ego that learns from scratch with frozen partners.

    The ego is never held to a role: one that is told nothing could not know which.

    Args:
        total_steps: environment steps of one ego, with all partners together.
        num_envs: games in parallel; a multiple of the partners that share them.
        num_minibatches: minibatches a pass; each has games of all styles.
    """
    return PPOConfig(
        total_steps=total_steps,
        num_envs=num_envs,
        num_minibatches=num_minibatches,
        confined_until=0.0,
        partner_noise=0.1,
    )


@dataclasses.dataclass(frozen=True)
class UniversalConfig:
    """How many universal egos of each variant, and how they train.

    Attributes:
        seeds: egos of each variant.
        training: training of one ego with all partners.
    """

    seeds: int = 1
    training: PPOConfig = dataclasses.field(default_factory=lambda: universal_config(10_000_000))

    def __post_init__(self):
        if self.seeds < 1:
            raise ValueError(f"seeds is {self.seeds}; expected at least 1")


def start_variants(config: PartnersConfig) -> tuple[str, ...]:
    """Returns the variants that best responses may start from; empty where from none."""
    if not config.universal_start:
        return ()
    return (TOLD_THE_STYLE,) if config.told_start else VARIANTS


def member_styles(env: Labelled, seeds: int) -> StylesByGame:
    """Returns the styles of every member with the labels it sees, [variant * seed, style]."""
    variants = (env.hidden_styles, env.styles)
    return StylesByGame(
        jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), seeds, axis=0), *variants)
    )


def init_universal(
    env: Labelled,
    config: UniversalConfig,
    key: jax.Array,
    partners: Policy,
    guides: Policy | None = None,
) -> TrainState:
    """Starts the egos of both variants.

    Args:
        env: the environment, with labels.
        config: how many egos.
        key: consumed.
        partners: frozen partners, leading axes [style, seed].
        guides: an actor for each style that reads the plain observation, leading axis [style];
            given where `PPOConfig.guidance` says so, and only there.

    Returns:
        Training states with leading axis [variant * seed].

    Raises:
        ValueError: the partners cannot share the games in equal parts; guides are given that
            nobody follows, or lack.
    """
    if (guides is not None) != (config.training.guidance > 0):
        raise ValueError(
            f"universal.training.guidance is {config.training.guidance}, but guides are "
            f"{'not ' if guides is None else ''}given; expected both or neither"
        )
    actors, critic = make_networks(env)
    everyone = flatten(partners)
    training = config.training
    count = jax.tree.leaves(everyone)[0].shape[0]
    ppo.expect_equal_shares("universal.training", training, count, "partners of all styles")

    labelled = None if guides is None else _with_labels(env, guides)

    def init_ego(everyone: Policy, key: jax.Array, styles: StylesByGame) -> TrainState:
        learner_key, train_key = jax.random.split(key)
        size = env.observation_sizes.ego
        ego = init_learner(learner_key, actors.ego, critic, size, training)
        return ppo.init_train_state(env, training, train_key, ego, everyone, styles, labelled)

    keys = jnp.tile(jax.random.split(key, config.seeds), len(VARIANTS))
    start = over_population(init_ego, shared=1, compiler_options=env.compiler_options)
    return start(everyone, keys, member_styles(env, config.seeds))


def _with_labels(env: Labelled, policies: Policy) -> Policy:
    """Policies [style] of the plain observation that read one with a label and ignore that."""
    labels = len(env.style_names)
    first = policies["params"]["dense_0"]
    kernel = jnp.pad(first["kernel"], ((0, 0), (0, labels), (0, 0)))
    return {**policies, "params": {**policies["params"], "dense_0": {**first, "kernel": kernel}}}


def fold_label(params: Any, label: jax.Array) -> Any:
    """The network of the plain observation that says what `params` says with a label.

    The first layer takes the label up, so that an ego that was told the style is a policy
    like any other.

    Args:
        params: an actor or critic of a `Labelled` environment, without leading axes.
        label: what it is told, float32 [style].
    """
    first = params["params"]["dense_0"]
    rest = first["kernel"].shape[0] - label.shape[0]
    kernel, told = first["kernel"][:rest], first["kernel"][rest:]
    folded = {**first, "kernel": kernel, "bias": first["bias"] + label @ told}
    return {**params, "params": {**params["params"], "dense_0": folded}}


def players_by_style(env: Labelled, egos: Player) -> dict[str, Player]:
    """The players that each variant is with partners of each style.

    Args:
        env: the environment, with labels.
        egos: trained egos, leading axis [variant * seed].

    Returns:
        By variant, players with the plain observation, leading axes [style, seed].
    """
    labels = (env.hidden_styles.label, env.styles.label)
    by_variant: Any = jax.tree.map(
        lambda leaf: leaf.reshape(len(VARIANTS), -1, *leaf.shape[1:]), egos
    )

    def fold(ego: Player, label: jax.Array) -> Player:
        normaliser = ego.normaliser
        if normaliser is not None:
            rest = normaliser.mean.shape[0] - label.shape[0]
            normaliser = normaliser.replace(
                mean=normaliser.mean[:rest], variance=normaliser.variance[:rest]
            )
        return Player(fold_label(ego.actor, label), fold_label(ego.critic, label), normaliser)

    over_seeds = jax.vmap(fold, in_axes=(0, None))
    over_styles = jax.vmap(over_seeds, in_axes=(None, 0))
    return {
        name: over_styles(jax.tree.map(lambda leaf, i=index: leaf[i], by_variant), labels[index])
        for index, name in enumerate(VARIANTS)
    }
