"""The ablations of Table 1: a part of Haland left out, everything else as the run made it."""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from experiments.methods.base import Given, Told, Trained
from experiments.stages import (
    Run,
    fit_latent_diffusion,
    load_archive,
    load_haland,
    load_pretrained,
    load_task_language,
    load_vae,
)
from experiments.training import run_fit
from haland_jax import bert_weights, cgan, diffusion, fit, partners, samplers, translator
from haland_jax.cgan import CGANConfig, LabelledLatents
from haland_jax.diffusion import CleanDiffusionConfig, LatentArchive
from haland_jax.fit import FitConfig
from haland_jax.networks import Policy

CGAN_MLP, CGAN_UNET = "CGAN (MLP)", "CGAN (UNet)"
NO_TRANSLATOR, NO_VAE, NO_VAE_CLEAN = "Without translator", "Without VAE", "Without VAE (clean)"
SENTENCE_TOKENS = 8
"""Tokens that a sentence's embedding becomes."""
LEAST_DEVIATION = 1e-3
"""Of a dimension of the embeddings, which are of the order of 0.1."""
LEAST_LOG_VARIANCE = -14.0
"""Of parameters that are diffused without a VAE; some are the same in all policies."""


class WithoutDiffusion:
    """A conditional GAN, told the style's label, in place of diffusion and translator.

    Args:
        generator: `mlp`, or `unet`, as the diffusion has it.
    """

    budgeted = False

    def __init__(self, generator: Literal["mlp", "unet"]):
        self.generator: Literal["mlp", "unet"] = generator
        self.name = CGAN_MLP if generator == "mlp" else CGAN_UNET

    def num_updates(self, run: Run, steps: int) -> int:
        """As many as the diffusion's fit has."""
        del steps
        return run.config.diffusion.fit.steps

    def train(self, given: Given) -> Trained:
        """Fits the GAN on the latents that the run's VAE made of the best responses."""
        config = self.config(given.run)
        vae, vae_params, posterior = load_vae(given.run)
        styles = len(given.env.style_names)
        label = jnp.repeat(jnp.eye(styles), posterior.mean.shape[0] // styles, axis=0)
        latents = LabelledLatents(posterior.mean, posterior.log_variance, label)
        statistics = diffusion.latent_statistics(
            LatentArchive(posterior.mean, posterior.log_variance, label)
        )
        init_key, fit_key = jax.random.split(given.key)
        state, _ = run_fit(
            self.name,
            config.fit,
            fit.make_fit_chunk(
                cgan.make_cgan_loss(config),
                cgan.make_sample_fn(config, statistics),
                config.fit,
                max(1, config.fit.steps // 20),
            ),
            fit.init_fit(fit_key, cgan.init_cgan(init_key, config, styles), config.fit),
            latents,
            given.saver(self.generator),
            given.task,
        )

        @jax.jit
        def generate(key: jax.Array, style: jax.Array) -> Policy:
            z = cgan.sample(key, state.ema, statistics, jnp.eye(styles)[style], config)
            policy: Any = vae.apply(vae_params, z, method="decode")
            return policy

        generator = {"mlp": "an MLP", "unet": "the UNet"}[self.generator]
        what = f"a conditional GAN with {generator} in place of the diffusion, told the label"
        return Trained(
            egos={self.name: lambda told, key: generate(key, told.style)},
            descriptions={self.name: what},
        )

    def config(self, run: Run) -> CGANConfig:
        """The GAN's settings for a run."""
        steps = run.config.diffusion.fit
        return CGANConfig(
            generator=self.generator,
            grid=run.config.diffusion.grid,
            unet=run.config.diffusion.unet,
            batch_size=run.config.diffusion.batch_size,
            fit=FitConfig(
                learning_rate=1e-3,
                steps=steps.steps,
                warmup_steps=steps.warmup_steps,
                ema_decay=steps.ema_decay,
            ),
        )


class WithoutTranslator:
    """The diffusion is told a sentence's embedding by the pre-trained BERT, not its translation."""

    budgeted = False

    def num_updates(self, run: Run, steps: int) -> int:
        """As many as the diffusion's fit has."""
        del steps
        return run.config.diffusion.fit.steps

    def train(self, given: Given) -> Trained:
        """Fits the diffusion on each best response with each training sentence of its style."""
        config = dataclasses.replace(given.run.config.diffusion, vector_tokens=SENTENCE_TOKENS)
        vae, vae_params, posterior = load_vae(given.run)
        embed = _pretrained_embedding(given.run)
        sentences = given.sentences
        embedded = embed([sentence for style in sentences for sentence in style])
        mean = embedded.mean(axis=0)
        # MiniLM has dimensions that are the same for every sentence.
        deviation = jnp.maximum(embedded.std(axis=0), LEAST_DEVIATION)
        embedded = ((embedded - mean) / deviation).reshape(len(sentences), -1, mean.shape[0])
        policies, spoken = posterior.mean.shape[0] // len(sentences), embedded.shape[1]
        archive = LatentArchive(
            jnp.repeat(posterior.mean, spoken, axis=0),
            jnp.repeat(posterior.log_variance, spoken, axis=0),
            jnp.repeat(embedded[:, None], policies, axis=1).reshape(-1, mean.shape[0]),
        )
        params, _ = fit_latent_diffusion(given.key, config, archive, given.saver("fit"), given.task)

        @jax.jit
        def generate(key: jax.Array, embedding: jax.Array) -> Policy:
            condition = (embedding - mean) / deviation
            z = samplers.sample(key, params, condition, config)
            policy: Any = vae.apply(vae_params, z, method="decode")
            return policy

        return Trained(
            egos={NO_TRANSLATOR: lambda told, key: generate(key, embed([told.sentence])[0])},
            descriptions={
                NO_TRANSLATOR: "the diffusion is told the sentence's embedding by BERT without "
                "fine-tuning"
            },
        )


class WithoutVAE:
    """The diffusion makes a policy's parameters themselves, in the units that the VAE sees.

    Args:
        clean: whether the UNet gives the parameters (`CleanDiffusionConfig`), since there are more
            of them than can pass through it at once; otherwise all is as in Haland.
    """

    budgeted = False

    def __init__(self, clean: bool = False):
        self.clean = clean
        self.name = NO_VAE_CLEAN if clean else NO_VAE

    def num_updates(self, run: Run, steps: int) -> int:
        """As many as the diffusion's fit has."""
        del steps
        return run.config.diffusion.fit.steps

    def train(self, given: Given) -> Trained:
        """Fits the diffusion on the best responses' parameters, a grid with many channels."""
        vae, vae_params, _ = load_vae(given.run)
        policies = partners.flatten(load_archive(given.run).egos.actor)
        policies = jax.vmap(lambda policy: vae.apply(vae_params, policy, method="unfold"))(policies)
        flat = jax.vmap(lambda policy: ravel_pytree(policy)[0])(policies)
        _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], policies))
        size = flat.shape[1]
        height, width, _ = given.run.config.diffusion.grid
        channels = -(-size // (height * width))
        config = dataclasses.replace(given.run.config.diffusion, grid=(height, width, channels))
        if self.clean:
            config = CleanDiffusionConfig.like(config)
        padded = jnp.pad(flat, ((0, 0), (0, config.latent_size - size)))
        v_hat = load_task_language(given.run).v_hat
        archive = LatentArchive(
            padded,
            jnp.full_like(padded, LEAST_LOG_VARIANCE),
            jnp.repeat(v_hat, flat.shape[0] // v_hat.shape[0], axis=0),
        )
        params, _ = fit_latent_diffusion(given.key, config, archive, given.saver("fit"), given.task)
        haland = load_haland(given.run)

        @jax.jit
        def generate(key: jax.Array, v_hat: jax.Array) -> Policy:
            policy = unravel(samplers.sample(key, params, v_hat, config)[:size])
            folded: Any = vae.apply(vae_params, policy, method="fold")
            return folded

        def make(told: Told, key: jax.Array) -> Policy:
            return generate(key, haland.translate([told.sentence])[0][0])

        what = f"the diffusion makes all {size:,} parameters of a policy"
        if self.clean:
            what += "; its UNet gives these, not a velocity"
        return Trained(egos={self.name: make}, descriptions={self.name: what})


def _pretrained_embedding(run: Run) -> Any:
    """Embeds sentences [B] by the encoder as it was pre-trained, float32 [B, W]."""
    encoder, tokenizer = load_pretrained(run)
    architecture, config = encoder.architecture, run.config.translator
    layers = translator.init_fine_tuning(encoder, config, len(run.env.style_names))["encoder"]

    @jax.jit
    def embed_one(params: Any, layers: Any, token_ids: jax.Array, mask: jax.Array) -> jax.Array:
        hidden = translator.frozen_hidden(params, architecture, config, token_ids[None], mask[None])
        return translator.embed_hidden(layers, architecture, config, hidden, mask[None])[0]

    def embed(sentences: list[str]) -> jax.Array:
        ids, mask = bert_weights.tokenize(tokenizer, sentences, config.maximum_length)
        # One program for a sentence, however many there are.
        return jnp.stack(
            [embed_one(encoder.params, layers, *row) for row in zip(ids, mask, strict=True)]
        )

    return embed
