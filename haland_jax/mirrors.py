"""Partners and egos as they look in an environment's mirrors.

A partner that works on the left is, seen in a mirror, one that works on the right, and an ego that
knows what to do beside the one has an image that does it beside the other (`envs.base.Symmetry`).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, Symmetry
from haland_jax.networks import Policy, layer_names
from haland_jax.partners import PartnersConfig, Player, Population


def teachers(env: Environment, config: PartnersConfig, population: Population) -> Policy:
    """Actors of all partners that egos learn with, leading axes [style, teacher].

    Those that are not held out and, with `config.mirror`, their mirror images.
    """
    known = population.known_partners
    return with_mirror_images(env, known) if config.mirror else known


def with_mirror_images(env: Environment, policies: Policy) -> Policy:
    """Adds the partners of other styles as they look in the environment's mirrors.

    A partner that works on the left is, seen in a mirror, one that works on the right: further
    conventions of each style at no cost, in the spirit of Other-Play (Hu et al., 2020).

    Args:
        env: whose `symmetries` are used.
        policies: actors of partners, leading axes [style, seed].

    Returns:
        Actors, [style, seed * (1 + symmetries)]; the given ones come first.
    """
    images = [_of_style_seen_in(mirror, _actors_in(mirror, policies)) for mirror in env.symmetries]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), policies, *images)


def egos_seen_in(mirror: Symmetry, egos: Player) -> Player:
    """The egos of other styles as they look in a mirror.

    An ego that has learnt with the partners of a style, and with the images of those of the style
    that is seen in its place, is in the mirror one that has learnt with the very same partners.

    Args:
        mirror: one of the environment's `symmetries`.
        egos: leading axes [style, seed].

    Returns:
        Egos [style, seed]: those of each style are the images of another one's.
    """
    normaliser = egos.normaliser
    if normaliser is not None:
        seen = _numbers_in(mirror, normaliser.mean.shape[-1])
        normaliser = normaliser.replace(
            mean=normaliser.mean[..., seen], variance=normaliser.variance[..., seen]
        )
    images = Player(_actors_in(mirror, egos.actor), _inputs_in(mirror, egos.critic), normaliser)
    return _of_style_seen_in(mirror, images)


def _of_style_seen_in(mirror: Symmetry, players: Any) -> Any:
    """Deals players [style, …] to the styles as which theirs appear."""
    return jax.tree.map(lambda leaf: leaf[np.argsort(mirror.styles)], players)


def _actors_in(mirror: Symmetry, actors: Policy) -> Policy:
    """Actors that see and do what is in the mirror what the given ones see and do."""
    layers = dict(_inputs_in(mirror, actors)["params"])
    last = layer_names(actors)[-1]
    shown = np.argsort(mirror.actions)
    layers[last] = {key: leaf[..., shown] for key, leaf in layers[last].items()}
    return {**actors, "params": layers}


def _inputs_in(mirror: Symmetry, networks: Any) -> Any:
    """Networks that say of a mirrored observation what the given ones say of the observation."""
    layers = dict(networks["params"])
    first = layer_names(networks)[0]
    kernel = layers[first]["kernel"]
    seen = _numbers_in(mirror, kernel.shape[-2])
    layers[first] = {**layers[first], "kernel": kernel[..., seen, :]}
    return {**networks, "params": layers}


def _numbers_in(mirror: Symmetry, size: int) -> np.ndarray:
    """Which number of an observation is seen in place of each; the ego's is the shorter one."""
    return np.argsort(mirror.observation[:size])
