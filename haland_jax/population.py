"""One compiled program for a population: `vmap` over its members, sharded over the devices.

One XLA program does not fill the cores of a CPU by itself. Split the host into several
devices (`jax.config.update("jax_num_cpu_devices", 2)` before the first computation) and a
population is shared out over them; the same code runs on several GPUs.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

WORTH_TURNS = 0.1
"""Share of copies from which on members take turns; each turn moves their states."""
Population = Any
"""A pytree whose leaves have the leading axis [member]."""


def population_size(population: Population) -> int:
    """Returns the number of members."""
    return jax.tree.leaves(population)[0].shape[0]


def over_population(
    function: Callable[..., Any],
    *,
    shared: int = 0,
    donate: tuple[int, ...] = (),
    compiler_options: dict[str, Any] | None = None,
) -> Callable[..., Any]:
    """Compiles a function of one member into one of a population.

    Args:
        function: takes `shared` arguments that are the same for all members, then arguments
            of one member.
        shared: how many leading arguments are shared.
        donate: positions of the arguments whose buffers may be overwritten.
        compiler_options: see `jax.jit`.

    Returns:
        A compiled function: shared arguments, then populations of the same size, to a
        population. Where its arguments lie makes no difference: they are shared out first, since
        every other placement would be another program. A population that the devices do not
        divide is filled up with copies of its last member, which are dropped from the result.
    """
    devices = jax.devices()
    mesh = Mesh(np.array(devices), ("member",))
    members = PartitionSpec("member")

    def mapped(*arguments: Any) -> Any:
        common, own = arguments[:shared], arguments[shared:]
        return jax.vmap(lambda *one: function(*common, *one))(*own)

    def call(*arguments: Any) -> Any:
        common, own = arguments[:shared], arguments[shared:]
        size = population_size(own)
        missing = -size % len(devices)
        if missing:
            own = jax.tree.map(lambda leaf: _filled_up(leaf, missing), own)
        sharded = jax.shard_map(
            mapped,
            mesh=mesh,
            in_specs=(*([PartitionSpec()] * shared), *([members] * len(own))),
            out_specs=members,
            check_vma=False,
        )
        result = sharded(*common, *own)
        return jax.tree.map(lambda leaf: leaf[:size], result) if missing else result

    named = function.func if isinstance(function, partial) else function
    call.__name__ = getattr(named, "__name__", "call")  # the program's name in logs and profiles
    compiled = jax.jit(call, donate_argnums=donate, compiler_options=compiler_options)

    def placed(*arguments: Any) -> Any:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments)):
            return call(*arguments)  # a part of another program, which has its own options
        common, own = arguments[:shared], arguments[shared:]
        undivided = NamedSharding(mesh, PartitionSpec())
        common = jax.device_put(common, undivided)
        if population_size(own) % len(devices):
            return compiled(*common, *jax.device_put(own, undivided))
        return compiled(*common, *map(share_out, own))

    return placed


def turns(members: int, devices: int) -> list[np.ndarray]:
    """Who computes together, so that no device waits for a population that devices do not divide.

    Three members on two devices take turns as (0, 1), (2, 0), (1, 2): after all groups each has had
    as many turns as any other, and no device computed a copy of a member.

    Returns:
        Members of each group, int [member of the group]; one group of all where the devices
        divide the population or are more than its members, or where filling it up with copies
        costs less than `WORTH_TURNS` of the computation.
    """
    size = members - members % devices
    missing = -members % devices
    if size == 0 or missing < WORTH_TURNS * (members + missing):
        return [np.arange(members)]
    groups = members // math.gcd(members, size)
    return [np.arange(first, first + size) % members for first in range(0, groups * size, size)]


def share_out(population: Population) -> Population:
    """Puts a population onto the devices, so that a compiled call need not move it."""
    devices = jax.devices()
    if population_size(population) % len(devices):
        return population
    mesh = Mesh(np.array(devices), ("member",))
    return jax.device_put(population, NamedSharding(mesh, PartitionSpec("member")))


def _filled_up(leaf: jax.Array, missing: int) -> jax.Array:
    return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)])
