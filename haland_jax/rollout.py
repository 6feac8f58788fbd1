"""Playing a pair: returns, events, observations and states of whole games.

The partner is a policy. The ego is a policy too, or an `Agent`, which may remember.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment, Pair
from haland_jax import networks
from haland_jax.networks import Distribution, Policy


class Agent(PyTreeNode):
    """An ego that may remember what it has seen and what its partner has done.

    Subclasses hold its parameters; leading axes make a population of it, as of a policy.
    """

    def begin(self, num_games: int) -> Any:
        """Returns its memory at the start of games, leading axis [G]."""
        raise NotImplementedError

    def act(
        self, memory: Any, observation: jax.Array, partner_action: jax.Array
    ) -> tuple[Distribution, Any]:
        """Plays one step of the games.

        Args:
            memory: at this step.
            observation: [G, O].
            partner_action: the partner's last action as `shown_action` gives it, zeros at the
                first step, [G, A].

        Returns:
            Action distributions [G, A], and the memory at the next step.
        """
        raise NotImplementedError


class Reactive(Agent):
    """A policy as an agent, which remembers nothing.

    Attributes:
        policy: parameters of an actor.
    """

    policy: Policy

    def begin(self, num_games: int) -> tuple[()]:
        """Returns nothing."""
        del num_games
        return ()

    def act(
        self, memory: tuple[()], observation: jax.Array, partner_action: jax.Array
    ) -> tuple[Distribution, tuple[()]]:
        """What the policy does on an observation."""
        del partner_action
        return networks.act(self.policy, observation), memory


def shown_action(env: Environment, action: jax.Array) -> jax.Array:
    """A partner's action as an agent is shown it: its one-hot, or the vector, [..., A]."""
    if env.continuous:
        return jnp.clip(action, -1.0, 1.0)
    return jax.nn.one_hot(action, env.num_actions.partner)


class Games(PyTreeNode):
    """Outcomes of games that were played in parallel.

    Attributes:
        returns: team reward of each game, undiscounted, float32 [G].
        lengths: steps of each game, int32 [G].
        events: events by game and player, summed over the game, float32 [G, agent, event].
    """

    returns: jax.Array
    lengths: jax.Array
    events: jax.Array


class Recording(PyTreeNode):
    """A game step by step; entries after its end are repetitions, marked by `alive`.

    Attributes:
        states: environment states before each step, leading axis [T].
        observations: `Pair` of observations before each step, [T, O].
        actions: `Pair` of actions, [T].
        rewards: team reward, float32 [T].
        events: what each player did in each step, float32 [T, player, event].
        alive: whether the game was still on, bool [T].
    """

    states: Any
    observations: Pair
    actions: Pair
    rewards: jax.Array
    events: jax.Array
    alive: jax.Array


def play(
    env: Environment,
    key: jax.Array,
    ego: Policy | Agent,
    partner: Policy,
    style: Any,
    *,
    num_games: int,
    greedy: bool = False,
) -> Games:
    """Plays whole games of one pair from the usual start.

    Args:
        env: the environment.
        key: consumed.
        ego: parameters of the ego's actor, or an agent.
        partner: parameters of the partner's actor.
        style: the partner's style.
        num_games: games G, played in parallel.
        greedy: play the most probable action; argmax play of pairs can deadlock, so the
            default samples.
    """
    reset_key, play_key = jax.random.split(key)
    reset_keys = jax.random.split(reset_key, num_games)
    states, timesteps = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, style)
    num_events = len(env.event_names)
    games = Games(
        returns=jnp.zeros(num_games),
        lengths=jnp.zeros(num_games, jnp.int32),
        events=jnp.zeros((num_games, 2, num_events)),
    )

    agent = ego if isinstance(ego, Agent) else Reactive(ego)

    def one_step(carry, step_key):
        states, observations, memory, shown, alive, games = carry
        act_key, env_key = jax.random.split(step_key)
        acting, memory = agent.act(memory, observations.ego, shown)
        distributions = Pair(acting, networks.act(partner, observations.partner))
        actions = draw_actions(act_key, distributions, greedy=greedy)
        env_keys = jax.random.split(env_key, num_games)
        states, timesteps = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            env_keys, states, actions, style
        )
        games = Games(
            returns=games.returns + timesteps.reward * alive,
            lengths=games.lengths + alive,
            events=games.events + timesteps.events * alive[:, None, None],
        )
        alive = alive & ~timesteps.done
        shown = shown_action(env, actions.partner)
        return (states, timesteps.observation, memory, shown, alive, games), None

    shown = jnp.zeros((num_games, env.num_actions.partner))
    alive = jnp.ones(num_games, bool)
    carry = (states, timesteps.observation, agent.begin(num_games), shown, alive, games)
    carry, _ = jax.lax.scan(one_step, carry, jax.random.split(play_key, env.max_steps))
    return carry[-1]


