"""From a sentence to a policy: translator, latent diffusion and decoder in one compiled call."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from haland_jax import bert_weights, samplers, task_language
from haland_jax.diffusion import DiffusionConfig, DiffusionParams
from haland_jax.hypernetwork import PolicyArchitecture
from haland_jax.networks import Policy
from haland_jax.policy_vae import PolicyVAE, PolicyVAEConfig
from haland_jax.translator import Translator


class Generation(PyTreeNode):
    """A generated policy and what it was made from.

    Attributes:
        policy: the ego's actor.
        latent: z, float32 [D].
        v_hat: the task language that the sentence was translated to, drawn to the styles
            (`task_language.drawn_to_styles`), float32 [U].
        style_logits: the translator's classification, float32 [style]; for display alone.
    """

    policy: Policy
    latent: jax.Array
    v_hat: jax.Array
    style_logits: jax.Array


@dataclasses.dataclass(frozen=True)
class Haland:
    """A trained generator of policies.

    Attributes:
        architecture: layers of the policies that it generates.
        vae_config: configuration of the policy VAE.
        vae_params: parameters of the policy VAE.
        diffusion_config: configuration of the diffusion.
        diffusion_params: its averaged parameters and the latents' statistics.
        translator: sentence to task language.
        tokenizer: the translator's tokenizer.
        style_names: the styles that it was trained on.
        v_hat: their task language, float32 [style, U].
    """

    architecture: PolicyArchitecture
    vae_config: PolicyVAEConfig
    vae_params: Any
    diffusion_config: DiffusionConfig
    diffusion_params: DiffusionParams
    translator: Translator
    tokenizer: Any
    style_names: tuple[str, ...]
    v_hat: jax.Array
    _programs: dict[str, Any] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self):
        vae = PolicyVAE(self.architecture, self.vae_config)
        config, translator_config = self.diffusion_config, self.translator.config
        bert, styles = self.translator.architecture, self.v_hat

        def from_task_language(params, key, v_hat, sampler):
            vae_params, diffusion_params, _ = params
            latent = samplers.sample(key, diffusion_params, v_hat, config, sampler)
            return vae.apply(vae_params, latent, method="decode"), latent

        def from_tokens(params, key, token_ids, mask, sampler):
            translate = Translator(params[2], bert, translator_config)
            translated, logits = translate(token_ids[None], mask[None])
            v_hat = task_language.drawn_to_styles(translated[0], styles)
            policy, latent = from_task_language(params, key, v_hat, sampler)
            return Generation(policy, latent, v_hat, logits[0])

        many = jax.vmap(from_task_language, in_axes=(None, 0, 0, None))
        programs = {
            "from_tokens": jax.jit(from_tokens, static_argnums=4),
            "from_task_language": jax.jit(many, static_argnums=3),
            "translate": jax.jit(Translator.__call__),
        }
        object.__setattr__(self, "_programs", programs)

    @property
    def params(self) -> tuple[Any, DiffusionParams, Any]:
        """All parameters: policy VAE, diffusion, translator."""
        return self.vae_params, self.diffusion_params, self.translator.params

    def generate(self, sentence: str, key: jax.Array, *, sampler: str = "ddim") -> Policy:
        """Returns a policy for a partner who describes itself; see `explain` for more."""
        return self.explain(sentence, key, sampler=sampler).policy

    def explain(self, sentence: str, key: jax.Array, *, sampler: str = "ddim") -> Generation:
        """Generates a policy from a sentence and tells what it was made from.

        Args:
            sentence: at most `translator.config.maximum_length` word pieces.
            key: consumed; another key gives another sample.
            sampler: `ddim` (fast) or `ddpm` (Eq. 1, all N steps).

        Raises:
            ValueError: the sentence is blank or too long.
        """
        token_ids, mask = self._tokens([sentence])
        return self._programs["from_tokens"](self.params, key, token_ids[0], mask[0], sampler)

    def translate(
        self, sentences: Sequence[str], *, drawn: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """Translates sentences, for `generate_from_task_language`.

        Args:
            sentences: B of them.
            drawn: whether translations are drawn to the styles (`task_language.drawn_to_styles`),
                as `generate` does it; without that it is what the translator says.

        Returns:
            Task language [B, U] and style logits [B, style].

        Raises:
            ValueError: a sentence is blank or too long.
        """
        translate = self._programs["translate"]
        translated, logits = translate(self.translator, *self._tokens(sentences))
        if drawn:
            translated = task_language.drawn_to_styles(translated, self.v_hat)
        return translated, logits

    def generate_from_task_language(
        self, v_hat: jax.Array, keys: jax.Array, *, sampler: str = "ddim"
    ) -> tuple[Policy, jax.Array]:
        """Generates one policy for each task language.

        Args:
            v_hat: normalised frequencies, float32 [B, U].
            keys: typed keys [B]; consumed.
            sampler: as in `explain`.

        Returns:
            Policies and latents z, leading axis [B].
        """
        return self._programs["from_task_language"](self.params, keys, v_hat, sampler)

    def nearest_style(self, v_hat: jax.Array) -> jax.Array:
        """Returns the index of the style whose task language is nearest, int32 [...]."""
        return task_language.nearest_style(v_hat, self.v_hat)

    def _tokens(self, sentences: Sequence[str]) -> tuple[jax.Array, jax.Array]:
        length = self.translator.config.maximum_length
        ids, mask = bert_weights.tokenize(self.tokenizer, sentences, length)
        return jnp.asarray(ids), jnp.asarray(mask)
