"""Universal egos with a memory, by PPO (App. C.3): General, Instructed and Adaptive Ego.

One ego learns with the frozen partners of all styles together. The General Ego only sees the
game; the Instructed Ego is told the partner's style, the Adaptive Ego what the partner did last.
All three learn in one program, members [variant, seed]: what an ego is not told is zero. They
learn from pieces of `SEQUENCE` steps, each of which starts from the memory that the ego had there
(as the data chunks of Yu et al., 2022: MAPPO); a minibatch is a share of the games.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment, Pair
from haland_jax import networks, normalisation, ppo, recurrent
from haland_jax.learner import StylesByGame, make_networks, make_optimizer
from haland_jax.networks import Policy
from haland_jax.normalisation import Normaliser
from haland_jax.partners import flatten
from haland_jax.population import over_population
from haland_jax.ppo_loss import Batch, PPOConfig, clipped_loss, generalised_advantages
from haland_jax.recurrent import Memory
from haland_jax.recurrent_egos import (
    VARIANTS,
    Tells,
    UniversalEgo,
    networks_of,
    raw_actor,
    tells_of,
)
from haland_jax.rollout import shown_action

SEQUENCE = 10
"""Steps through which gradients flow; a rollout of fewer is one piece."""


class RecurrentLearner(PyTreeNode):
    """A universal ego that learns; as `learner.Learner`, with networks that remember."""

    actor: Any
    critic: Any
    optimizer_state: Any
    normaliser: Normaliser | None


class RecurrentState(PyTreeNode):
    """Everything that the training of one universal ego needs to go on.

    Attributes:
        update: updates done, int32 [].
        key: never consumed; folded with `update`.
        tells: what the ego is told.
        ego: the ego.
        partners: frozen actors, leading axis [partner].
        env_states: states of the games, leading axis [env].
        observations: `Pair` of [env, O].
        began: whether the games begin with these observations, bool [env].
        partner_action: what the partner did last, zeros where a game begins, [env, A].
        memories: the actor's and the critic's, [env, H].
    """

    update: jax.Array
    key: jax.Array
    tells: Tells
    ego: RecurrentLearner
    partners: Policy
    env_states: Any
    observations: Pair
    began: jax.Array
    partner_action: jax.Array
    memories: tuple[Memory, Memory]


def init_recurrent(
    env: Environment, config: PPOConfig, key: jax.Array, partners: Policy, seeds: int
) -> RecurrentState:
    """Starts the egos of all variants; the same seed starts them from the same parameters.

    Args:
        env: the environment.
        config: settings.
        key: consumed.
        partners: frozen partners, leading axes [style, seed].
        seeds: egos of each variant.

    Returns:
        Training states with leading axis [variant * seed].

    Raises:
        ValueError: the partners cannot share the games in equal parts, a rollout is no number of
            whole sequences, or the ego would be held to a role.
    """
    if config.rollout_steps % _sequence(config):
        raise ValueError(
            f"rollout_steps is {config.rollout_steps}; expected a multiple of {SEQUENCE}, the "
            "steps that an ego with a memory learns from at a time"
        )
    if config.confined_until > 0.0:
        raise ValueError(
            f"confined_until is {config.confined_until}; expected 0, since an ego for all styles "
            "has no role to be held to"
        )
    everyone = flatten(partners)
    count = jax.tree.leaves(everyone)[0].shape[0]
    ppo.expect_equal_shares("recurrent", config, count, "partners of all styles")

    def start(everyone: Policy, key: jax.Array, tells: Tells) -> RecurrentState:
        learner_key, reset_key, train_key = jax.random.split(key, 3)
        keys = jax.random.split(reset_key, config.num_envs)
        begin = ppo.restart(env, config.random_start)
        states, timesteps = ppo.over_games(begin, StylesByGame(env.styles))(keys)
        games = config.num_envs
        return RecurrentState(
            update=jnp.zeros((), jnp.int32),
            key=train_key,
            tells=tells,
            ego=_init_learner(env, config, learner_key),
            partners=everyone,
            env_states=states,
            observations=timesteps.observation,
            began=jnp.ones(games, bool),
            partner_action=jnp.zeros((games, env.num_actions.partner)),
            memories=(recurrent.no_memory(games), recurrent.no_memory(games)),
        )

    keys = jnp.tile(jax.random.split(key, seeds), len(VARIANTS))
    program = over_population(start, shared=1, compiler_options=env.compiler_options)
    return program(everyone, keys, tells_of(seeds))


def _init_learner(env: Environment, config: PPOConfig, key: jax.Array) -> RecurrentLearner:
    actor, critic = networks_of(env)
    size, told = env.observation_sizes.ego, len(env.style_names) + env.num_actions.partner
    example = (
        jnp.zeros((1, 1, size)),
        jnp.zeros((1, 1, told)),
        jnp.zeros((1, 1), bool),
        recurrent.no_memory(1),
    )
    actor_key, critic_key = jax.random.split(key)
    params = (actor.init(actor_key, *example), critic.init(critic_key, *example))
    normaliser = normalisation.fresh(size) if config.normalise else None
    return RecurrentLearner(*params, make_optimizer(config).init(params), normaliser)


def compile_recurrent(
    env: Environment, config: PPOConfig, num_updates: int
) -> Callable[[RecurrentState], tuple[RecurrentState, dict[str, jax.Array]]]:
    """The compiled `recurrent_chunk` of a population; the state is donated."""
    return over_population(
        partial(recurrent_chunk, env, config, num_updates),
        donate=(0,),
        compiler_options=env.compiler_options,
    )


def recurrent_chunk(
    env: Environment, config: PPOConfig, num_updates: int, state: RecurrentState
) -> tuple[RecurrentState, dict[str, jax.Array]]:
    """Advances one universal ego.

    Args:
        env: the environment.
        config: settings; `config.num_updates` is the length of the schedules.
        num_updates: updates to do.
        state: where training stands.

    Returns:
        The new state, and metrics of each update as of `ppo.train_chunk`.
    """
    return jax.lax.scan(lambda state, _: _update(env, config, state), state, length=num_updates)


def _update(
    env: Environment, config: PPOConfig, state: RecurrentState
) -> tuple[RecurrentState, dict[str, jax.Array]]:
    """One rollout and the learning from it."""
    progress = state.update / config.num_updates
    _, critic = networks_of(env)
    memory = state.memories[1]
    state, steps = _rollout(env, config, state, ppo.random_share(config, progress))

    ego = state.ego
    played = normalisation.normalise(ego.normaliser, steps["observations"].ego)
    sequence = (played, steps["told"], steps["began"])
    values, critic_memory, critic_memories = _values(config, critic, ego.critic, sequence, memory)
    next_seen = normalisation.normalise(ego.normaliser, state.observations.ego)
    following = (next_seen, _told(env, state), state.began)
    last, _ = critic.apply(ego.critic, *(part[None] for part in following), critic_memory)
    rewards = ppo.scaled_rewards(config, progress, steps)[0]
    advantage = generalised_advantages(
        rewards, values, last[0], steps["ended"], config.discount, config.gae_lambda
    )
    batch = Batch(
        observation=(sequence, (steps["memory"], critic_memories)),
        action=steps["actions"].ego,
        log_prob=steps["log_prob"],
        value=values,
        advantage=advantage,
        target=advantage + values,
    )
    learner, losses = _learn(
        env,
        config,
        ego,
        batch,
        ppo.falling(config.learning_rate, config.final_learning_rate, progress),
        ppo.falling(config.entropy, config.final_entropy, progress),
    )
    if ego.normaliser is not None:
        seen = normalisation.update(ego.normaliser, steps["observations"].ego)
        learner = learner.replace(normaliser=seen)
    state = state.replace(
        update=state.update + 1, ego=learner, memories=(state.memories[0], critic_memory)
    )
    return state, ppo.metrics_of(env, steps, losses)


def _sequence(config: PPOConfig) -> int:
    return min(SEQUENCE, config.rollout_steps)


def _pieces(config: PPOConfig, leaf: jax.Array) -> jax.Array:
    """A rollout [T, B, ...] in sequences, [piece, S, B, ...]."""
    return leaf.reshape(-1, _sequence(config), *leaf.shape[1:])


def _values(
    config: PPOConfig, critic: recurrent.RecurrentCritic, params: Any, sequence: Any, memory: Memory
) -> tuple[jax.Array, Memory, Memory]:
    """Values of a rollout [T, B], the memory after it, and those before each piece."""

    def one(memory: Memory, piece: Any) -> tuple[Any, Any]:
        values, following = critic.apply(params, *piece, memory)
        return following, (values, memory)

    pieces = jax.tree.map(partial(_pieces, config), sequence)
    last, (values, before) = jax.lax.scan(one, memory, pieces)
    return values.reshape(-1, values.shape[-1]), last, before


def _told(env: Environment, state: RecurrentState) -> jax.Array:
    """What the ego is told in each game now, [env, L]."""
    styles = len(env.style_names)
    labels = jnp.repeat(jnp.eye(styles), state.began.shape[0] // styles, axis=0)
    return state.tells(labels, state.partner_action)


def _rollout(
    env: Environment, config: PPOConfig, state: RecurrentState, share: jax.Array
) -> tuple[RecurrentState, dict[str, Any]]:
    """Plays `rollout_steps` steps of all games; finished games start anew."""
    actor, _ = networks_of(env)
    frozen = partial(
        ppo.frozen_partners, make_networks(env)[0].partner, config.partner_noise, state.partners
    )
    styles = StylesByGame(env.styles)
    play = ppo.over_games(lambda style, key, game, act: env.step(key, game, act, style), styles)
    restart_all = ppo.over_games(ppo.restart(env, share), styles)
    ego = state.ego

    def one_step(state: RecurrentState, step_key: jax.Array):
        ego_key, partner_key, env_key, reset_key = jax.random.split(step_key, 4)
        observations, told = state.observations, _told(env, state)
        seen = normalisation.normalise(ego.normaliser, observations.ego)
        now = (part[None] for part in (seen, told, state.began))
        acting, memory = actor.apply(ego.actor, *now, state.memories[0])
        acting = jax.tree.map(lambda leaf: leaf[0], acting)
        partner = frozen(observations.partner)
        actions = Pair(networks.sample(ego_key, acting), networks.sample(partner_key, partner))
        keys = jax.random.split(env_key, config.num_envs)
        following, timesteps = play(keys, state.env_states, actions)
        fresh, first = restart_all(jax.random.split(reset_key, config.num_envs))
        done = timesteps.done

        def renewed(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        kept = {
            "observations": observations,
            "told": told,
            "began": state.began,
            "actions": actions,
            "memory": state.memories[0],
            "log_prob": networks.log_prob(acting, actions.ego),
            "reward": timesteps.reward,
            "shaped": timesteps.shaped_reward,
            "ended": done,
            "terminated": timesteps.terminated,
        }
        shown = shown_action(env, actions.partner)
        state = state.replace(
            env_states=jax.tree.map(renewed, fresh, following),
            observations=jax.tree.map(renewed, first.observation, timesteps.observation),
            began=done,
            partner_action=jnp.where(done[:, None], 0.0, shown),
            memories=(memory, state.memories[1]),
        )
        return state, kept

    key = jax.random.fold_in(state.key, state.update)
    state, steps = jax.lax.scan(one_step, state, jax.random.split(key, config.rollout_steps))
    before = jax.tree.map(lambda leaf: leaf[:: _sequence(config)], steps["memory"])
    return state, {**steps, "memory": before}


def _learn(
    env: Environment,
    config: PPOConfig,
    learner: RecurrentLearner,
    batch: Batch,
    learning_rate: jax.Array,
    entropy_weight: jax.Array,
) -> tuple[RecurrentLearner, jax.Array]:
    """Some passes over the batch, in minibatches of games of all styles."""
    actor, critic = networks_of(env)
    optimizer = make_optimizer(config)
    minibatches = config.num_minibatches
    sequence, memories = batch.observation

    def dealt(leaf: jax.Array) -> jax.Array:
        """From [piece, S, B, ...] every n-th game, [minibatch, S, piece * B / n, ...]."""
        pieces, steps, games, *rest = leaf.shape
        leaf = leaf.reshape(pieces, steps, games // minibatches, minibatches, *rest)
        leaf = jnp.moveaxis(leaf, (3, 1, 0, 2), (0, 1, 2, 3))
        return leaf.reshape(minibatches, steps, -1, *rest)

    in_pieces = jax.tree.map(partial(_pieces, config), (sequence, batch.replace(observation=None)))
    parts = (
        jax.tree.map(dealt, in_pieces),
        jax.tree.map(lambda leaf: dealt(leaf[:, None])[:, 0], memories),
    )

    def loss_of(params: Any, index: jax.Array) -> jax.Array:
        (sequence, minibatch), (own, critics) = jax.tree.map(lambda leaf: leaf[index], parts)
        distribution, _ = actor.apply(params[0], *sequence, own)
        value, _ = critic.apply(params[1], *sequence, critics)
        return clipped_loss(distribution, value, minibatch, config, entropy_weight)

    def one_step(carry: Any, index: jax.Array):
        params, optimizer_state = carry
        loss, gradient = jax.value_and_grad(loss_of)(params, index)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        params = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
        return (params, optimizer_state), loss

    carry = ((learner.actor, learner.critic), learner.optimizer_state)
    order = jnp.tile(jnp.arange(minibatches), config.epochs)
    ((actor_params, critic_params), optimizer_state), losses = jax.lax.scan(one_step, carry, order)
    learner = learner.replace(
        actor=actor_params, critic=critic_params, optimizer_state=optimizer_state
    )
    return learner, losses


def raw_actors(state: RecurrentState) -> Any:
    """The actors of trained egos, which read raw observations, leading axis [variant * seed]."""
    return jax.vmap(raw_actor)(state.ego.actor, state.ego.normaliser)


def egos_by_style(env: Environment, actors: Any) -> dict[str, UniversalEgo]:
    """The agents that each variant is with partners of each style.

    Args:
        env: the environment.
        actors: what `raw_actors` returned.

    Returns:
        By variant, agents with leading axes [style, seed].
    """
    members = jax.tree.leaves(actors)[0].shape[0]
    seeds = members // len(VARIANTS)

    def of_style(label: jax.Array) -> UniversalEgo:
        labels = jnp.broadcast_to(label, (members, *label.shape))
        return UniversalEgo(actors, tells_of(seeds), labels)

    egos = jax.vmap(of_style)(jnp.eye(len(env.style_names)))
    return {
        name: jax.tree.map(lambda leaf, i=index: leaf[:, i * seeds : (i + 1) * seeds], egos)
        for index, name in enumerate(VARIANTS)
    }
