"""Spread: eight foods around a field, of which the style's alone pays."""

import dataclasses
import functools
from types import ModuleType
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from envs.base import Pair, Symmetry, TimeStep, check_partner_sight, pick_style
from envs.lbf import dynamics, events, features, observation, reward, spread, styles
from envs.lbf.dynamics import Rules, State
from envs.lbf.reward import ShapingWeights
from envs.lbf.styles import Style

ENCODINGS = ("features", "grid", "flat")


@dataclasses.dataclass(frozen=True, eq=False)
class Spread:
    """Level-based foraging for an ego and a partner who must load together.

    Attributes:
        max_steps: steps of a game.
        sight: cells that a player sees in each direction; None sees the whole field.
        encoding: `features`, a vector for small MLPs; `flat`, lbforaging's vector; or `grid`,
            lbforaging's layers, to which the partner's adds one that marks the target.
        partner_sight: rows and columns up to which the ego sees the partner, with `features`
            only; None sees it as far as `sight` goes.
        weights: worth of the shaped reward's terms.
    """

    max_steps: int = 50
    sight: int | None = None
    encoding: Literal["features", "grid", "flat"] = "features"
    partner_sight: int | None = None
    weights: ShapingWeights = dataclasses.field(default_factory=ShapingWeights)
    name: ClassVar[str] = "lbf/spread"
    rows: ClassVar[int] = spread.SIZE
    columns: ClassVar[int] = spread.SIZE
    symmetries: ClassVar[tuple[Symmetry, ...]] = ()
    continuous: ClassVar[bool] = False
    compiler_options: ClassVar[dict[str, Any]] = {}
    success_event: ClassVar[str | None] = None
    task_language_source: ClassVar[Literal["events", "labels"]] = "labels"

    def __post_init__(self):
        if self.encoding not in ENCODINGS:
            raise ValueError(
                f"encoding is {self.encoding!r}; expected one of {', '.join(ENCODINGS)}"
            )
        check_partner_sight(self.partner_sight)
        if self.partner_sight is not None and self.encoding != "features":
            raise ValueError(
                f"partner_sight is {self.partner_sight} with encoding {self.encoding!r}; expected "
                "encoding 'features', or no partner_sight"
            )
        if self.rules.max_steps < spread.LEAST_TIME_LEFT:
            raise ValueError(
                f"max_steps is {self.max_steps}; expected at least {spread.LEAST_TIME_LEFT}"
            )

    @functools.cached_property
    def rules(self) -> Rules:
        """The engine's rules for this game."""
        return Rules(
            rows=self.rows,
            columns=self.columns,
            max_steps=self.max_steps,
            sight=self.sight,
            normalize_reward=False,
            all_must_load=True,
        )

    @property
    def style_names(self) -> tuple[str, ...]:
        """Names of the partner styles: `level_1` to `level_8`."""
        return styles.style_names(spread.NUM_FOODS)

    @functools.cached_property
    def styles(self) -> Style:
        """All styles stacked, leading axis [style]."""
        # The first use may be inside a compiled function, whose values must not be kept.
        with jax.ensure_compile_time_eval():
            return styles.all_styles(spread.NUM_FOODS)

    def style(self, name: str) -> Style:
        """Returns one style; ValueError for an unknown name."""
        return pick_style(self, name)

    def upper_bounds(self) -> dict[str, float]:
        """Returns 1 for each style: the target pays once and ends the game."""
        return dict.fromkeys(self.style_names, 1.0)

    @staticmethod
    def confine(style: Style) -> Style:
        """Returns the style as it is: the ego of Spread has no role to be held to."""
        return style

    @property
    def event_names(self) -> tuple[str, ...]:
        """Names of one player's events."""
        return events.event_names(spread.NUM_FOODS, spread.PLACE_NAMES)

    @property
    def num_actions(self) -> Pair:
        """Number of actions of each player: none, four ways, load."""
        return Pair(dynamics.NUM_ACTIONS, dynamics.NUM_ACTIONS)

    @property
    def observation_sizes(self) -> Pair:
        """Number of values in each player's observation; a partner's vector ends with its task."""
        if self.encoding == "grid":
            cells = (2 * self.rules.reach + 1) ** 2
            layers = len(observation.GRID_LAYERS)
            return Pair(layers * cells, (layers + 1) * cells)
        size = features.num_features(spread.NUM_FOODS)
        if self.encoding == "flat":
            size = observation.flat_size(2, spread.NUM_FOODS)
        return Pair(size, size + spread.NUM_FOODS)

    @property
    def viewer(self) -> ModuleType:
        """The module that draws the field; imported on first use, since play never needs it."""
        from envs.lbf import viewer

        return viewer

    def reset(self, key: jax.Array, style: Style) -> tuple[State, TimeStep]:
        """Starts a game: draws the foods' places and the players' cells near the centre.

        Args:
            key: consumed.
            style: the partner's style; the start does not depend on it.
        """
        state = spread.start_state(key)
        return state, self._first(state, style)

    def training_reset(
        self, key: jax.Array, style: Style, random_share: jax.Array | float
    ) -> tuple[State, TimeStep]:
        """Starts a game, or goes on from a random moment of one.

        Args:
            key: consumed.
            style: the partner's style, whose target is always there.
            random_share: chance of a random moment, 0 to 1.
        """
        choice_key, start_key, moment_key = jax.random.split(key, 3)
        start = spread.start_state(start_key)
        moment = spread.random_moment(moment_key, start, style.target, self.max_steps)
        chosen = jax.random.uniform(choice_key) < random_share
        state = jax.tree.map(lambda new, usual: jnp.where(chosen, new, usual), moment, start)
        return state, self._first(state, style)

    def step(
        self, key: jax.Array, state: State, actions: Pair, style: Style
    ) -> tuple[State, TimeStep]:
        """Plays one step.

        Args:
            key: unused; the game is deterministic once it has started.
            state: the state before.
            actions: int32 [] of each player: 0 none, 1 north, 2 south, 3 west, 4 east, 5 load.
            style: the partner's style.
        """
        del key
        both = jnp.stack([actions.ego, actions.partner])
        transition = dynamics.step(self.rules, state, both)
        after = transition.after
        paid = reward.team_reward(transition, style.target)
        terms = reward.shaping_terms(transition, style.target, self.weights)
        timestep = TimeStep(
            observation=self._observe(after, style),
            reward=paid,
            shaped_reward=sum(terms.values(), start=jnp.zeros(2)),
            terminated=paid > 0,
            truncated=dynamics.time_is_up(self.rules, after),
            events=events.count_events(spread.PLACES, transition),
        )
        return after, timestep

    def _first(self, state: State, style: Style) -> TimeStep:
        return TimeStep.first(self._observe(state, style), len(self.event_names))

    def _observe(self, state: State, style: Style) -> Pair:
        if self.encoding == "grid":
            ego, partner = observation.grid(self.rules, state)
            return Pair(ego, jnp.concatenate([partner, self._target_layer(partner, style)]))
        if self.encoding == "flat":
            ego, partner = observation.flat(self.rules, state).astype(jnp.float32)
        else:
            ego, partner = features.features(self.rules, state, self.partner_sight)
        return Pair(ego, jnp.concatenate([partner, style.task]))

    @staticmethod
    def _target_layer(layers: jax.Array, style: Style) -> jax.Array:
        foods = layers[observation.GRID_LAYERS.index("foods")]
        return (foods == style.target).astype(layers.dtype)[None]


def make_lbf(game: str, **options: Any) -> Spread:
    """Makes a game of level-based foraging.

    Args:
        game: `spread`.
        options: see `Spread`.

    Raises:
        ValueError: an unknown game, option, or an option's value.
    """
    known = [field.name for field in dataclasses.fields(Spread)]
    unknown = [name for name in options if name not in known]
    if game != "spread" or unknown:
        what, names = ("game", ["spread"]) if game != "spread" else ("option", known)
        wrong = game if game != "spread" else unknown[0]
        raise ValueError(f"unknown {what} {wrong!r} of lbf; expected one of {', '.join(names)}")
    return Spread(**options)
