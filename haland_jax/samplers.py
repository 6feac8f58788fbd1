"""Latents drawn from a fitted diffusion: Eq. 1 with all its steps, or the fast DDIM.

Written unbatched; callers `vmap`. Noise steps are numbered 1 to N as in the paper, and an array's
entry i - 1 belongs to step i.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from haland_jax.diffusion import DiffusionConfig, DiffusionParams, NoisePredictor
from haland_jax.noise_schedule import NoiseSchedule, noise_schedule

NoiseFn = Callable[[Array, Array], Array]
"""(noisy latent [D], noise step []) -> predicted noise [D]."""


def ddpm_step(
    schedule: NoiseSchedule, noisy: Array, step: Array, predicted: Array, noise: Array
) -> Array:
    """Eq. 1: from z_i to z_{i-1}; the last step, i = 1, adds no noise.

    Args:
        noisy, predicted, noise: [D]; z_i, the predicted ε, and the fresh noise.
        step: int [], i from 1 to N.
    """
    beta, alpha, alpha_bar = jax.tree.map(
        lambda values: values[step - 1], (schedule.beta, schedule.alpha, schedule.alpha_bar)
    )
    mean = (noisy - (1 - alpha) / jnp.sqrt(1 - alpha_bar) * predicted) / jnp.sqrt(alpha)
    return mean + jnp.where(step > 1, jnp.sqrt(beta), 0.0) * noise


def ddim_step(
    noisy: Array,
    alpha_bar: Array,
    next_alpha_bar: Array,
    predicted: Array,
    noise: Array,
    eta: float = 0.0,
    clip: float = float("inf"),
) -> Array:
    """One step of DDIM (Song et al., 2021, Eq. 12 and 16) between two noise levels.

    Args:
        noisy, predicted, noise: [D]; the latent, the predicted ε, and fresh noise (unused at η=0).
        alpha_bar, next_alpha_bar: [], levels before and after; 1 is noiseless.
        eta: 0 deterministic, 1 the variance of DDPM.
        clip: bound on the magnitude of the predicted clean latent; ε follows the clipped one.
    """
    clean = (noisy - jnp.sqrt(1 - alpha_bar) * predicted) / jnp.sqrt(alpha_bar)
    if clip < float("inf"):
        clean = jnp.clip(clean, -clip, clip)
        predicted = (noisy - jnp.sqrt(alpha_bar) * clean) / jnp.sqrt(1 - alpha_bar)
    sigma = eta * jnp.sqrt(
        (1 - next_alpha_bar) / (1 - alpha_bar) * (1 - alpha_bar / next_alpha_bar)
    )
    direction = jnp.sqrt(1 - next_alpha_bar - sigma**2) * predicted
    return jnp.sqrt(next_alpha_bar) * clean + direction + sigma * noise


def sample_ddpm(key: Array, noise_fn: NoiseFn, config: DiffusionConfig) -> Array:
    """Standardised latent [D] by Eq. 1 from N(0, I), all N steps. Consumes `key`."""
    schedule = noise_schedule(config.noise_steps)
    start_key, noise_key = jax.random.split(key)

    def body(noisy: Array, step: Array):
        noise = jax.random.normal(jax.random.fold_in(noise_key, step), noisy.shape)
        return ddpm_step(schedule, noisy, step, noise_fn(noisy, step), noise), None

    start = jax.random.normal(start_key, (config.latent_size,))
    return jax.lax.scan(body, start, jnp.arange(config.noise_steps, 0, -1))[0]


def ddim_noise_steps(config: DiffusionConfig) -> np.ndarray:
    """The noise steps that DDIM visits, int [S], evenly spaced from N down to 1."""
    return np.round(np.linspace(config.noise_steps, 1, config.ddim_steps)).astype(np.int32)


def sample_ddim(key: Array, noise_fn: NoiseFn, config: DiffusionConfig) -> Array:
    """Standardised latent [D] by DDIM from N(0, I), `ddim_steps` steps. Consumes `key`."""
    alpha_bar = noise_schedule(config.noise_steps).alpha_bar
    start_key, noise_key = jax.random.split(key)
    steps = jnp.asarray(ddim_noise_steps(config))
    levels = jnp.append(alpha_bar[steps - 1], 1.0)

    def body(noisy: Array, visit):
        step, level, next_level = visit
        noise = jnp.zeros_like(noisy)
        if config.eta > 0:
            noise = jax.random.normal(jax.random.fold_in(noise_key, step), noisy.shape)
        predicted = noise_fn(noisy, step)
        return ddim_step(noisy, level, next_level, predicted, noise, config.eta, config.clip), None

    start = jax.random.normal(start_key, (config.latent_size,))
    return jax.lax.scan(body, start, (steps, levels[:-1], levels[1:]))[0]


SAMPLERS = {"ddim": sample_ddim, "ddpm": sample_ddpm}


def sample(
    key: Array,
    params: DiffusionParams,
    v_hat: Array,
    config: DiffusionConfig,
    sampler: str = "ddim",
) -> Array:
    """Generate a policy's latent from a task-language description.

    Args:
        key: consumed.
        params: a fitted diffusion; its network should be the fit's averaged parameters.
        v_hat: [U], normalised frequencies in [0, 1].
        config: the configuration that `params` was fitted with.
        sampler: "ddim" (fast) or "ddpm" (Eq. 1, N network calls).

    Returns:
        z [D], on the autoencoder's scale.

    Raises:
        ValueError: unknown `sampler`.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"sampler is {sampler!r}; expected one of {sorted(SAMPLERS)}")
    apply = partial(NoisePredictor(config).apply, params.network)
    # Tokens of the condition and, for guidance alone, those of no condition.
    branches = (False,) if config.guidance == 1 else (False, True)
    tokens = jax.vmap(lambda dropped: apply(v_hat, dropped, method="tokens"))(jnp.array(branches))

    def noise_fn(noisy: Array, step: Array) -> Array:
        predicted = jax.vmap(lambda given: apply(noisy, step, given, method="predict"))(tokens)
        return predicted[-1] + config.guidance * (predicted[0] - predicted[-1])

    return params.statistics.restore(SAMPLERS[sampler](key, noise_fn, config))
