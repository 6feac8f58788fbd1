"""What all environments promise to compiled loops."""

import jax
import jax.numpy as jnp
import pytest

import envs
from envs.base import Environment, Pair


def types(value) -> list[tuple]:
    """Place, shape, type and whether it is a weak one, of all arrays in a pytree."""
    leaves = jax.tree_util.tree_leaves_with_path(value)
    return [(jax.tree_util.keystr(at), x.shape, x.dtype, x.weak_type) for at, x in leaves]


def example_actions(env: Environment) -> Pair:
    """Actions of both players."""
    if env.continuous:
        return Pair(*(jnp.zeros(size) for size in env.num_actions))
    return Pair(jnp.int32(0), jnp.int32(0))


@pytest.mark.parametrize(
    "name",
    [
        "overcooked/diverse_coordination",
        "overcooked/diverse_orders",
        "lbf/spread",
        "assistive/jaco",
    ],
)
def test_a_game_keeps_its_types_so_that_a_loop_over_it_is_compiled_once(name):
    env = envs.make(name)
    style = jax.tree.map(lambda leaf: leaf[0], env.styles)
    key = jax.random.key(0)
    share = jnp.float32(0.5)
    started = [
        jax.eval_shape(env.reset, key, style),
        jax.eval_shape(env.training_reset, key, style, share),
    ]
    state, _ = started[0]
    played = jax.eval_shape(env.step, key, state, example_actions(env), style)
    for first in started:
        assert types(first) == types(played)
