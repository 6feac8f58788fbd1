"""Policies and critics with memory: a long short-term memory and a small network on each side.

Universal egos remember what a partner did (App. C.3). `remember` is the memory alone, over whole
sequences, with its gradient written out: differentiated through the scan, each step of a sequence
would add to the gradient of the recurrent kernel, and these many small products take most of the
time on a CPU. Here they are one product at the end.
"""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from haland_jax.networks import Distribution, DistributionKind, Gaussian

UNITS = 256
"""Of the memory (App. C.3)."""
TOLD_UNITS, HEAD_UNITS = 32, 64
"""Of the layer that reads what an ego is told, and of the one behind the memory."""


class Memory(NamedTuple):
    """State of a long short-term memory, float32 [..., H] each."""

    cell: jax.Array
    hidden: jax.Array


def no_memory(*leading: int) -> Memory:
    """The memory of players that have seen nothing, with leading axes."""
    return Memory(jnp.zeros((*leading, UNITS)), jnp.zeros((*leading, UNITS)))


@jax.custom_vjp
def remember(
    kernel: jax.Array, projected: jax.Array, keep: jax.Array, start: Memory
) -> tuple[jax.Array, Memory]:
    """Runs a memory over a sequence (Hochreiter and Schmidhuber, 1997; Gers et al., 2000).

    Args:
        kernel: from the hidden state to the gates, [H, 4H]; the gates are, in this order, input,
            forget, candidate, output.
        projected: what inputs and biases give to the gates, [T, B, 4H].
        keep: 0 where a game begins with a step, so that nothing before is known, else 1, [T, B].
        start: before the first step, [B, H]. It is taken as given: its gradient is zero
            (truncated back-propagation), and so is that of `keep`.

    Returns:
        Hidden states after each step, [T, B, H], and the memory after the last one.
    """
    return _remember_forwards(kernel, projected, keep, start)[0]


def _remember_forwards(
    kernel: jax.Array, projected: jax.Array, keep: jax.Array, start: Memory
) -> tuple[tuple[jax.Array, Memory], tuple[Any, ...]]:
    """What `remember` returns, and what its gradient needs."""
    # The logistic function is a hyperbolic tangent: one call of it makes all gates.
    units = kernel.shape[0]
    scale = np.repeat(np.array([0.5, 0.5, 1.0, 0.5], np.float32), units)
    shift = np.repeat(np.array([0.5, 0.5, 0.0, 0.5], np.float32), units)

    def step(memory: Memory, now: tuple[jax.Array, jax.Array]):
        given, going_on = now
        cell, hidden = (part * going_on[:, None] for part in memory)
        gates = jnp.tanh((given + hidden @ kernel) * scale) * scale + shift
        entering, forgetting, candidate, leaving = jnp.split(gates, 4, axis=-1)
        cell = forgetting * cell + entering * candidate
        memory = Memory(cell, leaving * jnp.tanh(cell))
        return memory, (gates, *memory)

    last, (gates, cell, hidden) = jax.lax.scan(step, start, (projected, keep))
    return (hidden, last), (kernel, keep, start, gates, cell, hidden)


def _remember_backwards(saved: Any, gradients: Any) -> Any:
    kernel, keep, start, gates, cell, hidden = saved
    of_hidden, of_last = gradients

    def before(first: jax.Array, after: jax.Array) -> jax.Array:
        """A part of the memory before each step, from those after each."""
        return jnp.concatenate([first[None], after[:-1]]) * keep[..., None]

    def step(carry: Memory, now: Any):
        gradient, gates, cell, cell_before, going_on = now
        entering, forgetting, candidate, leaving = jnp.split(gates, 4, axis=-1)
        squashed = jnp.tanh(cell)
        of_hidden = gradient + carry.hidden
        of_cell = carry.cell + of_hidden * leaving * (1 - squashed**2)
        of_gates = jnp.concatenate(
            [
                of_cell * candidate * entering * (1 - entering),
                of_cell * cell_before * forgetting * (1 - forgetting),
                of_cell * entering * (1 - candidate**2),
                of_hidden * squashed * leaving * (1 - leaving),
            ],
            axis=-1,
        )
        earlier = Memory(of_cell * forgetting, of_gates @ kernel.T)
        return Memory(*(part * going_on[:, None] for part in earlier)), of_gates

    steps = (of_hidden, gates, cell, before(start.cell, cell), keep)
    first, of_projected = jax.lax.scan(step, of_last, steps, reverse=True)
    flat = before(start.hidden, hidden).reshape(-1, hidden.shape[-1])
    of_kernel = flat.T @ of_projected.reshape(-1, of_projected.shape[-1])
    return of_kernel, of_projected, jnp.zeros_like(keep), jax.tree.map(jnp.zeros_like, first)


