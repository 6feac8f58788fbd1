"""An environment with the interface of JaxMARL's `MultiAgentEnv` (jaxmarl 0.2.0).

Dictionaries by agent name, automatic reset inside `step`, spaces with `sample` and `contains`.
JaxMARL itself is not needed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.base import AGENTS, Environment, Pair, TimeStep

ByAgent = dict[str, jax.Array]


class Discrete:
    """The integers 0 to n - 1."""

    def __init__(self, n: int):
        self.n = n
        self.shape: tuple[int, ...] = ()
        self.dtype = jnp.int32

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws one of them; consumes `key`."""
        return jax.random.randint(key, self.shape, 0, self.n, self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether `x` is one of them, bool []."""
        return (x >= 0) & (x < self.n)


class Box:
    """Arrays of one shape without bounds."""

    def __init__(self, shape: Sequence[int], dtype: Any = jnp.float32):
        self.low, self.high = -jnp.inf, jnp.inf
        self.shape = tuple(shape)
        self.dtype = dtype

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws an array of standard normal numbers; consumes `key`."""
        return jax.random.normal(key, self.shape).astype(self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether `x` has the shape and no NaN, bool []."""
        return jnp.asarray(jnp.shape(x) == self.shape) & ~jnp.any(jnp.isnan(x))


class JaxMARLState(PyTreeNode):
    """A game between two calls.

    Attributes:
        inner: the environment's own state.
        style: index of the partner's style into the environment's styles, int32 [].
        observation: what each agent sees now.
        done: whether the game is over, bool []; after `step`'s automatic reset, always False.
        step: steps taken in this game, int32 [].
    """

    inner: Any
    style: jax.Array
    observation: ByAgent
    done: jax.Array
    step: jax.Array


class JaxMARLEnvironment:
    """A two-player environment for code written for JaxMARL; the agents are `ego` and `partner`.

    At every reset the partner's style is drawn from `style_names`. The reward is the team's, the
    same for both agents. `infos` holds `shaped_reward` (by agent), `terminated` and `truncated`
    (bool []), `events` [agent, event] and `terminal_observation` (by agent): what followed the
    actions, which the returned observation does not show when a new game has begun.

    Args:
        environment: an environment with discrete actions, such as `registry.make` returns.
        style_names: styles to draw from; all of the environment's by default.

    Raises:
        ValueError: continuous actions, no style, or an unknown one.
    """

    def __init__(self, environment: Environment, style_names: Sequence[str] | None = None):
        if environment.continuous:
            raise ValueError(
                f"{environment.name} has continuous actions; expected an environment with discrete "
                "ones, such as overcooked/crossway; see envs.adapters.brax"
            )
        chosen = environment.style_names if style_names is None else tuple(style_names)
        unknown = [name for name in chosen if name not in environment.style_names]
        if unknown or not chosen:
            raise ValueError(
                f"style_names is {list(chosen)}; expected one or more of "
                f"{', '.join(environment.style_names)}"
            )
        self.environment = environment
        self.style_names = chosen
        self.agents = list(AGENTS)
        self.num_agents = len(AGENTS)
        indices = [environment.style_names.index(name) for name in chosen]
        self._style_indices = np.array(indices, np.int32)
        first = environment.style(chosen[0])
        _, timestep = jax.eval_shape(environment.reset, jax.random.key(0), first)
        self.observation_spaces = {
            agent: Box(seen.shape, seen.dtype)
            for agent, seen in zip(AGENTS, timestep.observation, strict=True)
        }
        self.action_spaces = {
            agent: Discrete(count)
            for agent, count in zip(AGENTS, environment.num_actions, strict=True)
        }

    @property
    def name(self) -> str:
        """The environment's name."""
        return self.environment.name

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """The agents by role."""
        return {agent: [agent] for agent in AGENTS}

    def observation_space(self, agent: str) -> Box:
        """The space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """The space of an agent's actions."""
        return self.action_spaces[agent]

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> tuple[ByAgent, JaxMARLState]:
        """Starts a game against a partner of a drawn style; consumes `key`."""
        style_key, reset_key = jax.random.split(key)
        drawn = jax.random.randint(style_key, (), 0, len(self._style_indices))
        style = jnp.asarray(self._style_indices)[drawn]
        inner, timestep = self.environment.reset(reset_key, self._style(style))
        observation = _by_agent(timestep.observation)
        state = JaxMARLState(
            inner=inner,
            style=style,
            observation=observation,
            done=jnp.zeros((), bool),
            step=jnp.zeros((), jnp.int32),
        )
        return observation, state

    @functools.partial(jax.jit, static_argnums=0)
    def step(
        self,
        key: jax.Array,
        state: JaxMARLState,
        actions: ByAgent,
        reset_state: JaxMARLState | None = None,
    ) -> tuple[ByAgent, JaxMARLState, ByAgent, ByAgent, dict[str, Any]]:
        """Plays one step and starts the next game where one has ended; consumes `key`.

        Args:
            key: used by the step and by the reset.
            state: the game.
            actions: int32 [] by agent.
            reset_state: start of the next game; drawn by `reset` by default.

        Returns:
            Observations, state, rewards and dones by agent (dones also of `__all__`), infos.
        """
        step_key, reset_key = jax.random.split(key)
        _, stepped, rewards, dones, infos = self.step_env(step_key, state, actions)
        started = self.reset(reset_key)[1] if reset_state is None else reset_state
        chosen = jax.tree.map(
            lambda new, old: jnp.where(dones["__all__"], new, old), started, stepped
        )
        return chosen.observation, chosen, rewards, dones, infos

    @functools.partial(jax.jit, static_argnums=0)
    def step_env(
        self, key: jax.Array, state: JaxMARLState, actions: ByAgent
    ) -> tuple[ByAgent, JaxMARLState, ByAgent, ByAgent, dict[str, Any]]:
        """Plays one step without a reset; consumes `key`. Returns what `step` returns."""
        pair = Pair(*(actions[agent] for agent in AGENTS))
        inner, timestep = self.environment.step(key, state.inner, pair, self._style(state.style))
        observation = _by_agent(timestep.observation)
        done = timestep.done
        stepped = state.replace(
            inner=inner, observation=observation, done=done, step=state.step + 1
        )
        rewards: ByAgent = dict.fromkeys(AGENTS, timestep.reward)
        dones: ByAgent = dict.fromkeys((*AGENTS, "__all__"), done)
        return observation, stepped, rewards, dones, _infos(timestep)

    def get_obs(self, state: JaxMARLState) -> ByAgent:
        """Returns what each agent sees."""
        return state.observation

    def get_avail_actions(self, state: JaxMARLState) -> ByAgent:
        """Returns the mask of possible actions by agent, bool [action]: all are, always."""
        return {agent: jnp.ones(space.n, bool) for agent, space in self.action_spaces.items()}

    def _style(self, index: jax.Array) -> Any:
        return jax.tree.map(lambda leaf: leaf[index], self.environment.styles)


def _by_agent(pair: Any) -> ByAgent:
    return dict(zip(AGENTS, pair, strict=True))


def _infos(timestep: TimeStep) -> dict[str, Any]:
    return {
        "shaped_reward": _by_agent(timestep.shaped_reward),
        "terminated": timestep.terminated,
        "truncated": timestep.truncated,
        "events": timestep.events,
        "terminal_observation": _by_agent(timestep.observation),
    }
