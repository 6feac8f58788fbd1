"""The policy VAE f = (f_E, f_D) of Eq. 4: policies to and from latent vectors z in R^64.

The encoder reads a policy's parameters and the graph hypernetwork writes them; what the loss
compares is not parameters but action distributions on stored states.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from haland_jax import networks, normalisation
from haland_jax.hypernetwork import GraphHypernetwork, HypernetworkConfig, PolicyArchitecture
from haland_jax.networks import DistributionKind, Policy

Params = Any

STATISTICS = "statistics"
"""The collection beside "params" that holds the observations' mean and deviation."""


@dataclass(frozen=True)
class PolicyVAEConfig:
    """Sizes and loss of the policy VAE (Table 2).

    From Table 2: `latent_dim` 64, `encoder_hidden` 64, `kl_coefficient` 1e-6. Its learning rate
    (1e-4) and clipping belong to the fit's `FitConfig`; a fit of a few thousand steps needs about
    1e-2 with cosine decay.
    Ours: `latent_noise`, the noise added to z in training, in units of the latents' standard
    deviation over the drawn policies, so that policies survive a perturbation (method stage 3's
    gate asks for 0.1); `initial_posterior_std`, small beside the latents, so that they are heard
    from the first step; `policies_per_step` (all, if there are fewer) and `states_per_policy`, the
    size of a minibatch; `normalised`, whether encoder and decoder see policies as they read
    normalised observations (`with_statistics`), for observations in several units. The
    hypernetwork's deviations are stated in `HypernetworkConfig`.

    Raises:
        ValueError: if a size is not positive or a scale is negative.
    """

    latent_dim: int = 64
    encoder_hidden: int = 64
    kl_coefficient: float = 1e-6
    latent_noise: float = 0.2
    initial_posterior_std: float = 0.05
    policies_per_step: int = 64
    states_per_policy: int = 256
    normalised: bool = False
    hypernetwork: HypernetworkConfig = field(default_factory=HypernetworkConfig)

    def __post_init__(self) -> None:
        sizes = ("latent_dim", "encoder_hidden", "policies_per_step", "states_per_policy")
        for name in (*sizes, "initial_posterior_std"):
            if getattr(self, name) <= 0:
                raise ValueError(f"PolicyVAEConfig.{name} is {getattr(self, name)}; expected > 0")
        for name in ("kl_coefficient", "latent_noise"):
            if getattr(self, name) < 0:
                raise ValueError(f"PolicyVAEConfig.{name} is {getattr(self, name)}; expected >= 0")


class Posterior(NamedTuple):
    """f_E(z | policy), a diagonal normal: `mean` [..., D], `log_variance` [..., D]."""

    mean: Array
    log_variance: Array


class Conv1D(nn.Module):
    """Convolution of width 3 over the length: [length, channels] -> [length, features].

    Written as one matrix product on shifted copies: XLA's own convolution, inside the scanned loop
    of `fit`, made the encoder's gradient about ten times slower on the CPU.
    """

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        padded = jnp.pad(x, ((1, 1), (0, 0)))
        windows = [padded[shift : shift + x.shape[0]] for shift in range(3)]
        return nn.Dense(self.features, name="window")(jnp.concatenate(windows, axis=-1))


class KernelEncoder(nn.Module):
    """Two Conv1D blocks on a kernel [in, out] -> features [2 * hidden] (mean and max pooled).

    Output neurons are the length, inputs the channels. Pooling alone would forget which neuron is
    which, and policies that share an initialisation share its neurons, hence the learnt embedding
    of each neuron's place. LayerNorm over the features, never BatchNorm (train and test differ).
    """

    hidden: int

    @nn.compact
    def __call__(self, kernel: Array) -> Array:
        x = Conv1D(self.hidden, name="conv_0")(kernel.T)
        x = x + self.param("place", nn.initializers.normal(0.1), x.shape)
        x = nn.silu(nn.LayerNorm(name="norm_0")(x))
        x = Conv1D(self.hidden, name="conv_1")(x)
        x = nn.silu(nn.LayerNorm(name="norm_1")(x))
        return jnp.concatenate([jnp.mean(x, axis=0), jnp.max(x, axis=0)])


class VectorEncoder(nn.Module):
    """Two-layer MLP on a bias (or log-std) vector -> features [hidden]."""

    hidden: int

    @nn.compact
    def __call__(self, vector: Array) -> Array:
        x = nn.silu(nn.Dense(self.hidden, name="dense_0")(vector))
        return nn.Dense(self.hidden, name="dense_1")(x)


