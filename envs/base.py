"""The protocol that every environment of two players follows.

An environment is a bundle of pure functions; its state is explicit and holds no key.
Functions are unbatched: callers `vmap` over games, styles and seeds. Nothing resets by
itself, so a terminal observation is never mixed up with the first one of the next game.
"""

from types import ModuleType
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

AGENTS = ("ego", "partner")


class Pair(NamedTuple):
    """One thing for each player; the two may differ in shape."""

    ego: Any
    partner: Any


class TimeStep(PyTreeNode):
    """What a step (or a reset) shows.

    Attributes:
        observation: `Pair` of float32 arrays [O].
        reward: team reward, float32 [].
        shaped_reward: a learning aid for each player, float32 [agent]; never part of a score.
        terminated: the task ended by its own rules, bool [].
        truncated: the time was up, bool [].
        events: how often each event happened in this step, float32 [agent, event].
    """

    observation: Pair
    reward: jax.Array
    shaped_reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    events: jax.Array

    @classmethod
    def first(cls, observation: Pair, num_events: int) -> "TimeStep":
        """What a reset shows: nothing has been earned, has happened or is over yet."""
        no = jnp.zeros((), bool)
        return cls(
            observation=observation,
            reward=jnp.zeros(()),
            shaped_reward=jnp.zeros(2),
            terminated=no,
            truncated=no,
            events=jnp.zeros((2, num_events)),
        )

    @property
    def done(self) -> jax.Array:
        """Whether the game is over, for either reason, bool []."""
        return self.terminated | self.truncated


class Symmetry(NamedTuple):
    """A mirror in which an environment looks the same, with its styles exchanged.

    Attributes:
        styles: as which style each style appears, int [style].
        observation: as which number of the partner's observation each number appears, int [O].
        actions: as which action of the partner each action appears, int [A].
    """

    styles: np.ndarray
    observation: np.ndarray
    actions: np.ndarray


class Environment(Protocol):
    """Two players, one of them (the partner) of a style that the other cannot see."""

    name: str
    style_names: tuple[str, ...]
    styles: Any
    """All styles stacked: a pytree with leading axis [style]."""
    event_names: tuple[str, ...]
    """Names of the events of one player, in the order of `TimeStep.events`' last axis."""
    num_actions: Pair
    continuous: bool
    """Whether an action is a vector of `num_actions` numbers from -1 to 1, not one of as many."""
    compiler_options: dict[str, Any]
    """What XLA must be told to compile programs with this environment well; see `jax.jit`."""
    success_event: str | None
    """The event that happens once in a game that succeeds; None where games only earn a return."""
    observation_sizes: Pair
    max_steps: int
    symmetries: tuple[Symmetry, ...]
    """Mirrors in which the partner of one style plays as one of another style would."""
    task_language_source: Literal["events", "labels"]
    """What the task language is made of: frequencies of events (Eq. 8), or encodings of the
    style's label where events do not tell the styles apart (App. D)."""

    def style(self, name: str) -> Any:
        """Returns one style. Raises ValueError for an unknown name."""
        ...

    def upper_bounds(self) -> dict[str, float]:
        """Returns a return for each style that no two players can exceed."""
        ...

    def reset(self, key: jax.Array, style: Any) -> tuple[Any, TimeStep]:
        """Starts a game; consumes `key`."""
        ...

    def training_reset(
        self, key: jax.Array, style: Any, random_share: jax.Array | float
    ) -> tuple[Any, TimeStep]:
        """Starts a game or, with chance `random_share`, goes on from a random moment of one.

        Training only; an environment without such moments does what `reset` does.
        """
        ...

    def confine(self, style: Any) -> Any:
        """Returns the style with the ego held to its intended role: a curriculum for training."""
        ...

    def step(self, key: jax.Array, state: Any, actions: Pair, style: Any) -> tuple[Any, TimeStep]:
        """Plays one step; consumes `key`."""
        ...


def pick_style(env: Any, name: str) -> Any:
    """Returns one of an environment's styles; ValueError for an unknown name."""
    if name not in env.style_names:
        raise ValueError(
            f"unknown style {name!r} of {env.name}; expected one of {', '.join(env.style_names)}"
        )
    index = env.style_names.index(name)
    return jax.tree.map(lambda leaf: leaf[index], env.styles)


def check_partner_sight(sight: int | None) -> None:
    """Raises ValueError unless `sight` is a distance in cells, or None for everywhere."""
    if sight is not None and sight < 0:
        raise ValueError(f"partner_sight is {sight}; expected 0 or more, or None")


class DrawnEnvironment(Environment, Protocol):
    """An environment that can be drawn: what `envs.make` returns."""

    @property
    def viewer(self) -> ModuleType:
        """Module with `draw_state(env, state, …)`, `save_gif(path, env, states, …)`, `save_png`.

        Where people can play (actions are keys), also `draw_board(env, state, …)`: the game alone.
        """
        ...
