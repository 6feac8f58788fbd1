"""How fast the diffusion turns a latent into noise; steps are numbered 1 to N as in the paper."""

import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode
from jax import Array

PAPER_STEPS, PAPER_BETA = 1000, (1e-4, 0.02)


class NoiseSchedule(PyTreeNode):
    """Linear β with α = 1 - β and ᾱ its running product; each [N]."""

    beta: Array
    alpha: Array
    alpha_bar: Array


def noise_schedule(noise_steps: int) -> NoiseSchedule:
    """The linear schedule 1e-4 .. 0.02 of N = 1000 (Ho et al., 2020), rescaled for another N.

    β is multiplied by the one factor that leaves ᾱ_N at its value for N = 1000, about 4e-5:
    otherwise the last step would not be pure noise and sampling from N(0, I) would be wrong.
    """
    target = np.log1p(-np.linspace(*PAPER_BETA, PAPER_STEPS)).sum()
    base = np.linspace(*PAPER_BETA, noise_steps)
    low, high = 0.0, 1.0 / base[-1]
    for _ in range(200):
        factor = 0.5 * (low + high)
        if np.log1p(-factor * base).sum() > target:
            low = factor
        else:
            high = factor
    beta = base if noise_steps == PAPER_STEPS else low * base
    alpha_bar = np.exp(np.log1p(-beta).cumsum())
    return NoiseSchedule(
        beta=jnp.asarray(beta, jnp.float32),
        alpha=jnp.asarray(1 - beta, jnp.float32),
        alpha_bar=jnp.asarray(alpha_bar, jnp.float32),
    )
