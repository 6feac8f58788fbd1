"""The graph hypernetwork of f_D (App. E.1): a latent vector becomes the parameters of a policy.

The policy is read as a chain graph input, W1, b1, W2, b2, ..., one node a parameter. A node starts
from its size, its place, and a projection of z; gated sweeps pass messages along the chain and
back; two heads, shared by all nodes, turn the final states into weight matrices and vectors.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from haland_jax.networks import DistributionKind, Policy, distribution_kind, layer_names

VECTOR_SCALE = 0.1
"""Biases (and log-stds) start small beside the pre-activations, which have about unit scale."""


class Layer(NamedTuple):
    """One dense layer: kernel [fan_in, fan_out], bias [fan_out]."""

    name: str
    fan_in: int
    fan_out: int


class Node(NamedTuple):
    """One node of the chain: where its parameter is in `params` (nowhere: the input), its shape."""

    path: tuple[str, ...]
    shape: tuple[int, ...]


@dataclass(frozen=True)
class PolicyArchitecture:
    """The names and shapes of a policy's parameters; hashable, so it can be a static argument."""

    layers: tuple[Layer, ...]
    kind: DistributionKind = DistributionKind.CATEGORICAL

    @classmethod
    def from_params(cls, policy: Policy) -> "PolicyArchitecture":
        """Read the architecture off one policy, or off an archive (leading axes are ignored).

        Raises:
            ValueError: if the pytree is not that of an `MLPActor`.
        """
        params = policy["params"]
        names = layer_names(policy)
        unknown = set(params) - set(names) - {"log_std"}
        if unknown or not names:
            raise ValueError(
                f"policy has entries {sorted(params)}; expected dense_0, dense_1, ... and, for a "
                "Gaussian head, log_std: pass the parameters of an MLPActor"
            )
        layers = tuple(Layer(name, *params[name]["kernel"].shape[-2:]) for name in names)
        for before, after in pairwise(layers):
            if before.fan_out != after.fan_in:
                raise ValueError(
                    f"{before.name} puts out {before.fan_out} values but {after.name} takes "
                    f"{after.fan_in}; the layers of a policy must form a chain"
                )
        return cls(layers, distribution_kind(policy))

    @property
    def observation_dim(self) -> int:
        """Width of the observation."""
        return self.layers[0].fan_in

    @property
    def action_dim(self) -> int:
        """Number of actions, or the dimensions of a Gaussian action."""
        return self.layers[-1].fan_out

    @property
    def nodes(self) -> tuple[Node, ...]:
        """The chain input, W1, b1, W2, b2, ...[, log_std]."""
        nodes = [Node((), (self.observation_dim,))]
        for layer in self.layers:
            nodes.append(Node((layer.name, "kernel"), (layer.fan_in, layer.fan_out)))
            nodes.append(Node((layer.name, "bias"), (layer.fan_out,)))
        if self.kind == DistributionKind.GAUSSIAN:
            nodes.append(Node(("log_std",), (self.action_dim,)))
        return tuple(nodes)


@dataclass(frozen=True)
class HypernetworkConfig:
    """Sizes of the graph hypernetwork.

    Deviations from App. E.1 and Table 2: `hidden` is 16 there, which lets 16 numbers of z through
    to a node, and the heads are linear (`head_hidden=0`), so that all weight matrices lie in a
    space of 16 dimensions. In a trial on 40 synthetic policies, 500 steps left a smaller
    divergence the wider the two were, hence 64 and a hidden layer of 128.
    `base_weights` gives each parameter a learnt part that does not depend on z.

    Raises:
        ValueError: if a width is not positive (`head_hidden` may be 0).
    """

    hidden: int = 64
    head_hidden: int = 128
    base_weights: bool = True

    def __post_init__(self) -> None:
        if self.hidden < 1 or self.head_hidden < 0:
            raise ValueError(
                f"HypernetworkConfig has hidden={self.hidden}, head_hidden={self.head_hidden}; "
                "expected hidden >= 1 and head_hidden >= 0 (0 makes the heads linear)"
            )


class GatedStep(nn.Module):
    """A node takes in its neighbour's message and sends its own, [hidden] each."""

    hidden: int

    @nn.compact
    def __call__(self, message: Array, state: Array) -> tuple[Array, Array]:
        state, _ = nn.GRUCell(self.hidden, name="cell")(state, message)
        message = nn.silu(nn.Dense(self.hidden, name="message_0")(state))
        return nn.Dense(self.hidden, name="message_1")(message), state


