"""An environment as a PettingZoo parallel environment (pettingzoo 1.25 or later).

PettingZoo is not among this package's dependencies: install `pettingzoo` to import this module.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from pettingzoo import ParallelEnv

from envs.base import AGENTS, Environment, Pair, TimeStep

FrameFn = Callable[[Any, Any], np.ndarray]


class PettingZooEnvironment(ParallelEnv[str, np.ndarray, int]):
    """A two-player environment for code written for PettingZoo; the agents are `ego` and `partner`.

    Each reset draws the partner's style from `style_names`, or takes the one in
    `options={"style": name}`. The name is in the partner's info only: the ego does not know it.
    The reward is the team's, the same for both agents; `infos[agent]` holds `shaped_reward` and,
    by name, the `events` of the last step.

    Args:
        environment: an environment with discrete actions, such as `registry.make` returns.
        style_names: styles to draw from; all of the environment's by default.
        render_mode: None or "rgb_array".
        frame_fn: draws (state, style) as uint8 [height, width, 3]; by default the environment's
            `viewer` does.

    Raises:
        ValueError: continuous actions, no style, an unknown style, an unknown render mode, or no
            `frame_fn` for it.
    """

    def __init__(
        self,
        environment: Environment,
        style_names: Sequence[str] | None = None,
        *,
        render_mode: str | None = None,
        frame_fn: FrameFn | None = None,
    ):
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
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; expected None or 'rgb_array'")
        if frame_fn is None and hasattr(environment, "viewer"):
            frame_fn = _viewers_frame_fn(environment)
        if render_mode is not None and frame_fn is None:
            raise ValueError(f"{environment.name} needs a frame_fn to be rendered")
        self.environment = environment
        self.style_names = chosen
        self.render_mode = render_mode
        self.metadata = {
            "name": environment.name,
            "render_modes": ["rgb_array"],
            "render_fps": 8,
            "is_parallelizable": True,
        }
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._frame_fn = frame_fn
        self._reset = jax.jit(environment.reset)
        self._step = jax.jit(environment.step)
        self._key = jax.random.key(int(np.random.default_rng().integers(2**31)))
        self._state: Any = None
        self._use_style(chosen[0])
        _, timestep = jax.eval_shape(environment.reset, self._key, self._style)
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(-np.inf, np.inf, seen.shape, np.float32)
            for agent, seen in zip(AGENTS, timestep.observation, strict=True)
        }
        self.num_actions = dict(zip(AGENTS, environment.num_actions, strict=True))
        self.action_spaces: dict[str, gymnasium.spaces.Space] = {
            agent: gymnasium.spaces.Discrete(count) for agent, count in self.num_actions.items()
        }

    def observation_space(self, agent: str) -> gymnasium.spaces.Space:
        """The space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Space:
        """The space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        """Starts a game.

        Args:
            seed: makes this game and those after it repeatable.
            options: `style`, the name of the partner's style; other entries are not used.

        Raises:
            ValueError: an unknown style.
        """
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, style_key, reset_key = jax.random.split(self._key, 3)
        drawn = int(jax.random.randint(style_key, (), 0, len(self.style_names)))
        self._use_style((options or {}).get("style", self.style_names[drawn]))
        self._state, timestep = self._reset(reset_key, self._style)
        self.agents = list(AGENTS)
        return self._observations(timestep), self._infos(timestep)

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict]
    ]:
        """Plays one step; at the end of the game both agents leave.

        Raises:
            ValueError: an agent without an action, or an action that does not exist.
            RuntimeError: no game is on.
        """
        if not self.agents:
            raise RuntimeError("no game is on: call reset first")
        for agent in AGENTS:
            if agent not in actions or not self.action_spaces[agent].contains(actions[agent]):
                raise ValueError(
                    f"actions[{agent!r}] must be an integer in [0, "
                    f"{self.num_actions[agent]}), got {actions.get(agent)!r}"
                )
        self._key, step_key = jax.random.split(self._key)
        pair = Pair(*(np.int32(actions[agent]) for agent in AGENTS))
        self._state, timestep = self._step(step_key, self._state, pair, self._style)
        if bool(timestep.done):
            self.agents = []
        return (
            self._observations(timestep),
            dict.fromkeys(AGENTS, float(timestep.reward)),
            dict.fromkeys(AGENTS, bool(timestep.terminated)),
            dict.fromkeys(AGENTS, bool(timestep.truncated)),
            self._infos(timestep),
        )

    def render(self) -> np.ndarray | None:
        """Returns a picture of the game, uint8 [height, width, 3]; None without a render mode.

        Raises:
            RuntimeError: no game was started.
        """
        if self.render_mode is None or self._frame_fn is None:
            return None
        if self._state is None:
            raise RuntimeError("there is nothing to render: call reset first")
        return self._frame_fn(self._state, self._style)

    def close(self) -> None:
        """Ends the game."""
        self.agents = []

    def _use_style(self, name: str) -> None:
        self._style = self.environment.style(name)
        self._style_name = name

    @staticmethod
    def _observations(timestep: TimeStep) -> dict[str, np.ndarray]:
        pairs = zip(AGENTS, timestep.observation, strict=True)
        return {agent: np.asarray(seen, np.float32) for agent, seen in pairs}

    def _infos(self, timestep: TimeStep) -> dict[str, dict]:
        shaped, events = np.asarray(timestep.shaped_reward), np.asarray(timestep.events)
        names = self.environment.event_names
        infos: dict[str, dict] = {
            agent: {
                "shaped_reward": float(shaped[index]),
                "events": {names[k]: float(events[index, k]) for k in events[index].nonzero()[0]},
            }
            for index, agent in enumerate(AGENTS)
        }
        infos["partner"]["style"] = self._style_name
        return infos


def _viewers_frame_fn(environment: Any) -> FrameFn:
    def draw(state: Any, style: Any) -> np.ndarray:
        viewer = environment.viewer
        return viewer.to_array(viewer.draw_state(environment, state, style=style))

    return draw