class PolicyEncoder(nn.Module):
    """f_E (App. E.1): the parameters of one policy -> `Posterior` over z [D]."""

    architecture: PolicyArchitecture
    config: PolicyVAEConfig

    @nn.compact
    def __call__(self, policy: Policy) -> Posterior:
        hidden, params = self.config.encoder_hidden, policy["params"]
        features = []
        for name, _, _ in self.architecture.layers:
            features.append(KernelEncoder(hidden, name=f"{name}_kernel")(params[name]["kernel"]))
            features.append(VectorEncoder(hidden, name=f"{name}_bias")(params[name]["bias"]))
        if self.architecture.kind == DistributionKind.GAUSSIAN:
            features.append(VectorEncoder(hidden, name="log_std")(params["log_std"]))
        posterior = nn.Dense(2 * self.config.latent_dim, name="posterior")
        mean, log_variance = jnp.split(posterior(jnp.concatenate(features)), 2)
        return Posterior(mean, log_variance + 2.0 * jnp.log(self.config.initial_posterior_std))


class PolicyVAE(nn.Module):
    """f = (f_E, f_D): `encode` a policy to a `Posterior`, `decode` z [D] to a policy.

    Written for one policy; callers vmap `vae.apply(params, x, method="encode")` (or "decode").
    Calling the module reconstructs a policy through its posterior mean, without noise.

    Policies read raw observations. If `config.normalised`, encoder and decoder see them as they
    read normalised ones: where a number varies by a centimetre, the weights of a raw policy are
    a hundred times larger than its others, and a decoder's errors in them as much worse. The
    statistics are a collection of their own beside the parameters and get no gradient.
    """

    architecture: PolicyArchitecture
    config: PolicyVAEConfig = PolicyVAEConfig()

    def setup(self) -> None:
        self.encoder = PolicyEncoder(self.architecture, self.config)
        self.decoder = GraphHypernetwork(self.architecture, self.config.hypernetwork)
        if self.config.normalised:
            size = self.architecture.observation_dim
            self.mean = self.variable(STATISTICS, "mean", jnp.zeros, size)
            self.std = self.variable(STATISTICS, "std", jnp.ones, size)

    def __call__(self, policy: Policy) -> Policy:
        return self.decode(self.encode(policy).mean)

    def encode(self, policy: Policy) -> Posterior:
        """Mean and log-variance of z, [D] each."""
        return self.encoder(self.unfold(policy))

    def decode(self, latent: Array) -> Policy:
        """The policy of z [D], with the pytree structure of `architecture`."""
        return self.fold(self.decoder(latent))

    def unfold(self, policy: Policy) -> Policy:
        """A policy as encoder and decoder see it: reading normalised observations, if they do."""
        if self.config.normalised:
            return networks.unfold_normalisation(policy, *self._statistics)
        return policy

    def fold(self, policy: Policy) -> Policy:
        """The inverse of `unfold`: a policy that reads raw observations."""
        if self.config.normalised:
            return networks.fold_normalisation(policy, *self._statistics)
        return policy

    @property
    def _statistics(self) -> tuple[Array, Array]:
        return jax.lax.stop_gradient((self.mean.value, self.std.value))


def with_statistics(params: Params, states: Array) -> Params:
    """The parameters with the statistics of states [..., O], if they hold any; else as they are."""
    if STATISTICS not in params:
        return params
    seen = normalisation.update(normalisation.fresh(states.shape[-1]), states)
    return {**params, STATISTICS: {"mean": seen.mean, "std": seen.std}}


class PolicyBatch(NamedTuple):
    """A minibatch: `policies` (leading axis B), `states` [B, N, O], `weights` [B], >= 0."""

    policies: Policy
    states: Array
    weights: Array


def posterior_kl(posterior: Posterior) -> Array:
    """KL(posterior || N(0, I)) in nats, sum over D: [...]."""
    mean, log_variance = posterior
    terms = jnp.square(mean) + jnp.exp(log_variance) - log_variance - 1.0
    return 0.5 * jnp.sum(terms, axis=-1)


def perturb(key: Array, latents: Array, scale: float | Array) -> Array:
    """Latents [B, D] plus normal noise of `scale` times each dimension's deviation over B."""
    deviation = jax.lax.stop_gradient(jnp.std(latents, axis=0))
    return latents + scale * deviation * jax.random.normal(key, latents.shape)


