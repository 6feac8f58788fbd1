"""The learners' part of the benchmark: our PPO beside Brax's, the ego alone, a frozen partner."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from envs.adapters.brax import BraxEnvironment, wrap
from envs.quiet import no_word_of_warp
from experiments.configs import PRESETS
from haland_jax import networks, partners, ppo
from haland_jax.learner import init_learner, make_networks
from haland_jax.networks import Policy
from haland_jax.partners import Player
from haland_jax.population import over_population, share_out
from haland_jax.ppo_loss import PPOConfig
from haland_jax.pretrained import TrainedModel

PIECES = 10
"""Parts of a training; the first one, which compiles, is not timed."""
OURS = "ours"
PEER_RATES = (1.0, 0.3)
"""Learning rates of Brax's PPO, which keeps them, as shares of the rate that ours starts from."""


def learner_config(environment: str, steps: int) -> PPOConfig:
    """Settings of a training from nothing with a frozen partner.

    Those of the pairs' training in `overnight`, but for what Brax does not have: shaped rewards
    and games that start at random moments.

    Raises:
        ValueError: too few steps, or devices that do not divide the games, as Brax needs it.
    """
    config = PRESETS["overnight"](environment, 0).partners.joint
    config = dataclasses.replace(
        config, total_steps=steps, shaping=0.0, random_start=0.0, final_random_start=0.0
    )
    if config.num_updates < PIECES:
        raise ValueError(
            f"steps is {steps:,}; expected at least {PIECES * config.steps_per_update:,}"
        )
    devices, minibatch = jax.local_device_count(), config.num_envs // config.num_minibatches
    if minibatch % devices:
        raise ValueError(
            f"there are {devices} devices; expected a divisor of {minibatch}, the games of a "
            "minibatch, because Brax shares them out equally"
        )
    updates = config.num_updates // PIECES * PIECES
    return dataclasses.replace(config, total_steps=updates * config.steps_per_update)


