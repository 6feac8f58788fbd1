"""Live games of one environment: every game that goes on is a seat of one compiled program.

The partner of each game is a person. A game is a pure function of its seed, its policy and the
person's actions: the policy draws its actions with keys made of the game's seed and the step, so
that a game which a crash interrupted goes on as if nothing had happened.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.base import DrawnEnvironment, Environment, Pair
from envs.drawing import Scene
from haland_jax import networks
from haland_jax.networks import Policy


class Seats(PyTreeNode):
    """Games side by side, leading axis [seat].

    Attributes:
        key: of the game, folded with `step`; typed keys.
        step: steps played, int32.
        style: what the person was asked to be.
        policy: the ego's actor.
        state: the environment's state.
        observation: what the ego sees, float32 [seat, O].
    """

    key: jax.Array
    step: jax.Array
    style: Any
    policy: Policy
    state: Any
    observation: jax.Array


class Played(NamedTuple):
    """What one step of all seats brought, [seat] each; of seats that paused it means nothing."""

    ego_action: np.ndarray
    reward: np.ndarray
    done: np.ndarray


class Replay(NamedTuple):
    """A recorded game played again, [T] each, and its states before each step and after the last.

    Attributes:
        states: leading axis [T + 1].
        rewards: team reward of each step.
        observations: what both players saw, `Pair` of [T + 1, O].
    """

    states: Any
    rewards: np.ndarray
    observations: Pair


class Arena:
    """The games of one environment.

    Attributes:
        env: the environment.
        size: how many games can go on at once.
    """

    def __init__(self, env: DrawnEnvironment, size: int, policy: Policy):
        """Makes the seats; `compile` makes the programs.

        Args:
            env: an environment with discrete actions.
            size: how many games can go on at once.
            policy: one that has the shapes of all that will play.

        Raises:
            ValueError: the environment's actions are continuous.
        """
        if env.continuous:
            raise ValueError(f"{env.name} has continuous actions, which no key stands for")
        self.env, self.size = env, size
        options = env.compiler_options
        self._begin = jax.jit(partial(_begin, env), compiler_options=options)
        self._advance = jax.jit(partial(_advance, env), donate_argnums=0, compiler_options=options)
        self._replay = jax.jit(partial(_replay, env), compiler_options=options)
        self._put = jax.jit(_put, donate_argnums=0)
        hosted = _on_host(env.styles)
        self._styles = [
            jax.tree.map(lambda leaf, i=index: leaf[i], hosted)
            for index in range(len(env.style_names))
        ]
        one = self._begin(jax.random.key(0), self._style(0), policy)
        self._seats = jax.tree.map(lambda leaf: jnp.stack([leaf] * size), one)

    def compile(self) -> None:
        """Runs every program once, so that no player waits for the compiler."""
        blank = jax.tree.map(lambda leaf: leaf[0], self._seats)
        self.begin(0, blank.policy, 0, 0)
        self.advance(np.zeros(self.size, np.int32), np.zeros(self.size, bool))
        actions = np.zeros(1, np.int32)
        self.resume(0, blank.policy, 0, 0, Pair(actions, actions))

    def begin(self, seat: int, policy: Policy, style: int, seed: int) -> Any:
        """Starts a game; returns its first state, NumPy."""
        one = self._begin(jax.random.key(seed), self._style(style), policy)
        self._seats = self._put(self._seats, seat, one)
        return _on_host(one.state)

    def resume(self, seat: int, policy: Policy, style: int, seed: int, actions: Pair) -> Any:
        """Goes on with a game of which `actions`, `Pair` of int [T], were played.

        Returns:
            The state after them, NumPy.
        """
        length = len(actions.ego)
        states, _, observations = self._played_again(style, seed, actions)
        one = Seats(
            key=jax.random.key(seed),
            step=jnp.int32(length),
            style=self._style(style),
            policy=policy,
            state=jax.tree.map(lambda leaf: leaf[length], states),
            observation=observations.ego[length],
        )
        self._seats = self._put(self._seats, seat, one)
        return _on_host(one.state)

    def advance(self, partner_actions: np.ndarray, playing: np.ndarray) -> tuple[Played, Any]:
        """Plays one step of the seats that are `playing`, bool [seat].

        Args:
            partner_actions: what the people do, int32 [seat].
            playing: whose game goes on.

        Returns:
            What happened, and the states after it, NumPy, leading axis [seat].
        """
        self._seats, played = self._advance(self._seats, partner_actions, playing)
        return Played(*map(np.asarray, played)), _on_host(self._seats.state)

    def first_state(self) -> Any:
        """A state to draw, NumPy."""
        return _on_host(jax.tree.map(lambda leaf: leaf[0], self._seats.state))

    def draw(self, state: Any, style: int) -> Scene:
        """One state as the player sees it, with what the style forbids or wants."""
        return self.env.viewer.draw_board(self.env, state, style=self._styles[style])

    def replay(self, style: int, seed: int, actions: Pair) -> Replay:
        """Plays a recorded game again; actions as of `resume`."""
        length = len(actions.ego)
        states, rewards, observations = self._played_again(style, seed, actions)
        kept, seen = jax.tree.map(
            lambda leaf: np.asarray(leaf)[: length + 1], (states, observations)
        )
        return Replay(kept, np.asarray(rewards)[:length], seen)

    def _played_again(self, style: int, seed: int, actions: Pair) -> Any:
        # Always as long as a whole game, so that there is one program.
        length = self.env.max_steps
        padded = Pair(*(np.pad(np.asarray(a, np.int32), (0, length - len(a))) for a in actions))
        return self._replay(jax.random.key(seed), self._style(style), padded)

    def _style(self, index: int) -> Any:
        return jax.tree.map(lambda leaf: leaf[index], self.env.styles)


def _begin(env: Environment, key: jax.Array, style: Any, policy: Policy) -> Seats:
    state, timestep = _start(env, key, style)
    step = jnp.zeros((), jnp.int32)
    return Seats(key, step, style, policy, state, timestep.observation.ego)


def _start(env: Environment, key: jax.Array, style: Any) -> Any:
    return env.reset(jax.random.fold_in(key, 0), style)


def _step_keys(key: jax.Array, step: jax.Array) -> jax.Array:
    """For the ego's action and for the game, of one step."""
    return jax.random.split(jax.random.fold_in(key, step + 1))


