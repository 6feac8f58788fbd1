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


class _Kept(NamedTuple):
    """What the gradient needs of a step, [T, B, H] each."""

    entering: jax.Array
    forgetting: jax.Array
    candidate: jax.Array
    leaving: jax.Array
    cell_before: jax.Array
    hidden_before: jax.Array
    cell: jax.Array


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
    hidden, last, _ = _forwards(kernel, projected, keep, start)
    return hidden, last


def _forwards(
    kernel: jax.Array, projected: jax.Array, keep: jax.Array, start: Memory
) -> tuple[jax.Array, Memory, _Kept]:
    def step(memory: Memory, now: tuple[jax.Array, jax.Array]):
        gates, going_on = now
        memory = Memory(*(part * going_on[:, None] for part in memory))
        following, kept = _step(kernel, gates, memory)
        return following, (following.hidden, kept)

    last, (hidden, kept) = jax.lax.scan(step, start, (projected, keep))
    return hidden, last, kept


def _step(kernel: jax.Array, projected: jax.Array, memory: Memory) -> tuple[Memory, _Kept]:
    """One step of a memory, and what its gradient needs."""
    gates = jnp.split(projected + memory.hidden @ kernel, 4, axis=-1)
    entering, forgetting, leaving = (jax.nn.sigmoid(gates[index]) for index in (0, 1, 3))
    candidate = jnp.tanh(gates[2])
    cell = forgetting * memory.cell + entering * candidate
    kept = _Kept(entering, forgetting, candidate, leaving, memory.cell, memory.hidden, cell)
    return Memory(cell, leaving * jnp.tanh(cell)), kept


def _remember_forwards(kernel: Any, projected: Any, keep: Any, start: Memory) -> Any:
    hidden, last, kept = _forwards(kernel, projected, keep, start)
    return (hidden, last), (kernel, keep, kept)


def _remember_backwards(saved: Any, gradients: Any) -> Any:
    kernel, keep, kept = saved
    of_hidden, of_last = gradients

    def step(carry: Memory, now: Any):
        gradient, kept, keep = now
        squashed = jnp.tanh(kept.cell)
        hidden = gradient + carry.hidden
        cell = carry.cell + hidden * kept.leaving * (1 - squashed**2)
        gates = jnp.concatenate(
            [
                cell * kept.candidate * kept.entering * (1 - kept.entering),
                cell * kept.cell_before * kept.forgetting * (1 - kept.forgetting),
                cell * kept.entering * (1 - kept.candidate**2),
                hidden * squashed * kept.leaving * (1 - kept.leaving),
            ],
            axis=-1,
        )
        before = Memory(cell * kept.forgetting, gates @ kernel.T)
        return Memory(*(part * keep[:, None] for part in before)), gates

    first, of_projected = jax.lax.scan(step, of_last, (of_hidden, kept, keep), reverse=True)
    of_kernel = jnp.einsum("tbh,tbg->hg", kept.hidden_before, of_projected)
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