def measure_learners(
    model: TrainedModel,
    style: str,
    config: PPOConfig,
    seeds: int,
    games: int,
    *,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Trains egos for one frozen partner with both learners, with the same settings and steps.

    Our seeds learn at the same time, one on each device; Brax's one after the other, each on all
    devices. Both learn from the team's reward alone. Both play the same way: actions are drawn,
    and Brax's most probable actions are tried too; the better way counts for it.

    Args:
        model: has the partner, held-out seed 0 of the style.
        style: the partner's.
        config: settings of each training; see `learner_config`.
        seeds: egos of each learner.
        games: games in which an ego is judged.
        tell: is told what has been done.

    Returns:
        By learner: mean `returns` by seed, [seed]; `seconds` of the training of all seeds
        without compilation; for Brax's also `time_ratio` (its seconds / ours) and `met`, whether
        our mean return is at least as high.
    """
    partner = model.partner(style)
    world = BraxEnvironment(
        model.env,
        style,
        lambda key, seen: jnp.clip(networks.sample(key, networks.act(partner, seen)), -1.0, 1.0),
    )
    policies, seconds = train_ours(model.env, config, partner, style, seeds)
    egos = [jax.tree.map(lambda leaf, i=i: leaf[i], policies) for i in range(seeds)]
    returns = [judge(world, games, seed, _ours(ego)) for seed, ego in enumerate(egos)]
    tell(f"{OURS}: {seeds} egos learnt in {seconds:.0f} s")
    found: dict[str, Any] = {OURS: {"returns": returns, "seconds": seconds}}
    for rate in (share * config.learning_rate for share in PEER_RATES):
        name = f"Brax, learning rate {rate:g}"
        trained = []
        for seed in range(seeds):
            trained.append(train_brax(world, config, rate, seed))
            tell(f"{name}: ego {seed + 1} of {seeds} learnt in {trained[-1][2]:.0f} s")
        ways = [
            [judge(world, games, seed, make(params, deterministic)) for deterministic in (0, 1)]
            for seed, (make, params, _) in enumerate(trained)
        ]
        taken = sum(one[2] for one in trained)
        best = np.max(ways, axis=1).tolist()
        found[name] = {
            "returns": best,
            "seconds": taken,
            "time_ratio": taken / seconds,
            "met": bool(np.mean(returns) >= np.mean(best)),
        }
    return found


def train_ours(
    env: Any, config: PPOConfig, partner: Policy, style: str, seeds: int
) -> tuple[Policy, float]:
    """Trains egos with a frozen partner.

    Returns:
        Actors, leading axis [seed], and seconds of the training without compilation.
    """
    actors, critic = make_networks(env)
    styles = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], seeds, axis=0), env.style(style))
    frozen = jax.tree.map(lambda leaf: leaf[None], partner)

    def start(key: jax.Array, style: Any) -> Any:
        ego_key, train_key = jax.random.split(key)
        size = env.observation_sizes.ego
        ego = init_learner(ego_key, actors.ego, critic, size, config)
        return ppo.init_train_state(env, config, train_key, ego, frozen, style)

    starts = over_population(start, compiler_options=env.compiler_options)
    state = share_out(starts(jax.random.split(jax.random.key(0), seeds), styles))
    train = partners.compile_training(env, config, config.num_updates // PIECES)
    ends = []
    for _ in range(PIECES):
        state, _ = jax.block_until_ready(train(state, share_out(styles)))
        ends.append(time.perf_counter())
    return Player.of(state.ego).actor, without_compilation(ends)


def train_brax(
    world: BraxEnvironment, config: PPOConfig, learning_rate: float, seed: int
) -> tuple[Callable[..., Any], Any, float]:
    """Trains one ego with Brax's PPO, with our settings where it has the same.

    Returns:
        What makes a policy of parameters, the parameters, and seconds of the training without
        compilation.
    """
    with no_word_of_warp():
        from brax.training.agents.ppo import networks as ppo_networks
        from brax.training.agents.ppo import train as brax_ppo

    ends: list[float] = []
    sizes = make_networks(world.environment)[0].ego.hidden
    make, params, _ = brax_ppo.train(
        world,
        num_timesteps=config.num_updates * config.steps_per_update,
        num_envs=config.num_envs,
        episode_length=world.environment.max_steps,
        unroll_length=config.rollout_steps,
        batch_size=config.num_envs // config.num_minibatches,
        num_minibatches=config.num_minibatches,
        num_updates_per_batch=config.epochs,
        learning_rate=learning_rate,
        entropy_cost=config.entropy,
        discounting=config.discount,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip,
        max_grad_norm=config.max_gradient_norm,
        reward_scaling=config.reward_scale,
        normalize_observations=config.normalise,
        network_factory=functools.partial(
            ppo_networks.make_ppo_networks,
            policy_hidden_layer_sizes=sizes,
            value_hidden_layer_sizes=sizes,
        ),
        num_evals=PIECES + 1,
        wrap_env_fn=wrap,
        run_evals=False,
        seed=seed,
        progress_fn=lambda step, metrics: ends.append(time.perf_counter()),
    )
    return make, params, without_compilation(ends)


def without_compilation(ends: list[float]) -> float:
    """Seconds of all pieces, from the times at which they ended; the first one compiled."""
    pieces = [after - before for before, after in itertools.pairwise(ends)]
    return sum(pieces) * len(ends) / len(pieces)


def _ours(policy: Policy) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, Any]]:
    """One of our policies as Brax writes them."""
    return lambda seen, key: (networks.sample(key, networks.act(policy, seen)), {})


def judge(world: BraxEnvironment, games: int, seed: int, act: Callable[..., Any]) -> float:
    """Mean return of whole games."""

    def play(key: jax.Array) -> jax.Array:
        reset_key, act_key = jax.random.split(key)
        state = world.reset(reset_key)

        def one_step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            action, _ = act(state.obs, key)
            state = world.step(state, jnp.clip(action, -1.0, 1.0))
            return state, state.reward

        keys = jax.random.split(act_key, world.environment.max_steps)
        return jax.lax.scan(one_step, state, keys)[1].sum()

    program = over_population(play, compiler_options=world.environment.compiler_options)
    keys = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(1), seed), games)
    return float(np.mean(program(keys)))


def brax_table(found: dict[str, Any]) -> Table:
    """The learners for the terminal."""
    table = Table(
        title=(
            f"{found['environment']}, {found['style']}: an ego for a frozen partner, "
            f"{found['steps']:,} steps, {found['seeds']} seeds"
        ),
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    table.add_column("PPO")
    for column in ("return by seed", "mean", "time, all seeds", "x our time", "ours as high"):
        table.add_column(column, justify="right")
    for name, row in found["learners"].items():
        judged = ()
        if "met" in row:
            word = "[green]met[/]" if row["met"] else "[red]missed[/]"
            judged = (f"{row['time_ratio']:.2f}", word)
        table.add_row(
            name,
            ", ".join(f"{value:.1f}" for value in row["returns"]),
            f"{np.mean(row['returns']):.1f}",
            f"{row['seconds']:.0f} s",
            *judged,
        )
    return table