def _advance(
    env: Environment, seats: Seats, partner_actions: jax.Array, playing: jax.Array
) -> tuple[Seats, tuple[jax.Array, jax.Array, jax.Array]]:
    def one(seat: Seats, partner_action: jax.Array, playing: jax.Array) -> Any:
        act_key, env_key = _step_keys(seat.key, seat.step)
        ego_action = networks.sample(act_key, networks.act(seat.policy, seat.observation))
        actions = Pair(ego_action, partner_action)
        state, timestep = env.step(env_key, seat.state, actions, seat.style)
        following = seat.replace(
            step=seat.step + 1, state=state, observation=timestep.observation.ego
        )
        changed = {
            name: jax.tree.map(
                partial(jnp.where, playing), getattr(following, name), getattr(seat, name)
            )
            for name in ("step", "state", "observation")
        }
        return seat.replace(**changed), (ego_action, timestep.reward, timestep.done)

    return jax.vmap(one)(seats, partner_actions, playing)


def _replay(
    env: Environment, key: jax.Array, style: Any, actions: Pair
) -> tuple[Any, jax.Array, Pair]:
    """States [T + 1], rewards [T] and observations [T + 1] of recorded actions [T]."""
    state, timestep = _start(env, key, style)

    def one(state: Any, now: tuple[jax.Array, Pair]) -> Any:
        step, actions = now
        _, env_key = _step_keys(key, step)
        state, timestep = env.step(env_key, state, actions, style)
        return state, (state, timestep.reward, timestep.observation)

    steps = jnp.arange(actions.ego.shape[0], dtype=jnp.int32)
    _, (states, rewards, observations) = jax.lax.scan(one, state, (steps, actions))

    def with_first(first: jax.Array, rest: jax.Array) -> jax.Array:
        return jnp.concatenate([first[None], rest])

    states = jax.tree.map(with_first, state, states)
    return states, rewards, jax.tree.map(with_first, timestep.observation, observations)


def _put(seats: Seats, seat: jax.Array, one: Seats) -> Seats:
    return jax.tree.map(lambda all_, new: all_.at[seat].set(new), seats, one)


def _on_host(state: Any) -> Any:
    return jax.tree.map(np.asarray, state)
