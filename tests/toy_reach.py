"""A game of a few steps with continuous actions, whose best actions can be foretold."""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Pair, Symmetry, TimeStep

SCALE, OFFSET = 40.0, 500.0
"""Of what the players see of the drawn number: far from zero mean and unit deviation."""


class ReachStyle(PyTreeNode):
    """`goal`: the action that pays most, float32 []."""

    goal: jax.Array


class ReachState(NamedTuple):
    """`time`: steps played; `number`: drawn at the start, float32 []."""

    time: jax.Array
    number: jax.Array


@dataclasses.dataclass(frozen=True)
class ToyReach:
    """A step costs (first number of a player's action - goal)², for both players.

    The partner sees the goal. What both see of the number drawn at the start is large and of no
    use, as is the second number of the ego's action. Event `hit` counts a player's steps within
    0.1 of the goal.
    """

    max_steps: int = 5
    name: str = "toy_reach"
    style_names: tuple[str, ...] = ("low", "high")
    event_names: tuple[str, ...] = ("hit",)
    num_actions: ClassVar[Pair] = Pair(2, 1)
    observation_sizes: ClassVar[Pair] = Pair(2, 3)
    continuous: ClassVar[bool] = True
    compiler_options: ClassVar[dict[str, Any]] = {}
    success_event: ClassVar[str | None] = None
    symmetries: ClassVar[tuple[Symmetry, ...]] = ()
    task_language_source: ClassVar[Literal["events", "labels"]] = "labels"

    @property
    def styles(self) -> ReachStyle:
        return ReachStyle(jnp.array([-0.4, 0.4]))

    def style(self, name: str) -> ReachStyle:
        if name not in self.style_names:
            raise ValueError(f"unknown style {name!r}")
        return jax.tree.map(lambda leaf: leaf[self.style_names.index(name)], self.styles)

    @staticmethod
    def confine(style: ReachStyle) -> ReachStyle:
        return style

    def upper_bounds(self) -> dict[str, float]:
        return dict.fromkeys(self.style_names, 0.0)

    def reset(self, key, style):
        state = ReachState(jnp.zeros((), jnp.int32), jax.random.uniform(key))
        return state, self._show(state, style, 0.0, jnp.zeros((2, 1)))

    def training_reset(self, key, style, random_share):
        del random_share
        return self.reset(key, style)

    def step(self, key, state, actions, style):
        del key
        state = state._replace(time=state.time + 1)
        apart = jnp.stack([action[0] - style.goal for action in actions])
        hits = (jnp.abs(apart) < 0.1).astype(jnp.float32)
        return state, self._show(state, style, -jnp.sum(apart**2), hits[:, None])

    def _show(self, state, style, reward, events) -> TimeStep:
        seen = jnp.stack([state.time / self.max_steps, OFFSET + SCALE * state.number])
        return TimeStep(
            observation=Pair(seen, jnp.append(seen, style.goal)),
            reward=jnp.asarray(reward, jnp.float32),
            shaped_reward=jnp.zeros(2),
            terminated=jnp.zeros((), bool),
            truncated=state.time >= self.max_steps,
            events=events,
        )
