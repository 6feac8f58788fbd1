"""What PPO minimises: settings, advantages, and the loss of one minibatch."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from haland_jax import networks
from haland_jax.networks import Policy


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of one training run.

    Attributes:
        total_steps: environment steps of one pair.
        num_envs: games played in parallel by one pair.
        rollout_steps: steps of each game between two updates.
        epochs: passes over each batch.
        num_minibatches: minibatches a pass; must divide `num_envs`.
        learning_rate: at the start; it falls linearly to `final_learning_rate`.
        final_learning_rate: at the end.
        entropy: weight of the entropy bonus at the start; it falls linearly.
        final_entropy: weight of the entropy bonus at the end.
        discount: γ.
        gae_lambda: λ of the generalised advantage estimate.
        clip: ε of the clipped surrogate.
        value_weight: weight of the value loss.
        max_gradient_norm: global norm to which gradients are clipped.
        reward_scale: factor on all rewards.
        shaping: factor on the shaped reward at the start, falling linearly to 0.
        shaping_until: progress, 0 to 1, at which the shaped reward has gone.
        confined_until: progress up to which the ego is held to its role.
        random_start: share of games that start at a random moment, at the start of training;
            it falls linearly to `final_random_start` at the end.
        random_start_until: progress up to which the share stays as it is.
        final_random_start: see `random_start`. Some random moments to the end keep both players
            from conventions that only the two of them share.
        normalise: whether learners read observations by their running mean and deviation.
        guidance: weight of the ego's divergence from its guide at the start (kickstarting); it
            falls linearly to 0.
        guidance_until: progress, above 0, at which the guidance has gone.
        partner_noise: chance that a frozen partner plays a random action instead of its own,
            so that the ego meets more than the conventions of the partners it trains with.
    """

    total_steps: int = 1_000_000
    num_envs: int = 32
    rollout_steps: int = 50
    epochs: int = 4
    num_minibatches: int = 4
    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5
    entropy: float = 0.02
    final_entropy: float = 0.002
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_weight: float = 0.5
    max_gradient_norm: float = 0.5
    reward_scale: float = 0.1
    shaping: float = 3.0
    shaping_until: float = 0.85
    confined_until: float = 0.55
    random_start: float = 0.9
    random_start_until: float = 0.5
    final_random_start: float = 0.4
    normalise: bool = False
    guidance: float = 0.0
    guidance_until: float = 0.5
    partner_noise: float = 0.0

    def __post_init__(self):
        if self.num_envs % self.num_minibatches:
            raise ValueError(
                f"num_minibatches is {self.num_minibatches}; expected a divisor of "
                f"num_envs = {self.num_envs}"
            )
        if self.total_steps < self.num_envs * self.rollout_steps:
            raise ValueError(
                f"total_steps is {self.total_steps}; expected at least one batch of "
                f"num_envs x rollout_steps = {self.num_envs * self.rollout_steps}"
            )
        if self.guidance < 0:
            raise ValueError(f"guidance is {self.guidance}; expected 0 or more")
        if self.guidance_until <= 0:
            raise ValueError(f"guidance_until is {self.guidance_until}; expected > 0")

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one pair in one update."""
        return self.num_envs * self.rollout_steps

    @property
    def num_updates(self) -> int:
        """Updates of a whole run."""
        return self.total_steps // self.steps_per_update


class Batch(PyTreeNode):
    """One player's experience; leading axes [T, env].

    `observation` is all that the networks read: an array, or a tree of what a player with a
    memory reads. `guide` is what a guide would do there, None where nobody guides.
    """

    observation: Any
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array
    guide: Any = None


def generalised_advantages(
    rewards: jax.Array,
    values: jax.Array,
    last_value: jax.Array,
    ended: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Generalised advantage estimates (Schulman et al., 2016, Eq. 16).

    Args:
        rewards: r_t, [T, ...].
        values: V(s_t), [T, ...].
        last_value: V(s_T), [...].
        ended: whether the game ended with step t; nothing is carried over, bool [T, ...].
        discount: γ.
        gae_lambda: λ.

    Returns:
        [T, ...].
    """
    following = jnp.concatenate([values[1:], last_value[None]])
    going_on = 1.0 - ended
    errors = rewards + discount * following * going_on - values

    def backwards(advantage, step):
        error, on = step
        advantage = error + discount * gae_lambda * on * advantage
        return advantage, advantage

    start = jnp.zeros_like(last_value)
    return jax.lax.scan(backwards, start, (errors, going_on), reverse=True)[1]


def ppo_loss(
    params: tuple[Policy, Any],
    batch: Batch,
    actor: Any,
    critic: Any,
    config: PPOConfig,
    entropy_weight: jax.Array,
    guidance: jax.Array | float = 0.0,
) -> jax.Array:
    """The loss of one minibatch; `actor` and `critic` are the modules of the two trees.

    A player with a guide pays `guidance` times its divergence from what the guide would do, mean
    over the batch (kickstarting, Schmitt et al., 2018; their cross-entropy up to a constant).
    """
    actor_params, critic_params = params
    distribution = actor.apply(actor_params, batch.observation)
    value = critic.apply(critic_params, batch.observation)
    loss = clipped_loss(distribution, value, batch, config, entropy_weight)
    if batch.guide is None:
        return loss
    return loss + guidance * jnp.mean(networks.kl(batch.guide, distribution))


def clipped_loss(
    distribution: Any, value: jax.Array, batch: Batch, config: PPOConfig, entropy_weight: jax.Array
) -> jax.Array:
    """Clipped surrogate, value loss and entropy bonus, mean over the batch.

    Schulman et al. (2017), Eq. 7 and 9; advantages are normalised over the minibatch.

    Args:
        distribution: of the actions, as the player would act now.
        value: what it expects now, [...].
        batch: what it did.
        config: settings.
        entropy_weight: of the bonus now.
    """
    advantage = batch.advantage - jnp.mean(batch.advantage)
    advantage = advantage / (jnp.std(batch.advantage) + 1e-8)
    ratio = jnp.exp(networks.log_prob(distribution, batch.action) - batch.log_prob)
    clipped_ratio = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped_ratio * advantage))
    value_loss = 0.5 * jnp.mean((value - batch.target) ** 2)
    entropy = jnp.mean(networks.entropy(distribution))
    return policy_loss + config.value_weight * value_loss - entropy_weight * entropy