remember.defvjp(_remember_forwards, _remember_backwards)


class RecurrentBody(nn.Module):
    """From what a player sees and is told to features, with a memory between.

    What it is told passes through a layer of its own (the paper's instruction module).
    """

    @nn.compact
    def __call__(
        self, observation: jax.Array, told: jax.Array, began: jax.Array, memory: Memory
    ) -> tuple[jax.Array, Memory]:
        """Runs over a sequence.

        Args:
            observation: [T, B, O].
            told: [T, B, L].
            began: whether a game begins with a step, bool [T, B].
            memory: before the first step, [B, H].

        Returns:
            Features [T, B, F], and the memory after the last step.
        """
        heard = jnp.tanh(nn.Dense(TOLD_UNITS, name="told")(told))
        inputs = jnp.concatenate([observation, heard], axis=-1)
        projected = nn.Dense(4 * UNITS, name="memory_input")(inputs)
        orthogonal = nn.initializers.orthogonal()
        kernel = self.param(
            "memory_kernel",
            lambda key: jnp.concatenate(
                [orthogonal(one, (UNITS, UNITS)) for one in jax.random.split(key, 4)], axis=1
            ),
        )
        hidden, memory = remember(kernel, projected, 1.0 - began, memory)
        layer = nn.Dense(HEAD_UNITS, kernel_init=orthogonal, name="features")
        return jnp.tanh(layer(hidden)), memory


class RecurrentActor(nn.Module):
    """Action distributions [T, B, A] and the memory after them; arguments as `RecurrentBody`."""

    action_dim: int
    kind: str = DistributionKind.CATEGORICAL
    initial_log_std: float = 0.0

    @nn.compact
    def __call__(
        self, observation: jax.Array, told: jax.Array, began: jax.Array, memory: Memory
    ) -> tuple[Distribution, Memory]:
        features, memory = RecurrentBody(name="body")(observation, told, began, memory)
        small = nn.initializers.orthogonal(0.01)
        out = nn.Dense(self.action_dim, kernel_init=small, name="head")(features)
        if DistributionKind(self.kind) == DistributionKind.CATEGORICAL:
            return out, memory
        constant = nn.initializers.constant(self.initial_log_std)
        log_std = self.param("log_std", constant, (self.action_dim,))
        return Gaussian(out, jnp.broadcast_to(log_std, out.shape)), memory


class RecurrentCritic(nn.Module):
    """Values [T, B] and the memory after them; arguments as `RecurrentBody`."""

    @nn.compact
    def __call__(
        self, observation: jax.Array, told: jax.Array, began: jax.Array, memory: Memory
    ) -> tuple[jax.Array, Memory]:
        features, memory = RecurrentBody(name="body")(observation, told, began, memory)
        out = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0), name="head")(features)
        return out[..., 0], memory


def actor_of(params: Any) -> RecurrentActor:
    """The `RecurrentActor` whose parameters these are (of any leading axes)."""
    own = params["params"]
    kind = DistributionKind.GAUSSIAN if "log_std" in own else DistributionKind.CATEGORICAL
    return RecurrentActor(own["head"]["bias"].shape[-1], kind)
