"""The agents that players meet: made from their sentence, chosen by it, or the same for all."""

import hashlib
import secrets
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from haland_jax.networks import Policy
from haland_jax.pretrained import TrainedModel

HALAND, ORACLE, UNIVERSAL = "haland", "oracle", "universal"
CONDITIONS = (HALAND, ORACLE, UNIVERSAL)
"""Kinds of agents: generated from the sentence; the best one for a trained partner of the style
that the sentence sounds like; one ego for all styles, which does not hear the sentence."""
MOST_CHARACTERS = 300
"""Of a sentence; the translator reads 32 word pieces at most."""


class Made(NamedTuple):
    """An agent for a player.

    Attributes:
        policy: the ego's actor.
        sounds_like: the style whose task language is nearest to the sentence's.
        v_hat: what the sentence was translated to, float32 [U].
        seed: of its making; the same seed makes the same agent.
    """

    policy: Policy
    sounds_like: str
    v_hat: np.ndarray
    seed: int


class Agents:
    """Makes agents from one trained model."""

    def __init__(self, model: TrainedModel):
        """Prepares nothing yet; `compile` does."""
        self.model = model
        flat, self._unpack = ravel_pytree(self.example)
        self._size = flat.size
        self.fingerprint = _fingerprint(model)

    @property
    def conditions(self) -> tuple[str, ...]:
        """The kinds of agents that the model has."""
        return tuple(c for c in CONDITIONS if c != UNIVERSAL or self.model.universal is not None)

    @property
    def example(self) -> Policy:
        """A policy with the shapes of all."""
        return jax.tree.map(lambda leaf: leaf[0, 0], self.model.oracles)

    def compile(self) -> None:
        """Makes one agent of each kind, so that no player waits for the compiler."""
        for condition in self.conditions:
            jax.block_until_ready(self.make(condition, "left", 0).policy)

    def make(self, condition: str, sentence: str, seed: int) -> Made:
        """Makes an agent for a player.

        Args:
            condition: its kind, one of `conditions`.
            sentence: what the player says.
            seed: another seed gives another sample.

        Raises:
            ValueError: the sentence is blank or too long, or there is no such kind.
        """
        sentence = sentence.strip()
        if len(sentence) > MOST_CHARACTERS:
            raise ValueError(
                f"the sentence has {len(sentence)} characters; at most {MOST_CHARACTERS} are read"
            )
        if condition not in self.conditions:
            raise ValueError(
                f"the model has no agent {condition!r}; expected {', '.join(self.conditions)}"
            )
        haland, model = self.model.haland, self.model
        generation = haland.explain(sentence, jax.random.key(seed))
        style = int(haland.nearest_style(generation.v_hat))
        policy = generation.policy
        if condition == ORACLE:
            chosen = seed % model.held_out_seeds
            policy = jax.tree.map(lambda leaf: leaf[style, chosen], model.oracles)
        elif condition == UNIVERSAL:
            policy = jax.tree.map(lambda leaf: leaf[seed % len(leaf)], model.universal)
        v_hat = np.asarray(generation.v_hat)
        return Made(policy, model.env.style_names[style], v_hat, seed)

    def pack(self, policy: Policy) -> bytes:
        """A policy's parameters as bytes, so that it can play on after a restart."""
        return np.asarray(ravel_pytree(policy)[0], "<f4").tobytes()

    def unpack(self, data: bytes) -> Policy:
        """The policy that was packed.

        Raises:
            ValueError: it was another model's.
        """
        flat = np.frombuffer(data, "<f4")
        if flat.size != self._size:
            raise ValueError(
                f"a stored policy has {flat.size} parameters, those of {self.model.env.name} have "
                f"{self._size}; it was made by another model"
            )
        return self._unpack(jnp.asarray(flat))


def new_seed() -> int:
    """A seed that nobody can guess, int32."""
    return secrets.randbelow(2**31)


def _fingerprint(model: TrainedModel) -> str:
    """SHA-256 of all parameters that agents are made of."""
    digest = hashlib.sha256()
    parts: Any = (model.haland.params, model.oracles, model.universal)
    for leaf in jax.tree.leaves(parts):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()
