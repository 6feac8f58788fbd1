"""A game of a few steps whose every reward can be foretold."""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Pair, Symmetry, TimeStep


class ToyStyle(PyTreeNode):
    """`length`: steps of a game; `bound`: whether the ego is held to its role."""

    length: jax.Array
    bound: jax.Array


class ToyState(NamedTuple):
    """`time`: steps played; `number`: drawn at the start, float32 []."""

    time: jax.Array
    number: jax.Array


@dataclasses.dataclass(frozen=True)
class ToyGame:
    """The team earns ego_weight * ego's action + partner_weight * partner's action a step.

    A step also pays `confined_bonus` while the ego is held to its role, each player's shaped
    reward is `shaped`, and event 0 counts steps, event 1 the player's action. The game of
    style `short` ends by itself after 3 steps, that of `long` is truncated after 5.
    """

    ego_weight: float = 1.0
    partner_weight: float = 0.0
    confined_bonus: float = 0.0
    shaped: float = 0.0
    name: str = "toy"
    style_names: tuple[str, ...] = ("short", "long")
    event_names: tuple[str, ...] = ("step", "action")
    max_steps: int = 5
    num_actions: ClassVar[Pair] = Pair(3, 2)
    observation_sizes: ClassVar[Pair] = Pair(3, 4)
    continuous: ClassVar[bool] = False
    compiler_options: ClassVar[dict[str, Any]] = {}
    success_event: ClassVar[str | None] = None
    symmetries: ClassVar[tuple[Symmetry, ...]] = ()
    task_language_source: ClassVar[Literal["events", "labels"]] = "events"

    @property
    def styles(self) -> ToyStyle:
        return ToyStyle(jnp.array([3, 5]), jnp.zeros(2, bool))

    def style(self, name: str) -> ToyStyle:
        return jax.tree.map(lambda leaf: leaf[self.style_names.index(name)], self.styles)

    @staticmethod
    def confine(style: ToyStyle) -> ToyStyle:
        return style.replace(bound=jnp.ones_like(style.bound))

    def reset(self, key, style):
        state = ToyState(jnp.zeros((), jnp.int32), jax.random.uniform(key))
        return state, self._show(state, style, 0.0, jnp.zeros((2, 2)))

    def training_reset(self, key, style, random_share):
        del random_share
        return self.reset(key, style)

    def step(self, key, state, actions, style):
        del key
        state = state._replace(time=state.time + 1)
        ego, partner = (action.astype(jnp.float32) for action in actions)
        reward = self.ego_weight * ego + self.partner_weight * partner
        reward += self.confined_bonus * style.bound
        events = jnp.stack([jnp.ones(2), jnp.stack([ego, partner])], axis=1)
        return state, self._show(state, style, reward, events)

    def _show(self, state, style, reward, events) -> TimeStep:
        seen = jnp.stack([jnp.ones(()), state.time / self.max_steps, state.number])
        return TimeStep(
            observation=Pair(seen, jnp.append(seen, 1.0)),
            reward=jnp.asarray(reward, jnp.float32),
            shaped_reward=jnp.full(2, self.shaped),
            terminated=(state.time >= style.length) & (style.length < self.max_steps),
            truncated=state.time >= self.max_steps,
            events=events,
        )


def always(action: int, num_actions: int, observation_size: int, hidden: int = 2) -> dict:
    """A policy that plays one action whatever it sees."""
    sizes = [observation_size, hidden, hidden, num_actions]
    layers = {
        f"dense_{i}": {
            "kernel": jnp.zeros((sizes[i], sizes[i + 1])),
            "bias": jnp.zeros(sizes[i + 1]),
        }
        for i in range(3)
    }
    layers["dense_2"]["bias"] = 100.0 * jax.nn.one_hot(action, num_actions)
    return {"params": layers}
