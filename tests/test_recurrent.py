"""The memory against Flax's cell, its gradient against automatic differentiation."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from haland_jax import networks, recurrent
from haland_jax.recurrent import Memory, RecurrentActor, RecurrentCritic, remember

STEPS, GAMES, UNITS, INPUTS = 7, 3, 5, 4
GATES = {"ii": "hi", "if": "hf", "ig": "hg", "io": "ho"}
"""Names of Flax's layers from the input and from the hidden state, in our order."""


@pytest.fixture(scope="module")
def sequence():
    """A cell of Flax's, inputs, where games begin, and a memory before the first step."""
    cell = nn.OptimizedLSTMCell(UNITS)
    keys = jax.random.split(jax.random.key(0), 5)
    inputs = jax.random.normal(keys[0], (STEPS, GAMES, INPUTS))
    began = jax.random.bernoulli(keys[1], 0.3, (STEPS, GAMES))
    start = Memory(*jax.random.normal(keys[2], (2, GAMES, UNITS)))
    params = cell.init(keys[3], tuple(start), inputs[0])
    noise = iter(jax.random.split(keys[4], 20))
    params = jax.tree.map(
        lambda leaf: leaf + 0.3 * jax.random.normal(next(noise), leaf.shape), params
    )
    return cell, params, inputs, began, start


def step_by_step(cell, params, inputs, began, start):
    """Hidden states of Flax's cell, and its state after the last step."""
    memory, hidden = tuple(start), []
    for now, new in zip(inputs, began, strict=True):
        memory = tuple(jnp.where(new[:, None], 0.0, part) for part in memory)
        memory, out = cell.apply(params, memory, now)
        hidden.append(out)
    return jnp.stack(hidden), Memory(*memory)


def ours(params, inputs, began, start):
    """The same by `remember`, from Flax's parameters."""
    layers = params["params"]
    kernel = jnp.concatenate([layers[name]["kernel"] for name in GATES.values()], axis=1)
    bias = jnp.concatenate([layers[name]["bias"] for name in GATES.values()])
    projection = jnp.concatenate([layers[name]["kernel"] for name in GATES], axis=1)
    return remember(kernel, inputs @ projection + bias, 1.0 - began, start)


def test_the_memory_is_that_of_flax(sequence):
    cell, params, inputs, began, start = sequence
    assert began.any()
    assert not began.all()
    found, last = ours(params, inputs, began, start)
    expected, expected_last = step_by_step(cell, params, inputs, began, start)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(last, expected_last, atol=1e-6)


def test_the_gradient_is_that_of_automatic_differentiation(sequence):
    cell, params, inputs, began, start = sequence
    weights = jax.random.normal(jax.random.key(9), (STEPS + 2, GAMES, UNITS))

    def loss(run, params, inputs):
        hidden, last = run(params, inputs)
        return jnp.sum(jnp.concatenate([hidden, jnp.stack(last)]) * weights)

    def mine(params, inputs):
        return ours(params, inputs, began, start)

    def flax(params, inputs):
        return step_by_step(cell, params, inputs, began, start)

    found = jax.grad(loss, argnums=(1, 2))(mine, params, inputs)
    expected = jax.grad(loss, argnums=(1, 2))(flax, params, inputs)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, atol=2e-5), found, expected)
    assert float(jnp.abs(found[1]).min()) > 0


def test_what_was_before_the_sequence_is_taken_as_given(sequence):
    _, params, inputs, began, start = sequence
    gradient = jax.grad(lambda start: ours(params, inputs, began, start)[0].sum())(start)
    assert not any(leaf.any() for leaf in gradient)


@pytest.mark.parametrize("kind", list(networks.DistributionKind))
def test_players_play_step_by_step_as_over_the_whole_sequence(kind):
    actor, critic = RecurrentActor(3, kind), RecurrentCritic()
    keys = jax.random.split(jax.random.key(1), 5)
    seen = jax.random.normal(keys[0], (STEPS, GAMES, INPUTS))
    told = jax.random.normal(keys[1], (STEPS, GAMES, 2))
    began = jax.random.bernoulli(keys[2], 0.3, (STEPS, GAMES))
    start = recurrent.no_memory(GAMES)
    for module, key in ((actor, keys[3]), (critic, keys[4])):
        params = module.init(key, seen, told, began, start)
        whole, last = module.apply(params, seen, told, began, start)
        memory, parts = start, []
        for t in range(STEPS):
            one = slice(t, t + 1)
            out, memory = module.apply(params, seen[one], told[one], began[one], memory)
            parts.append(out)
        together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        jax.tree.map(
            lambda one, two: np.testing.assert_allclose(one, two, atol=1e-5), whole, together
        )
        np.testing.assert_allclose(last, memory, atol=1e-5)


def test_nothing_is_remembered_of_another_game():
    """Steps after a beginning do not depend on those before it."""
    critic = RecurrentCritic()
    seen, told = jnp.ones((4, 1, INPUTS)), jnp.zeros((4, 1, 2))
    params = critic.init(
        jax.random.key(0), seen, told, jnp.zeros((4, 1), bool), recurrent.no_memory(1)
    )

    def values(first, began):
        changed = seen.at[:2].set(first)
        return critic.apply(params, changed, told, began, recurrent.no_memory(1))[0][:, 0]

    anew = jnp.array([[False], [False], [True], [False]])
    on = jnp.zeros((4, 1), bool)
    np.testing.assert_array_equal(values(1.0, anew)[2:], values(-3.0, anew)[2:])
    assert float(jnp.abs(values(1.0, on)[2:] - values(-3.0, on)[2:]).min()) > 1e-4
