"""An environment with continuous actions as a `brax.envs.Env`, the ego alone as its agent.

The partner is part of the world: a frozen policy of some style. So Brax's own learners train a
best response to it:

    env = BraxEnvironment(envs.make("assistive/jaco"), "feed_left", partner)
    make_policy, params, _ = brax.training.agents.ppo.train.train(env, episode_length=200, ...)

On a CPU set `XLA_FLAGS=--xla_cpu_use_fusion_emitters=false` before the first computation, since
Brax compiles by itself and takes no options: XLA's fusion otherwise makes the arm a thousand times
slower (`Assistive.compiler_options`).

Brax's own wrapper starts a finished game again as it first began, drawn numbers included; see
`wrap` for one that starts a new game:

    train(env, wrap_env_fn=envs.adapters.brax.wrap, ...)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from envs.base import Environment, Pair, TimeStep
from envs.quiet import no_word_of_warp

with no_word_of_warp():
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers import training

Partner = Callable[[jax.Array, jax.Array], jax.Array]
"""From a key and the partner's observation [O] to its action [A]."""


class World(PyTreeNode):
    """What a Brax state carries of ours.

    Attributes:
        state: the environment's state.
        partner_sees: the partner's observation, float32 [O].
        key: never consumed; folded with the time.
        time: steps taken, int32 [].
    """

    state: Any
    partner_sees: jax.Array
    key: jax.Array
    time: jax.Array


class BraxEnvironment(Env):
    """An environment for code written for Brax; the agent is the ego.

    `metrics` holds how often each event of the ego happened in the step. A game's time is kept
    by Brax's episode wrapper, so `done` is 1 only where the task ended by its own rules.

    Args:
        environment: an environment with continuous actions.
        style: name of the partner's style.
        partner: what the partner does; it stays still by default.

    Raises:
        ValueError: an unknown style, or an environment with discrete actions.
    """

    def __init__(self, environment: Environment, style: str, partner: Partner | None = None):
        if not environment.continuous:
            raise ValueError(
                f"{environment.name} has discrete actions; expected an environment with "
                "continuous ones, such as assistive/jaco"
            )
        self.environment = environment
        self.style = environment.style(style)
        self._partner = partner if partner is not None else self._stays_still

    def _stays_still(self, key: jax.Array, observation: jax.Array) -> jax.Array:
        del key, observation
        return jnp.zeros(self.environment.num_actions.partner)

    def reset(self, rng: jax.Array) -> State:
        """Starts a game; consumes `rng`."""
        reset_key, key = jax.random.split(rng)
        state, timestep = self.environment.reset(reset_key, self.style)
        world = World(state, timestep.observation.partner, key, jnp.zeros((), jnp.int32))
        return self._state(world, timestep)

    def step(self, state: State, action: jax.Array) -> State:
        """Plays one step with the ego's action, float32 [A]."""
        world: Any = state.pipeline_state
        partner_key, step_key = jax.random.split(jax.random.fold_in(world.key, world.time))
        actions = Pair(action, self._partner(partner_key, world.partner_sees))
        following, timestep = self.environment.step(step_key, world.state, actions, self.style)
        world = world.replace(
            state=following, partner_sees=timestep.observation.partner, time=world.time + 1
        )
        after = self._state(world, timestep)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=world,
            obs=after.obs,
            reward=after.reward,
            done=after.done,
            metrics={**state.metrics, **after.metrics},
        )

    def _state(self, world: World, timestep: TimeStep) -> State:
        events = zip(self.environment.event_names, timestep.events[0], strict=True)
        return State(
            pipeline_state=world,  # pyright: ignore[reportArgumentType]
            obs=timestep.observation.ego,
            reward=timestep.reward,
            done=timestep.terminated.astype(jnp.float32),
            metrics=dict(events),
            info={},
        )

    @property
    def observation_size(self) -> int:
        """Numbers in the ego's observation."""
        return self.environment.observation_sizes.ego

    @property
    def action_size(self) -> int:
        """Numbers in the ego's action."""
        return self.environment.num_actions.ego

    @property
    def backend(self) -> str:
        """Of the physics."""
        return "mjx"


class StartsAnew(Wrapper):
    """Starts a new game after the last one's end; around Brax's wrapper that counts the time."""

    def reset(self, rng: jax.Array) -> State:
        """Starts games; consumes `rng`, keys [game]."""
        keys = jax.vmap(jax.random.split)(rng)
        state = self.env.reset(keys[:, 0])
        state.info["restart_keys"] = keys[:, 1]
        return state

    def step(self, state: State, action: jax.Array) -> State:
        """Plays one step; where a game ends the state is the new one's first."""
        keys = jax.vmap(jax.random.split)(state.info["restart_keys"])
        ended_before = state.done.astype(bool)
        state.info["steps"] = jnp.where(ended_before, 0, state.info["steps"])
        state = self.env.step(
            state.replace(done=jnp.zeros_like(state.done)),  # pyright: ignore
            action,
        )
        fresh = self.env.reset(keys[:, 0])
        done = state.done.astype(bool)

        def where_done(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        state.info["restart_keys"] = keys[:, 1]
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=jax.tree.map(where_done, fresh.pipeline_state, state.pipeline_state),
            obs=where_done(fresh.obs, state.obs),  # pyright: ignore[reportArgumentType]
        )


def wrap(
    env: Env, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Any = None
) -> Wrapper:
    """Brax's usual wrappers for learners, but every game has a start of its own.

    Args:
        env: the environment.
        episode_length: steps of a game.
        action_repeat: steps that an action is repeated.
        randomization_fn: not supported.

    Raises:
        ValueError: there is a `randomization_fn`.
    """
    if randomization_fn is not None:
        raise ValueError("randomization_fn is given; expected None: games differ in their starts")
    counted = training.EpisodeWrapper(training.VmapWrapper(env), episode_length, action_repeat)
    return StartsAnew(counted)
