"""Cross-validates an environment's training sentences: is a style told from a wording left out?

    python -m experiments.sentences overcooked/crossway
    python -m experiments.sentences assistive/jaco --seeds 3 --translator.dropout 0.2

The sentences of each style are dealt to folds. BERT is fine-tuned as in a run (Eq. 7) on all folds
but one and asked for the styles of that one, each fold in turn. So settings of the translator can
be chosen, and sentences written, without a look at the test sentences.
"""

import dataclasses
import itertools
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

import envs
from envs.instructions import load_instructions
from experiments import devices
from experiments.errors import UserError, as_user_error, main_guard
from experiments.machine import describe_machine
from haland_jax import bert_weights, fit, translator
from haland_jax.translator import SentenceData, TranslatorConfig


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Cross-validate an environment's training sentences."""

    environment: tyro.conf.Positional[str]
    """Name of the environment, such as assistive/jaco."""
    folds: int = 5
    """Parts that the sentences of a style are dealt to."""
    seeds: int = 1
    """Repetitions, with other random minibatches."""
    encoder: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = ""
    """A BERT checkpoint; the packaged one by default."""
    translator: TranslatorConfig = dataclasses.field(default_factory=TranslatorConfig)
    """Settings of the translator."""


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """What the classifier said of sentences that it was not fine-tuned on.

    Attributes:
        probability: float32 [seed, sentence, style].
        style: int [sentence], the true one.
    """

    probability: np.ndarray
    style: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """bool [seed, sentence]: is the true style the most probable one?"""
        return self.probability.argmax(-1) == self.style

    @property
    def negative_log_likelihood(self) -> float:
        """Of the true styles, mean over seeds and sentences."""
        of_true = self.probability[:, np.arange(len(self.style)), self.style]
        return float(-np.log(np.maximum(of_true, 1e-9)).mean())


def cross_validate(
    encoder: bert_weights.Encoder,
    config: TranslatorConfig,
    sentences: SentenceData,
    *,
    folds: int,
    seeds: int,
) -> LeftOut:
    """Fine-tunes without each fold in turn.

    Args:
        encoder: the pre-trained one.
        config: settings of the fine-tuning.
        sentences: as `translator.prepare_sentences` returns them.
        folds: a style's sentence i is left out with fold i modulo `folds`.
        seeds: repetitions.

    Raises:
        UserError: fewer than two folds, more than a style has sentences, or no repetition.
    """
    style = np.asarray(sentences.style)
    fewest = int(np.bincount(style).min())
    if not 2 <= folds <= fewest:
        raise UserError(f"folds is {folds}; expected 2 to {fewest}, the sentences of a style")
    if seeds < 1:
        raise UserError(f"seeds is {seeds}; expected at least 1")
    number = np.array([np.sum(style[:i] == style[i]) for i in range(len(style))]) % folds
    initial = translator.init_fine_tuning(encoder, config, int(style.max()) + 1)
    functions = translator.make_fine_tuning(encoder.architecture, config)
    chunk = fit.make_fit_chunk(*functions, config.fine_tuning, config.fine_tuning.steps)

    @jax.jit
    def probabilities(params: Any, data: SentenceData) -> jax.Array:
        embed = partial(translator.embed_hidden, params["encoder"], encoder.architecture, config)
        return jax.nn.softmax(
            translator.classify(params["classifier"], embed(data.hidden, data.mask), config)
        )

    found = np.zeros((seeds, len(style), int(style.max()) + 1), np.float32)
    rounds = list(itertools.product(range(seeds), range(folds)))
    for seed, fold in track(rounds, "Fine-tuning without each fold in turn"):
        kept, left_out = np.flatnonzero(number != fold), np.flatnonzero(number == fold)
        key = jax.random.fold_in(jax.random.key(seed), fold)
        # A copy, because the chunk donates what it is given.
        state = fit.init_fit(key, jax.tree.map(jnp.array, initial), config.fine_tuning)
        state, _ = chunk(state, jax.tree.map(lambda leaf, rows=kept: leaf[rows], sentences))
        asked = jax.tree.map(lambda leaf, rows=left_out: leaf[rows], sentences)
        found[seed, left_out] = probabilities(state.params, asked)
    return LeftOut(found, style)


def run(arguments: Arguments) -> LeftOut:
    """Loads the environment's sentences and cross-validates them.

    Raises:
        UserError: there are no such environment, sentences or weights, or they do not fit.
    """
    with as_user_error(ValueError, bert_weights.EncoderWeightsError):
        env = envs.make(arguments.environment)
        instructions = load_instructions(arguments.environment, env.style_names)
        encoder = bert_weights.load_encoder(arguments.encoder or None)
        tokenizer = bert_weights.load_tokenizer(arguments.encoder or None)
        config = arguments.translator
        wordings = [sentence for style in instructions.values() for sentence in style.train]
        styles = [i for i, style in enumerate(instructions.values()) for _ in style.train]
        tokens = bert_weights.tokenize(tokenizer, wordings, config.maximum_length)
        sentences = translator.prepare_sentences(encoder, config, *tokens, np.array(styles))
    return cross_validate(encoder, config, sentences, folds=arguments.folds, seeds=arguments.seeds)


def print_left_out(console: Console, arguments: Arguments, found: LeftOut) -> None:
    """Prints the share of right answers by style, and each sentence that was ever mistaken."""
    env = envs.make(arguments.environment)
    instructions = load_instructions(arguments.environment, env.style_names)
    wordings = [sentence for style in instructions.values() for sentence in style.train]
    machine = ", ".join(f"{name} {value}" for name, value in describe_machine().items())
    title = f"{arguments.environment}: styles told from sentences left out"
    table = Table("style", "told right", title=title, caption=machine)
    for i, name in enumerate(env.style_names):
        table.add_row(name, f"{found.right[:, found.style == i].mean():.2f}")
    console.print(table)
    for i, wording in enumerate(wordings):
        wrong = found.probability[~found.right[:, i], i].argmax(-1)
        if len(wrong):
            names = ", ".join(env.style_names[taken] for taken in sorted(set(wrong.tolist())))
            console.print(f'"{wording}" is taken for {names} ({len(wrong)} of {arguments.seeds})')
    console.print(
        f"Told right: {found.right.mean():.3f} of {found.right.size}; mean negative "
        f"log-likelihood {found.negative_log_likelihood:.3f}."
    )


@main_guard
def main() -> None:
    """Entry point of `python -m experiments.sentences`."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.sentences", description=__doc__)
    devices.prepare()
    print_left_out(Console(), arguments, run(arguments))


if __name__ == "__main__":
    main()