class Sweeps(nn.Module):
    """One forward and one backward gated sweep over the chain: [node, hidden] -> the same.

    Each node's state passes through a GRU cell whose input is its predecessor's message (forward)
    or its successor's (backward). Message network and cell are shared by all nodes and both sweeps.
    """

    hidden: int

    @nn.compact
    def __call__(self, states: Array) -> Array:
        scanned = nn.scan(GatedStep, variable_broadcast="params", split_rngs={"params": False})
        sweep = scanned(self.hidden, name="step")
        silence = jnp.zeros(self.hidden)
        _, states = sweep(silence, states)
        _, states = sweep(silence, states[::-1])
        return states[::-1]


class Head(nn.Module):
    """State [hidden] -> array of `shape`, cut from the corner of one of `full_shape`.

    Entries have about unit variance at initialisation. What is sliced is the head's kernel, not
    its output: the same numbers, and a small node costs little.
    """

    full_shape: tuple[int, ...]
    head_hidden: int

    @nn.compact
    def __call__(self, state: Array, shape: tuple[int, ...]) -> Array:
        if self.head_hidden:
            state = nn.silu(nn.Dense(self.head_hidden, name="hidden")(state))
            # silu of a unit normal has a mean square of 0.36
            state = state / 0.6
        width = state.shape[-1]
        initialiser = nn.initializers.normal(1.0 / sqrt(width))
        kernel = self.param("kernel", initialiser, (width, *self.full_shape))
        corner = (slice(None), *(slice(size) for size in shape))
        return jnp.tensordot(state, kernel[corner], axes=1)


class GraphHypernetwork(nn.Module):
    """f_D: z [D] -> a policy with the pytree structure of `architecture` (App. E.1).

    A node's features are its log-widths (raw widths are known to fail), a learnt embedding of its
    place, and a projection of z. Kernels are scaled by sqrt(2 / fan_in), vectors by
    `VECTOR_SCALE`. With `base_weights` each parameter has a learnt array of its own, zero at
    first and the same for every z, to which the heads' output is added: policies that grew from
    one initialisation have much in common, and the few numbers that z passes through a node are
    left for what differs.
    """

    architecture: PolicyArchitecture
    config: HypernetworkConfig

    def setup(self) -> None:
        nodes, hidden = self.architecture.nodes, self.config.hidden
        self.size_embedding = nn.Dense(hidden)
        self.node_embedding = self.param(
            "node_embedding", nn.initializers.normal(1.0), (len(nodes), hidden)
        )
        self.latent_projection = nn.Dense(hidden)
        self.node_input = nn.Dense(hidden)
        self.sweeps = Sweeps(hidden)
        self.norm = nn.LayerNorm()
        rows = max(layer.fan_in for layer in self.architecture.layers)
        columns = max(layer.fan_out for layer in self.architecture.layers)
        self.weight_head = Head((rows, columns), self.config.head_hidden)
        self.vector_head = Head((columns,), self.config.head_hidden)
        if self.config.base_weights:
            zeros = nn.initializers.zeros
            self.base = [
                self.param(f"base_{'_'.join(node.path)}", zeros, node.shape) for node in nodes[1:]
            ]

    def __call__(self, latent: Array) -> Policy:
        states = self._node_states(latent)
        params: dict = {layer.name: {} for layer in self.architecture.layers}
        for index, node in enumerate(self.architecture.nodes[1:]):
            array = self._array(node, states[index + 1])
            if self.config.base_weights:
                array = array + self.base[index]
            *parents, leaf = node.path
            (params[parents[0]] if parents else params)[leaf] = array
        return {"params": params}

    def _node_states(self, latent: Array) -> Array:
        """Final state of each node, [node, hidden]."""
        widths = [(node.shape[0], node.shape[-1]) for node in self.architecture.nodes]
        nodes = self.size_embedding(jnp.log(jnp.array(widths, float))) + self.node_embedding
        projected = jnp.broadcast_to(self.latent_projection(latent), nodes.shape)
        states = self.node_input(jnp.concatenate([nodes, projected], axis=-1))
        return self.norm(self.sweeps(states))

    def _array(self, node: Node, state: Array) -> Array:
        """The part of one parameter that depends on z."""
        if len(node.shape) == 2:
            return sqrt(2.0 / node.shape[0]) * self.weight_head(state, node.shape)
        return VECTOR_SCALE * self.vector_head(state, node.shape)
