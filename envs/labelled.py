"""An environment whose ego is told the partner's style: a label at the end of what it sees."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment, Pair, TimeStep


class LabelledStyle(PyTreeNode):
    """A style and what the ego is told of it.

    Attributes:
        style: the environment's own style.
        label: float32 [style]: the style's one-hot, or zeros for an ego that is told nothing.
    """

    style: Any
    label: jax.Array


class Labelled:
    """Any environment, with the label appended to the ego's observation.

    Egos that are told the style and egos that are not then differ in their labels alone, and
    can learn in one program. Everything else is the environment's own.

    Attributes:
        env: the environment.
        styles: all styles stacked, each with its one-hot, leading axis [style].
        hidden_styles: the same with labels that say nothing.
    """

    def __init__(self, env: Environment):
        self.env = env
        self.name = env.name
        self.style_names = env.style_names
        count = len(env.style_names)
        self.styles = LabelledStyle(env.styles, jnp.eye(count))
        self.hidden_styles = LabelledStyle(env.styles, jnp.zeros((count, count)))
        self.event_names = env.event_names
        self.num_actions = env.num_actions
        ego, partner = env.observation_sizes
        self.observation_sizes = Pair(ego + count, partner)
        self.max_steps = env.max_steps
        self.symmetries = env.symmetries
        self.continuous = env.continuous
        self.compiler_options = env.compiler_options
        self.success_event = env.success_event
        self.task_language_source: Literal["events", "labels"] = env.task_language_source

    def style(self, name: str) -> LabelledStyle:
        """Returns one style with its one-hot; ValueError for an unknown name."""
        own = self.env.style(name)
        label = jax.nn.one_hot(self.style_names.index(name), len(self.style_names))
        return LabelledStyle(own, label)

    def confine(self, style: LabelledStyle) -> LabelledStyle:
        """Returns the style with the ego held to its role (training only)."""
        return style.replace(style=self.env.confine(style.style))

    def upper_bounds(self) -> dict[str, float]:
        """Returns the environment's own bounds."""
        return self.env.upper_bounds()

    def reset(self, key: jax.Array, style: LabelledStyle) -> tuple[Any, TimeStep]:
        """Starts a game; consumes `key`."""
        state, timestep = self.env.reset(key, style.style)
        return state, _told(timestep, style)

    def training_reset(
        self, key: jax.Array, style: LabelledStyle, random_share: jax.Array | float
    ) -> tuple[Any, TimeStep]:
        """Starts a game, or goes on from a random moment of one; consumes `key`."""
        state, timestep = self.env.training_reset(key, style.style, random_share)
        return state, _told(timestep, style)

    def step(
        self, key: jax.Array, state: Any, actions: Pair, style: LabelledStyle
    ) -> tuple[Any, TimeStep]:
        """Plays one step; consumes `key`."""
        state, timestep = self.env.step(key, state, actions, style.style)
        return state, _told(timestep, style)


def _told(timestep: TimeStep, style: LabelledStyle) -> TimeStep:
    ego, partner = timestep.observation
    return timestep.replace(observation=Pair(jnp.concatenate([ego, style.label]), partner))
