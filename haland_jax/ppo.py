"""Proximal policy optimisation for a pair of players (Schulman et al., 2017).

`train_chunk` advances one pair by some updates, as a pure function of explicit state; callers
map it over styles and seeds. Both players learn, or the ego alone against frozen partners.
The style binds the partner; early in training the ego may be held to its role as well, and
is then released (`confined_until`). Partners of several styles may share the games of one ego
(`StylesByGame`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import Environment, Pair
from haland_jax import networks, normalisation
from haland_jax.learner import (
    Learner,
    StylesByGame,
    TrainState,
    make_networks,
    make_optimizer,
)
from haland_jax.networks import MLPActor, Policy
from haland_jax.ppo_loss import Batch, PPOConfig, generalised_advantages, ppo_loss


def expect_equal_shares(name: str, config: PPOConfig, count: int, partners: str) -> None:
    """Checks that frozen partners can share the games in equal parts.

    Args:
        name: of the settings, for the message.
        config: the settings.
        count: how many partners there are.
        partners: what they are, for the message.

    Raises:
        ValueError: `config.num_envs` is no multiple of `count`.
    """
    if config.num_envs % count:
        raise ValueError(
            f"{name}.num_envs is {config.num_envs}; expected a multiple of {count}, the number "
            f"of {partners}, who share the games"
        )


def init_train_state(
    env: Environment,
    config: PPOConfig,
    key: jax.Array,
    ego: Learner,
    partner: Learner | Policy,
    style: Any,
    guides: Policy | None = None,
) -> TrainState:
    """Starts the games of one pair; `key` is consumed here and by the training."""
    reset_key, train_key = jax.random.split(key)
    keys = jax.random.split(reset_key, config.num_envs)
    states, timesteps = over_games(restart(env, config.random_start), style)(keys)
    return TrainState(
        update=jnp.zeros((), jnp.int32),
        key=train_key,
        ego=ego,
        partner=partner,
        env_states=states,
        observations=timesteps.observation,
        guides=guides,
    )


def train_chunk(
    env: Environment, config: PPOConfig, num_updates: int, state: TrainState, style: Any
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Advances one pair.

    Args:
        env: the environment.
        config: settings; `config.num_updates` is the length of the schedules.
        num_updates: updates to do.
        state: where training stands.
        style: the partner's style, or `StylesByGame`.

    Returns:
        The new state, and metrics of each update, float32 [num_updates]: `reward`, team reward
        a step; `return`, team reward a game; `shaped`, the mean shaped reward a step; `loss`,
        the mean loss of those who learn. Where games end by their own rules, the return is
        reward / games ended; elsewhere it is what a whole game of such steps would bring, since
        games that go on from a random moment are shorter.
    """

    def one_update(state: TrainState, _: None):
        return _update(env, config, state, style)

    return jax.lax.scan(one_update, state, None, length=num_updates)