def record(
    env: Environment,
    key: jax.Array,
    ego: Policy | Agent,
    partner: Policy,
    style: Any,
    *,
    greedy: bool = False,
    random_share: float = 0.0,
) -> Recording:
    """Plays one game of a pair and keeps every step; arguments as in `play`.

    With chance `random_share` the game goes on from a random moment (`training_reset`).
    """
    reset_key, play_key = jax.random.split(key)
    if random_share:
        state, timestep = env.training_reset(reset_key, style, random_share)
    else:
        state, timestep = env.reset(reset_key, style)

    agent = ego if isinstance(ego, Agent) else Reactive(ego)

    def act(memory: Any, *now: jax.Array) -> tuple[Distribution, Any]:
        if isinstance(agent, Reactive):
            return agent.act(memory, *now)
        acting, memory = agent.act(memory, *(part[None] for part in now))
        return jax.tree.map(lambda leaf: leaf[0], acting), memory

    def one_step(carry, step_key):
        state, observation, memory, shown, alive = carry
        act_key, env_key = jax.random.split(step_key)
        acting, memory = act(memory, observation.ego, shown)
        distributions = Pair(acting, networks.act(partner, observation.partner))
        actions = draw_actions(act_key, distributions, greedy=greedy)
        following, timestep = env.step(env_key, state, actions, style)
        reward = timestep.reward * alive
        events = jnp.asarray(timestep.events, jnp.float32) * alive
        kept = Recording(state, observation, actions, reward, events, alive)
        shown = shown_action(env, actions.partner)
        return (following, timestep.observation, memory, shown, alive & ~timestep.done), kept

    shown = jnp.zeros(env.num_actions.partner)
    carry = (state, timestep.observation, agent.begin(1), shown, jnp.ones((), bool))
    return jax.lax.scan(one_step, carry, jax.random.split(play_key, env.max_steps))[1]


def visited_observations(
    env: Environment,
    key: jax.Array,
    ego: Policy,
    partners: Policy,
    style: Any,
    *,
    num_kept: int,
    games_each: int = 1,
) -> jax.Array:
    """Returns observations of the ego in games with partners, drawn at random, [num_kept, O].

    Half of the games go on from a random moment, so that the observations cover more than what
    these partners lead to. Observations after a game's end are never drawn.

    Args:
        env: the environment.
        key: consumed.
        ego: parameters of the ego's actor.
        partners: actors of the partners, leading axis [partner].
        style: the partners' style.
        num_kept: observations to draw, with replacement.
        games_each: games with each partner. Where they have few steps, many are needed, or the same
            observations are drawn again and again.
    """
    game_key, draw_key = jax.random.split(key)
    played = partial(record, env, random_share=0.5)
    number = jax.tree.leaves(partners)[0].shape[0]
    keys = jax.random.split(game_key, (games_each, number))
    with_each = jax.vmap(lambda k, partner: played(k, ego, partner, style))
    games = jax.vmap(with_each, in_axes=(0, None))(keys, partners)
    observations = games.observations.ego.reshape(-1, games.observations.ego.shape[-1])
    alive = games.alive.reshape(-1).astype(jnp.float32)
    drawn = jax.random.choice(draw_key, alive.shape[0], (num_kept,), p=alive / jnp.sum(alive))
    return observations[drawn]


def draw_actions(key: jax.Array, distributions: Pair, *, greedy: bool = False) -> Pair:
    """Draws both players' actions from what they would do, any leading axes; consumes `key`."""
    if greedy:
        return Pair(*(networks.mode(distribution) for distribution in distributions))
    keys = jax.random.split(key)
    return Pair(*(networks.sample(k, d) for k, d in zip(keys, distributions, strict=True)))
