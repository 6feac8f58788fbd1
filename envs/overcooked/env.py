"""Overcooked as an environment of two players: wires rules, rewards, events and styles."""

import dataclasses
import functools
from types import ModuleType
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from envs.base import Pair, Symmetry, TimeStep, check_partner_sight, pick_style
from envs.overcooked import dynamics, events, layouts, moments, observation, reward, styles
from envs.overcooked.dynamics import State, Transition
from envs.overcooked.layouts import Layout
from envs.overcooked.reward import ShapingWeights
from envs.overcooked.styles import Style
from envs.overcooked.symmetry import find_symmetries


@dataclasses.dataclass(frozen=True, eq=False)
class Overcooked:
    """A kitchen for an ego and a partner.

    Attributes:
        layout: the kitchen.
        max_steps: steps of a game.
        dynamics: `new`: a player starts the pot; `old`: a pot with three ingredients starts
            by itself, and only so.
        encoding: `features`, a flat vector, or `grid`, overcooked-ai's lossless encoding.
        shaping: `guided`, ours, or `reference`, overcooked-ai's.
        partner_sight: columns and rows up to which the ego sees the partner; None sees it
            everywhere.
    """

    layout: Layout
    max_steps: int = 400
    dynamics: Literal["new", "old"] = "new"
    encoding: Literal["features", "grid"] = "features"
    shaping: Literal["guided", "reference"] = "guided"
    partner_sight: int | None = None
    weights: ShapingWeights = dataclasses.field(default_factory=ShapingWeights)
    continuous: ClassVar[bool] = False
    compiler_options: ClassVar[dict[str, Any]] = {}
    success_event: ClassVar[str | None] = None
    task_language_source: ClassVar[Literal["events", "labels"]] = "events"

    def __post_init__(self):
        for name, options in (
            ("dynamics", ("new", "old")),
            ("encoding", ("features", "grid")),
            ("shaping", ("guided", "reference")),
        ):
            value = getattr(self, name)
            if value not in options:
                raise ValueError(f"{name} is {value!r}; expected one of {', '.join(options)}")
        check_partner_sight(self.partner_sight)
        if self.max_steps <= 50:
            raise ValueError(f"max_steps is {self.max_steps}; expected more than 50")

    @property
    def name(self) -> str:
        """The registry's name."""
        return f"overcooked/{self.layout.name}"

    @functools.cached_property
    def style_names(self) -> tuple[str, ...]:
        """Names of the partner styles."""
        return tuple(styles.style_rules(self.layout))

    @functools.cached_property
    def styles(self) -> Style:
        """All styles stacked, leading axis [style]."""
        rules = styles.style_rules(self.layout).values()
        # The first use may be inside a compiled function, whose values must not be kept.
        with jax.ensure_compile_time_eval():
            built = [
                styles.build_style(self.layout, rule, max_steps=self.max_steps) for rule in rules
            ]
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *built)

    @functools.cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Mirrors of the kitchen and its styles; none are known for the grid encoding."""
        if self.encoding == "grid":
            return ()
        return find_symmetries(self.layout, self.styles)

    def style(self, name: str) -> Style:
        """Returns one style; ValueError for an unknown name."""
        return pick_style(self, name)

    def upper_bounds(self) -> dict[str, float]:
        """Returns a return for each style that no two players can exceed; takes seconds."""
        # Only who asks for bounds waits for the solver's import.
        from envs.overcooked.bounds import upper_bound

        old = self.dynamics == "old"
        return {
            name: upper_bound(
                self.layout, self.style(name), max_steps=self.max_steps, old_dynamics=old
            )
            for name in self.style_names
        }

    @staticmethod
    def confine(style: Style) -> Style:
        """Returns the style with the ego held to its role (training only)."""
        return styles.confine(style)

    @functools.cached_property
    def event_table(self) -> events.EventTable:
        """Which events the kitchen knows."""
        return events.build_event_table(self.layout)

    @property
    def event_names(self) -> tuple[str, ...]:
        """Names of one player's events."""
        return self.event_table.names

    @property
    def num_actions(self) -> Pair:
        """Number of actions of each player: four ways, stay, interact."""
        return Pair(dynamics.NUM_ACTIONS, dynamics.NUM_ACTIONS)

    @property
    def observation_sizes(self) -> Pair:
        """Length of each player's feature vector; the partner's ends with its task."""
        size = observation.num_features(self.layout)
        return Pair(size, size + self.styles.task.shape[-1])

    @property
    def viewer(self) -> ModuleType:
        """The module that draws the kitchen; imported on first use, since play never needs it."""
        from envs.overcooked import viewer

        return viewer

    def reset(self, key: jax.Array, style: Style) -> tuple[State, TimeStep]:
        """Starts a game in the empty kitchen.

        Args:
            key: unused; the start is the same in every game.
            style: the partner's style.
        """
        del key
        state = dynamics.start_state(self.layout, style.start)
        return state, self._first(state, style)

    def training_reset(
        self, key: jax.Array, style: Style, random_share: jax.Array | float
    ) -> tuple[State, TimeStep]:
        """Starts a game, or goes on from a random moment of one.

        Args:
            key: consumed.
            style: the partner's style.
            random_share: chance of a moment drawn from the style's pool, 0 to 1.
        """
        # Element 0 of the pool is the usual start; one draw decides whether and where.
        drawn = jax.random.uniform(key) / jnp.maximum(random_share, 1e-6)
        index = jnp.where(drawn < 1, 1 + (drawn * (moments.POOL_SIZE - 1)).astype(jnp.int32), 0)
        state = jax.tree.map(lambda leaf: leaf[index], style.pool)
        return state, self._first(state, style)

    def step(
        self, key: jax.Array, state: State, actions: Pair, style: Style
    ) -> tuple[State, TimeStep]:
        """Plays one step.

        Args:
            key: unused; the kitchen is deterministic.
            state: the state before.
            actions: int32 [] of each player: 0 north, 1 south, 2 east, 3 west, 4 stay,
                5 interact.
            style: the partner's style.
        """
        del key
        transition = dynamics.step(
            self.layout,
            state,
            jnp.stack([actions.ego, actions.partner]),
            cells=style.cells,
            targets=style.targets,
            old_dynamics=self.dynamics == "old",
        )
        after = transition.after
        paid = reward.delivery_reward(self.layout, transition.interactions, style.pays)
        timestep = TimeStep(
            observation=self._observe(after, style),
            reward=jnp.sum(paid),
            shaped_reward=self._shaped_reward(transition, style),
            terminated=jnp.zeros((), bool),
            truncated=after.time >= self.max_steps,
            events=events.count_events(self.event_table, transition),
        )
        return after, timestep

    def _first(self, state: State, style: Style) -> TimeStep:
        return TimeStep.first(self._observe(state, style), len(self.event_names))

    def _observe(self, state: State, style: Style) -> Pair:
        observe = observation.grid if self.encoding == "grid" else observation.features
        ego, partner = (
            observe(self.layout, state, agent, self.max_steps, sight)
            for agent, sight in ((0, self.partner_sight), (1, None))
        )
        if self.encoding == "grid":
            return Pair(ego, partner)
        return Pair(ego, jnp.concatenate([partner, style.task]))

    def _shaped_reward(self, transition: Transition, style: Style) -> jax.Array:
        if self.shaping == "reference":
            return reward.reference_shaping(self.layout, transition)
        terms = reward.guided_shaping_terms(
            self.layout,
            transition,
            pays=style.pays,
            hand_over=style.hand_over,
            welcome=style.welcome,
            way=style.way,
            weights=self.weights,
        )
        return sum(terms.values(), start=jnp.zeros(2))


def make_overcooked(kitchen: str, **options) -> Overcooked:
    """Makes the environment of a kitchen that comes with the package.

    Args:
        kitchen: name of the kitchen, such as `crossway`.
        options: see `Overcooked`.
    """
    return Overcooked(layout=layouts.load_layout(kitchen), **options)