def _update(
    env: Environment, config: PPOConfig, state: TrainState, style: Any
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One rollout and the learning from it."""
    progress = state.update / config.num_updates
    rollout_key = jax.random.fold_in(state.key, state.update)
    confined = confine(env, style)
    bound = progress < config.confined_until
    style_now = jax.tree.map(lambda held, free: jnp.where(bound, held, free), confined, style)
    share = random_share(config, progress)
    state, steps = _rollout(env, config, state, style_now, rollout_key, share)

    actors, critic = make_networks(env)
    scaled = scaled_rewards(config, progress, steps)
    rates = {
        "learning_rate": falling(config.learning_rate, config.final_learning_rate, progress),
        "entropy_weight": falling(config.entropy, config.final_entropy, progress),
        "guidance": fading(config.guidance, config.guidance_until, progress),
    }
    losses = []
    for agent, role in enumerate(("ego", "partner")):
        learner = getattr(state, role)
        if not isinstance(learner, Learner):
            continue
        actor = actors[agent]
        batch = _make_batch(
            config, critic, learner, steps, state.observations[agent], agent, scaled[agent]
        )
        if state.guides is not None and role == "ego":
            advised = partial(frozen_partners, actor, 0.0, state.guides)
            batch = batch.replace(guide=jax.vmap(advised)(steps["observations"][agent]))
        strided = isinstance(style, StylesByGame) or not isinstance(state.partner, Learner)
        learner, loss = _learn(config, actor, critic, learner, batch, strided=strided, **rates)
        if learner.normaliser is not None:
            seen = normalisation.update(learner.normaliser, steps["observations"][agent])
            learner = learner.replace(normaliser=seen)
        state = state.replace(**{role: learner})
        losses.append(loss)
    return state.replace(update=state.update + 1), metrics_of(env, steps, jnp.stack(losses))


def metrics_of(env: Environment, steps: dict[str, Any], losses: jax.Array) -> dict[str, jax.Array]:
    """Metrics of one update; see `train_chunk`."""
    by_rule = jnp.any(steps["terminated"])
    game_steps = jnp.where(by_rule, 1 / jnp.mean(steps["ended"]), env.max_steps)
    return {
        "reward": jnp.mean(steps["reward"]),
        "return": jnp.mean(steps["reward"]) * game_steps,
        "shaped": jnp.mean(steps["shaped"]),
        "loss": jnp.mean(losses),
    }


def scaled_rewards(config: PPOConfig, progress: jax.Array, steps: dict[str, Any]) -> jax.Array:
    """What the players learn from: the team's reward and what is left of the shaped ones.

    Args:
        config: settings.
        progress: of the training, 0 to 1.
        steps: of a rollout, leading axes [T, env].

    Returns:
        [agent, T, env].
    """
    shaping = fading(config.shaping, config.shaping_until, progress)
    shaped = jnp.moveaxis(steps["shaped"], -1, 0)
    return config.reward_scale * (steps["reward"] + shaping * shaped)


def random_share(config: PPOConfig, progress: jax.Array) -> jax.Array:
    """The share of games that start at a random moment now."""
    remaining = (1 - progress) / (1 - config.random_start_until)
    return config.final_random_start + jnp.minimum(1.0, remaining) * (
        config.random_start - config.final_random_start
    )


def over_games(function: Callable[..., Any], style: Any) -> Callable[..., Any]:
    """Maps a function of (style, one game's arguments) over all games, leading axis [env]."""
    if not isinstance(style, StylesByGame):
        return jax.vmap(partial(function, style))
    styles = style.styles
    count = jax.tree.leaves(styles)[0].shape[0]

    def mapped(*games: Any) -> Any:
        shares = jax.tree.map(lambda leaf: leaf.reshape(count, -1, *leaf.shape[1:]), games)
        played = jax.vmap(lambda one, share: jax.vmap(partial(function, one))(*share))(
            styles, shares
        )
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), played)

    return mapped


def restart(env: Environment, share: jax.Array | float) -> Callable[..., Any]:
    """Starts a game of (style, key); some games go on from a random moment."""
    return lambda style, key: env.training_reset(key, style, share)


def confine(env: Environment, style: Any) -> Any:
    """The style, or `StylesByGame`, with the ego held to its role."""
    if isinstance(style, StylesByGame):
        return StylesByGame(jax.vmap(env.confine)(style.styles))
    return env.confine(style)


def falling(start: float, end: float, progress: jax.Array) -> jax.Array:
    """What falls linearly from `start` to `end`."""
    return start + (end - start) * progress


def fading(start: float, until: float, progress: jax.Array) -> jax.Array:
    """What falls linearly from `start` to 0, where it is when the progress is `until`."""
    return start * jnp.maximum(0.0, 1 - progress / until)


def _rollout(
    env: Environment,
    config: PPOConfig,
    state: TrainState,
    style: Any,
    key: jax.Array,
    share: jax.Array,
) -> tuple[TrainState, dict[str, Any]]:
    """Plays `rollout_steps` steps of all games; finished games start anew."""
    actors, _ = make_networks(env)
    ego = partial(_distribution, actors.ego, state.ego)
    if isinstance(state.partner, Learner):
        partner = partial(_distribution, actors.partner, state.partner)
    else:
        partner = partial(frozen_partners, actors.partner, config.partner_noise, state.partner)
    play = over_games(lambda style, key, game, actions: env.step(key, game, actions, style), style)
    restart_all = over_games(restart(env, share), style)

    def one_step(carry, step_key):
        states, observations = carry
        ego_key, partner_key, env_key, reset_key = jax.random.split(step_key, 4)
        distributions = Pair(ego(observations.ego), partner(observations.partner))
        actions = Pair(
            networks.sample(ego_key, distributions.ego),
            networks.sample(partner_key, distributions.partner),
        )
        log_probs = Pair(*map(networks.log_prob, distributions, actions))
        keys = jax.random.split(env_key, config.num_envs)
        following, timesteps = play(keys, states, actions)
        fresh, first = restart_all(jax.random.split(reset_key, config.num_envs))
        done = timesteps.done

        def renewed(new, old):
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        kept = {
            "observations": observations,
            "actions": actions,
            "log_probs": log_probs,
            "reward": timesteps.reward,
            "shaped": timesteps.shaped_reward,
            "ended": done,
            "terminated": timesteps.terminated,
        }
        states = jax.tree.map(renewed, fresh, following)
        observations = jax.tree.map(renewed, first.observation, timesteps.observation)
        return (states, observations), kept

    carry = (state.env_states, state.observations)
    (env_states, observations), steps = jax.lax.scan(
        one_step, carry, jax.random.split(key, config.rollout_steps)
    )
    return state.replace(env_states=env_states, observations=observations), steps


