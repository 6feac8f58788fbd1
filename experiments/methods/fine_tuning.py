"""Haland whose BERT is as it was pre-trained: what the fine-tuning of Eq. 7 is worth (Fig. 6)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from experiments.methods.base import Given, Told, Trained
from experiments.stages import (
    Run,
    fit_translation,
    load_haland,
    load_pretrained,
    load_task_language,
    prepare_instructions,
)
from haland_jax import translator
from haland_jax.deployment import Haland
from haland_jax.networks import Policy

NO_FINE_TUNING = "Without fine-tuning"


class WithoutFineTuning:
    """Only the VAE of Eq. 6 learns; the sentences' embeddings are the pre-trained BERT's."""

    budgeted = False

    def num_updates(self, run: Run, steps: int) -> int:
        """Those of the VAE's fit."""
        del steps
        return run.config.translator.translation.steps

    def train(self, given: Given) -> Trained:
        """Fits the VAE, and translates sentences with both translators."""
        run, config = given.run, given.run.config.translator
        language = load_task_language(run)
        encoder, tokenizer = load_pretrained(run)
        plain = translator.init_fine_tuning(encoder, config, len(given.sentences))
        vae, _ = fit_translation(
            jax.random.split(given.key, 3),
            config,
            encoder.architecture,
            plain,
            prepare_instructions(run.instructions(), encoder, tokenizer, config),
            language.v_hat,
            given.saver("translation"),
            given.task,
        )
        tuned = load_haland(run)
        untuned = dataclasses.replace(
            tuned, translator=translator.assemble_translator(encoder, config, plain, vae)
        )
        keep = jax.jit(lambda v_hat, key: untuned.generate_from_task_language(v_hat, key[None])[0])

        def make(told: Told, key: jax.Array) -> Policy:
            v_hat, _ = untuned.translate([told.sentence])
            return jax.tree.map(lambda leaf: leaf[0], keep(v_hat, key))

        return Trained(
            egos={NO_FINE_TUNING: make},
            descriptions={NO_FINE_TUNING: "Haland with BERT without fine-tuning"},
            notes={
                "translations": {
                    "before": _translations(untuned, run),
                    "after": _translations(tuned, run),
                }
            },
        )


def _translations(haland: Haland, run: Run) -> dict[str, Any]:
    """What the translator says of sentences, by what they are for, [style, sentence, U]."""
    instructions = run.instructions().values()
    spoken = {
        "train": [s.training_sample() for s in instructions],
        "test": [s.test for s in instructions],
    }

    def translate(sentences: Any) -> jax.Array:
        return jnp.stack(
            [haland.translate(list(of_style), drawn=False)[0] for of_style in sentences]
        )

    return {what: translate(sentences) for what, sentences in spoken.items()}