def policy_kl(policies: Policy, decoded: Policy, states: Array) -> Array:
    """KL(original || decoded) of the action distributions, in nats, by policy.

    Both policies have a leading axis B; `states` is [B, N, O]. Returns [B], mean over N.
    """
    original = jax.vmap(networks.act)(policies, states)
    reconstructed = jax.vmap(networks.act)(decoded, states)
    return jnp.mean(networks.kl(original, reconstructed), axis=-1)


def make_sample_fn(config: PolicyVAEConfig) -> Callable[[Array, Mapping[str, Any]], PolicyBatch]:
    """`sample_fn(key, data)` for `fit.make_fit_chunk`.

    `data` holds "policies" (leading axis [policy]), "states" [policy, N, O] and optionally
    "weights" [policy]. All are arguments, so that states gathered with decoded policies (DAgger)
    can replace others between chunks without recompilation. Policies are drawn without
    replacement (all of them if there are at most `policies_per_step`), states with replacement.
    """

    def sample_fn(key: Array, data: Mapping[str, Any]) -> PolicyBatch:
        policy_key, state_key = jax.random.split(key)
        states = data["states"]
        count, stored = states.shape[:2]
        drawn = min(config.policies_per_step, count)
        chosen = jnp.arange(count)
        if drawn < count:
            chosen = jax.random.choice(policy_key, count, (drawn,), replace=False)
        rows = jax.random.randint(state_key, (drawn, config.states_per_policy), 0, stored)
        weights = data["weights"] if "weights" in data else jnp.ones(count)
        policies, weights = jax.tree.map(lambda leaf: leaf[chosen], (data["policies"], weights))
        return PolicyBatch(policies, states[chosen[:, None], rows], weights)

    return sample_fn


def make_loss_fn(
    vae: PolicyVAE,
) -> Callable[[Params, Array, PolicyBatch], tuple[Array, dict[str, Array]]]:
    """`loss_fn(params, key, batch)` of Eq. 4 for `fit.make_fit_chunk`.

    The loss is the KL from original to decoded policies (mean over states, weighted mean over
    policies, where Eq. 4 sums) plus `kl_coefficient` times the posterior's KL to N(0, I) (sum over
    D, mean over policies). z is drawn from the posterior and then perturbed by `latent_noise`.
    Metrics: "reconstruction", "worst_policy" (the largest by policy) and "posterior_kl", in nats.
    """

    def loss_fn(params: Params, key: Array, batch: PolicyBatch) -> tuple[Array, dict[str, Array]]:
        posterior_key, noise_key = jax.random.split(key)
        posterior = encode(vae, params, batch.policies)
        deviation = jnp.exp(0.5 * posterior.log_variance)
        noise = deviation * jax.random.normal(posterior_key, deviation.shape)
        latents = perturb(noise_key, posterior.mean, vae.config.latent_noise) + noise
        by_policy = policy_kl(batch.policies, decode(vae, params, latents), batch.states)
        reconstruction = jnp.sum(batch.weights * by_policy) / jnp.sum(batch.weights)
        prior = jnp.mean(posterior_kl(posterior))
        metrics = {
            "reconstruction": reconstruction,
            "worst_policy": jnp.max(by_policy),
            "posterior_kl": prior,
        }
        return reconstruction + vae.config.kl_coefficient * prior, metrics

    return loss_fn


def encode(vae: PolicyVAE, params: Params, policies: Policy) -> Posterior:
    """Posteriors [B, D] of policies with a leading axis B."""
    posterior = jax.vmap(lambda policy: vae.apply(params, policy, method="encode"))(policies)
    return posterior  # pyright: ignore[reportReturnType]


def decode(vae: PolicyVAE, params: Params, latents: Array) -> Policy:
    """Policies with a leading axis B of latents [B, D]."""
    return jax.vmap(lambda latent: vae.apply(params, latent, method="decode"))(latents)


def reconstruct(
    vae: PolicyVAE, params: Params, key: Array, policies: Policy, perturbation: float | Array = 0.0
) -> Policy:
    """Policies decoded from the posterior means of `policies` (leading axis B).

    With `perturbation` 0.1 these are the ones that method stage 3's gate plays: noise of that
    fraction of each dimension's standard deviation over B is added to z first.
    """
    latents = perturb(key, encode(vae, params, policies).mean, perturbation)
    return decode(vae, params, latents)
