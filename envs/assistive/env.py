"""The assistive arm: a robot helps a person who moves, and neither can do it alone."""

import dataclasses
import functools
from types import ModuleType
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode
from jax.core import Tracer

from envs.assistive import control, events, model, observation, physics, reward, styles, tasks
from envs.assistive.physics import Physics, Poses
from envs.assistive.reward import RewardWeights, ShapingWeights
from envs.assistive.styles import RULES, TASKS, Style
from envs.assistive.tasks import Aim, Progress, Target
from envs.base import Pair, Symmetry, TimeStep, pick_style

TOOLS = ("universal", "per_task")
START_SPREAD = 0.08
"""Standard deviation of the joints' angles at a game's start, rad."""
LARGEST_SEAT_SPREAD = 0.2
"""Beyond which the robot could not reach the person everywhere, m."""
LARGEST_POSTURE_SPREAD = 0.13
"""Beyond which some persons could not lift the arm far enough to present it, rad."""
RANDOM_SPREAD = 0.4
"""The same of the robot's at a random moment of a game (training only)."""


class State(PyTreeNode):
    """A moment of a game.

    Attributes:
        body: arm and person.
        aim: what was drawn at the start.
        progress: of the task.
        tool: where the tool's tip is, m [3].
        effort: how far the person is from presenting the target, about rad [].
        habit: by how much the joints' ranges are shifted in this game, rad [joint].
        time: steps taken, int32 [].
    """

    body: Physics
    aim: Aim
    progress: Progress
    tool: jax.Array
    effort: jax.Array
    habit: jax.Array
    time: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Assistive:
    """A Jaco arm and a seated person.

    Attributes:
        max_steps: steps of a game, 0.1 s each.
        tasks: which of scratch, bathe, feed and drink there are.
        reveal_target: also show the ego where the target lies.
        tool: `universal`, one tool for all tasks, or `per_task`, which tells the ego by the tool
            in its hand what the task is. Assistive Gym has this and `reveal_target`.
        seat_spread: how far the person may sit from the usual place in each direction, m; drawn
            for each game. Without it players learn motions by heart.
        posture_spread: how far the ranges of the person's joints may be shifted, rad; drawn for
            each game. Without it an ego knows only the posture that its own partner prefers.
        still: `ego` or `partner`, whose actions then count for nothing, to learn what the other
            one can do alone: its joints go to their home and stay there, also where they are
            pushed; None where both act.
        reward: weights of the reward's terms.
        shaping: weights of the shaped reward.
    """

    max_steps: int = 200
    tasks: tuple[str, ...] = TASKS
    reveal_target: bool = False
    tool: Literal["universal", "per_task"] = "universal"
    seat_spread: float = 0.05
    posture_spread: float = 0.09
    still: Literal["ego", "partner"] | None = None
    reward: RewardWeights = dataclasses.field(default_factory=RewardWeights)
    shaping: ShapingWeights = dataclasses.field(default_factory=ShapingWeights)
    name: ClassVar[str] = "assistive/jaco"
    symmetries: ClassVar[tuple[Symmetry, ...]] = ()
    continuous: ClassVar[bool] = True
    success_event: ClassVar[str | None] = events.SUCCESS
    task_language_source: ClassVar[Literal["events", "labels"]] = "labels"

    def __post_init__(self):
        unknown = [task for task in self.tasks if task not in TASKS]
        if unknown or not self.tasks:
            what = repr(unknown[0]) if unknown else "nothing"
            raise ValueError(f"tasks has {what}; expected some of {', '.join(TASKS)}")
        if self.tool not in TOOLS:
            raise ValueError(f"tool is {self.tool!r}; expected one of {', '.join(TOOLS)}")
        if self.still not in (None, *Pair._fields):
            raise ValueError(f"still is {self.still!r}; expected ego, partner or None")
        if not 0.0 <= self.seat_spread <= LARGEST_SEAT_SPREAD:
            raise ValueError(
                f"seat_spread is {self.seat_spread}; expected 0 to {LARGEST_SEAT_SPREAD} m"
            )
        if not 0.0 <= self.posture_spread <= LARGEST_POSTURE_SPREAD:
            raise ValueError(
                f"posture_spread is {self.posture_spread}; expected 0 to "
                f"{LARGEST_POSTURE_SPREAD} rad"
            )
        if self.max_steps < 1:
            raise ValueError(f"max_steps is {self.max_steps}; expected at least 1")

    @property
    def compiler_options(self) -> dict[str, Any]:
        """On a CPU XLA's fusion makes a chain of joints a thousand times slower."""
        on_cpu = jax.default_backend() == "cpu"
        return {"xla_cpu_use_fusion_emitters": False} if on_cpu else {}

    @property
    def style_names(self) -> tuple[str, ...]:
        """Names of the partner styles."""
        return styles.style_names(self.tasks)

    @functools.cached_property
    def styles(self) -> Style:
        """All styles stacked, leading axis [style]."""
        # The first use may be inside a compiled function, whose values must not be kept.
        with jax.ensure_compile_time_eval():
            return styles.all_styles(self.tasks)

    def style(self, name: str) -> Style:
        """Returns one style; ValueError for an unknown name."""
        return pick_style(self, name)

    def upper_bounds(self) -> dict[str, float]:
        """Returns the bonus that each style pays at most; every other term costs something."""
        most = {
            "scratch": self.max_steps,
            "bathe": tasks.STEPS_OF_BATHING,
            "feed": tasks.PORTIONS,
            "drink": tasks.UNITS,
        }
        return {
            name: self.reward.task * tasks.BONUS[RULES[name].task] * most[RULES[name].task]
            for name in self.style_names
        }

    @staticmethod
    def confine(style: Style) -> Style:
        """Returns the style as it is: the robot has no role to be held to."""
        return style

    @property
    def event_names(self) -> tuple[str, ...]:
        """Names of one player's events."""
        return events.NAMES

    @property
    def num_actions(self) -> Pair:
        """Numbers in each player's action: speeds of its joints, -1 to 1."""
        return Pair(len(model.ARM), len(model.PERSON))

    @property
    def observation_sizes(self) -> Pair:
        """Number of values in each player's observation."""
        players = (self.feature_slices("ego"), self.feature_slices("partner"))
        return Pair(*(max(part.stop for part in player.values()) for player in players))

    def feature_slices(self, player: str) -> dict[str, slice]:
        """Where the named parts of a player's observation lie; `player` is `ego` or `partner`."""
        return observation.feature_slices(
            player, reveal_target=self.reveal_target, tool_kind=self.tool == "per_task"
        )

    @property
    def viewer(self) -> ModuleType:
        """The module that draws arm and person; imported on first use."""
        from envs.assistive import viewer

        return viewer

    def reset(self, key: jax.Array, style: Style) -> tuple[State, TimeStep]:
        """Starts a game: arm and person near their home, the target drawn.

        Args:
            key: consumed.
            style: the partner's style; what the robot sees of the start does not depend on it.
        """
        angle_key, person_key, aim_key = jax.random.split(key, 3)
        noise = START_SPREAD * jax.random.normal(angle_key, (len(model.JOINTS),))
        angles = jnp.asarray(model.HOME) + noise
        return self._shown(self._begin(angles, person_key, aim_key, style), style)

    def training_reset(
        self, key: jax.Array, style: Style, random_share: jax.Array | float
    ) -> tuple[State, TimeStep]:
        """Starts a game, or goes on from a random moment of one; consumes `key`.

        At such a moment the robot's joints are around their home, the person's somewhere between
        home and a random place in the style's ranges, some of the time is over, and an arm is
        bathed in part.
        """
        share_key, angle_key, moment_key, person_key, aim_key = jax.random.split(key, 5)
        random = jax.random.uniform(share_key) < random_share
        time_key, done_key, robot_key, pose_key, depth_key = jax.random.split(moment_key, 5)
        robot = RANDOM_SPREAD * jax.random.normal(robot_key, (len(model.ARM),))
        lowest, highest = style.ranges[len(model.ARM) :].T
        person = jax.random.uniform(pose_key, lowest.shape, minval=lowest, maxval=highest)
        home = jnp.asarray(model.HOME)
        depth = jax.random.uniform(depth_key)
        anywhere = jnp.concatenate([robot, depth * (person - home[len(model.ARM) :])])
        nearby = START_SPREAD * jax.random.normal(angle_key, (len(model.JOINTS),))
        state = self._begin(home + jnp.where(random, anywhere, nearby), person_key, aim_key, style)
        time = jax.random.randint(time_key, (), 0, 3 * self.max_steps // 4)
        done = jax.random.randint(done_key, (), 0, tasks.STEPS_OF_BATHING)
        state = state.replace(
            time=jnp.where(random, time, 0),
            progress=state.progress.replace(
                done=jnp.where(random & tasks.is_bathing(style), done, 0),
                reached=jnp.where(random & tasks.is_bathing(style), done, 0),
            ),
        )
        return self._shown(state, style)

    def step(
        self, key: jax.Array, state: State, actions: Pair, style: Style
    ) -> tuple[State, TimeStep]:
        """Plays one step of 0.1 s.

        Args:
            key: unused; a game is deterministic once it has started.
            state: the state before.
            actions: speeds of each player's joints, float32 [7] and [6]; -1 to 1, clipped.
            style: the partner's style.

        Raises:
            ValueError: actions of another shape, or, outside of compiled functions, actions that
                are not finite.
        """
        del key
        self._check_actions(actions)
        if self.still is not None:
            home = Pair(*jnp.split(control.speeds_back_home(state.body), [len(model.ARM)]))
            actions = actions._replace(**{self.still: getattr(home, self.still)})
        wanted = jnp.clip(jnp.concatenate([actions.ego, actions.partner]), -1.0, 1.0)
        ranges = style.ranges + state.habit[:, None]
        velocities = control.velocities(state.body, wanted, ranges)
        body = physics.step(state.body, velocities)
        poses = physics.poses(body)
        target = tasks.find_target(poses, style, state.aim, state.progress)
        outcome = tasks.advance(style, poses, body, target, state.progress)
        terms = reward.reward_terms(
            weights=self.reward,
            style=style,
            body=body,
            poses=poses,
            target=target,
            outcome=outcome,
            actions=wanted,
            tool_speed=jnp.linalg.norm(poses.tool - state.tool) / model.CONTROL_SECONDS,
        )
        following = tasks.find_target(poses, style, state.aim, outcome.progress)
        after = State(
            body=body,
            aim=state.aim,
            progress=outcome.progress,
            tool=poses.tool,
            effort=following.effort,
            habit=state.habit,
            time=state.time + 1,
        )
        shown = self.shaping.present * (state.effort - following.effort)
        shown -= self.shaping.hold * following.effort
        tilted = -self.shaping.level * tasks.tilt_error(style, poses, target)
        timestep = TimeStep(
            observation=self._observe(after, poses, following, style),
            reward=sum(terms.values(), start=jnp.zeros(())),
            shaped_reward=jnp.stack([tilted, shown]),
            terminated=jnp.zeros((), bool),
            truncated=after.time >= self.max_steps,
            events=events.count_events(style, body, poses, target, outcome),
        )
        return after, timestep

    def _check_actions(self, actions: Pair) -> None:
        for name, action, size in zip(Pair._fields, actions, self.num_actions, strict=True):
            if jnp.shape(action) != (size,):
                raise ValueError(
                    f"the {name}'s action has shape {jnp.shape(action)}; expected ({size},), the "
                    "speeds of its joints"
                )
            if not isinstance(action, Tracer) and not np.isfinite(action).all():
                raise ValueError(f"the {name}'s action is {action}; expected finite numbers")

    def _begin(
        self, angles: jax.Array, person_key: jax.Array, aim_key: jax.Array, style: Style
    ) -> State:
        """A game that begins at rest; `_shown` fills in what follows from the angles."""
        habit_key, seat_key = jax.random.split(person_key)
        habit = jax.random.uniform(habit_key, (len(model.PERSON),), minval=-1.0, maxval=1.0)
        seat = jax.random.uniform(seat_key, (3,), minval=-1.0, maxval=1.0)
        return State(
            body=physics.at_rest(angles, self.seat_spread * seat),
            aim=tasks.draw_aim(aim_key),
            progress=tasks.first_progress(style),
            tool=jnp.zeros(3),
            effort=jnp.zeros(()),
            habit=jnp.concatenate([jnp.zeros(len(model.ARM)), self.posture_spread * habit]),
            time=jnp.zeros((), jnp.int32),
        )

    def _shown(self, state: State, style: Style) -> tuple[State, TimeStep]:
        """A game at rest, with what follows from the angles, as both players see it."""
        poses = physics.poses(state.body)
        target = tasks.find_target(poses, style, state.aim, state.progress)
        state = state.replace(tool=poses.tool, effort=target.effort)
        return state, TimeStep.first(
            self._observe(state, poses, target, style), len(self.event_names)
        )

    def _observe(self, state: State, poses: Poses, target: Target, style: Style) -> Pair:
        ego = observation.ego_features(state.body, poses)
        if self.reveal_target:
            ego = jnp.concatenate([ego, observation.target_features(poses, target)])
        if self.tool == "per_task":
            ego = jnp.concatenate([ego, jnp.eye(len(TASKS))[style.task]])
        share = 1.0 / tasks.success_counts()[style.task]
        partner = observation.partner_features(
            state.body, poses, target, state.progress, share, style
        )
        return Pair(ego, partner)


def make_assistive(robot: str, **options: Any) -> Assistive:
    """Makes an environment with an assistive robot.

    Args:
        robot: `jaco`.
        options: see `Assistive`.

    Raises:
        ValueError: an unknown robot, option, or an option's value.
    """
    known = [field.name for field in dataclasses.fields(Assistive)]
    unknown = [name for name in options if name not in known]
    if robot != "jaco" or unknown:
        what, names = ("robot", ["jaco"]) if robot != "jaco" else ("option", known)
        wrong = robot if robot != "jaco" else unknown[0]
        raise ValueError(
            f"unknown {what} {wrong!r} of assistive; expected one of {', '.join(names)}"
        )
    return Assistive(**options)