def _distribution(actor: MLPActor, learner: Learner, observation: jax.Array) -> Any:
    """What a learner does on raw observations [env, O]."""
    return actor.apply(learner.actor, normalisation.normalise(learner.normaliser, observation))


def frozen_partners(actor: MLPActor, noise: float, policies: Policy, observation: jax.Array) -> Any:
    """Each of the frozen partners plays an equal share of the games, with trembling hands."""
    num_partners = jax.tree.leaves(policies)[0].shape[0]
    shared = observation.reshape(num_partners, -1, observation.shape[-1])
    distributions: Any = jax.vmap(actor.apply)(policies, shared)
    distributions = jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), distributions)
    return networks.tremble(distributions, noise) if noise else distributions


def _make_batch(
    config: PPOConfig,
    critic: Any,
    learner: Learner,
    steps: dict[str, Any],
    last_observation: jax.Array,
    agent: int,
    rewards: jax.Array,
) -> Batch:
    """Values and advantages of one player's experience."""
    everything = jnp.concatenate([steps["observations"][agent], last_observation[None]])
    everything = normalisation.normalise(learner.normaliser, everything)
    values = critic.apply(learner.critic, everything)
    advantage = generalised_advantages(
        rewards, values[:-1], values[-1], steps["ended"], config.discount, config.gae_lambda
    )
    return Batch(
        observation=everything[:-1],
        action=steps["actions"][agent],
        log_prob=steps["log_probs"][agent],
        value=values[:-1],
        advantage=advantage,
        target=advantage + values[:-1],
    )


def _learn(
    config: PPOConfig,
    actor: Any,
    critic: Any,
    learner: Learner,
    batch: Batch,
    *,
    strided: bool,
    learning_rate: jax.Array,
    entropy_weight: jax.Array,
    guidance: jax.Array | float = 0.0,
) -> tuple[Learner, jax.Array]:
    """Some passes over the batch, in minibatches of whole games.

    Games are exchangeable, so each minibatch is a fixed share of them: a shuffle that differs
    between the members of a population would cost as much as the learning itself on a CPU.
    Games of several styles or frozen partners lie in the order of these; with `strided` a
    minibatch takes every n-th game, and so games of all of them.
    """
    optimizer = make_optimizer(config)

    def split(leaf: jax.Array) -> jax.Array:
        by_game = jnp.swapaxes(leaf, 0, 1)
        if strided:
            dealt = by_game.reshape(-1, config.num_minibatches, *by_game.shape[1:])
            return jnp.swapaxes(dealt, 0, 1).reshape(config.num_minibatches, -1, *leaf.shape[2:])
        return by_game.reshape(config.num_minibatches, -1, *leaf.shape[2:])

    minibatches = jax.tree.map(split, batch)

    def one_step(carry, index):
        params, optimizer_state = carry
        minibatch = jax.tree.map(lambda leaf: leaf[index], minibatches)
        loss, gradient = jax.value_and_grad(ppo_loss)(
            params, minibatch, actor, critic, config, entropy_weight, guidance
        )
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        params = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
        return (params, optimizer_state), loss

    carry = ((learner.actor, learner.critic), learner.optimizer_state)
    order = jnp.tile(jnp.arange(config.num_minibatches), config.epochs)
    ((actor_params, critic_params), optimizer_state), losses = jax.lax.scan(one_step, carry, order)
    learner = learner.replace(
        actor=actor_params, critic=critic_params, optimizer_state=optimizer_state
    )
    return learner, jnp.mean(losses)
