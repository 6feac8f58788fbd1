"""Cross-validates an environment's training sentences: is a style told from a wording left out?

    python -m experiments.sentences overcooked/crossway
    python -m experiments.sentences assistive/jaco --seeds 3 --translator.dropout 0.2
    python -m experiments.sentences lbf/spread --record docs/comparisons/lbf/spread
    python -m experiments.sentences overcooked/diverse_coordination --record RUN --asked FILE

The sentences of each style are dealt to folds. BERT is fine-tuned as in a run (Eq. 7) on all folds
but one and asked for the styles of that one, each fold in turn. With the task language of a record
or a run, the translation (Eq. 6) is fitted and asked too. So settings of the translator can be
chosen, and sentences written, without a look at the test sentences. The files in
envs/instructions say how many sentences each author wrote, one after the other; with `--authors`
each author is left out in turn, which says how a stranger will be understood. With `--asked` all of
them are learnt, and sentences from a file are asked for (docs/examples/strangers.toml has some).
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

import envs
from envs.instructions import Instructions, load_instructions, training_sentences
from experiments import devices
from experiments.errors import UserError, as_user_error, main_guard
from experiments.evaluate import read_sentences
from experiments.machine import describe_machine
from experiments.reading import read_runs
from experiments.stages import prepare_instructions
from haland_jax import bert_weights, fit, task_language, translator
from haland_jax.translator import SentenceData, TranslatorConfig


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Cross-validate an environment's training sentences."""

    environment: tyro.conf.Positional[str]
    """Name of the environment, such as assistive/jaco."""
    folds: int = 5
    """Parts that the sentences of a style are dealt to."""
    authors: tuple[int, ...] = ()
    """Leave out authors in turn instead: sentences of a style by each, such as 10 10 20."""
    asked: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Leave out none, and ask for the sentences of this TOML file instead: style = ["sentence"]."""
    seeds: int = 1
    """Repetitions, with other random minibatches, dropout and translations."""
    encoder: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = ""
    """A BERT checkpoint; the packaged one by default."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """A record or a run, whose task language the sentences left out are translated to."""
    translator: TranslatorConfig = dataclasses.field(default_factory=TranslatorConfig)
    """Settings of the translator."""


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """What was said of sentences that nothing was fitted to.

    Attributes:
        probability: the classifier's, float32 [seed, sentence, style].
        style: int [sentence], the true one.
        translated: style whose task language is nearest to the translation, int [seed, sentence];
            None where nothing was translated.
    """

    probability: np.ndarray
    style: np.ndarray
    translated: np.ndarray | None = None

    @property
    def told(self) -> np.ndarray:
        """int [seed, sentence]: by the translation, or by the classifier where there is none."""
        return self.probability.argmax(-1) if self.translated is None else self.translated

    @property
    def right(self) -> np.ndarray:
        """bool [seed, sentence]: is the true style told?"""
        return self.told == self.style

    @property
    def classified_right(self) -> np.ndarray:
        """bool [seed, sentence]: is the true style the classifier's most probable one?"""
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
    v_hat: np.ndarray | None = None,
    authors: tuple[int, ...] = (),
) -> LeftOut:
    """Fits the translator without each fold in turn.

    Args:
        encoder: the pre-trained one.
        config: settings of the translator.
        sentences: as `translator.prepare_sentences` returns them.
        folds: a style's sentence i is left out with fold i modulo `folds`.
        seeds: repetitions.
        v_hat: task language of each style, [style, U]; without it BERT alone is fine-tuned.
        authors: consecutive sentences of a style by each author, who then are the folds.

    Raises:
        UserError: fewer than two folds, more than a style has sentences, authors who have not
            written all of them, or no repetition.
    """
    style = np.asarray(sentences.style)
    fewest = int(np.bincount(style).min())
    if authors:
        folds = len(authors)
    if not 2 <= folds <= fewest:
        what = "authors" if authors else "folds"
        raise UserError(f"{what} is {folds}; expected 2 to {fewest}, the sentences of a style")
    if authors and set(np.bincount(style)) != {sum(authors)}:
        raise UserError(
            f"authors wrote {sum(authors)} sentences of a style; expected {fewest}, which it has"
        )
    _expect_repetition(seeds)
    place = np.array([np.sum(style[:i] == style[i]) for i in range(len(style))])
    number = np.repeat(np.arange(folds), authors)[place] if authors else place % folds
    fitted = _Fitted(encoder, config, int(style.max()) + 1, v_hat)
    probability = np.zeros((seeds, len(style), fitted.styles), np.float32)
    translated = None if v_hat is None else np.zeros((seeds, len(style)), int)
    rounds = list(itertools.product(range(seeds), range(folds)))
    for seed, fold in track(rounds, "Fitting without each fold in turn"):
        kept, left_out = np.flatnonzero(number != fold), np.flatnonzero(number == fold)
        learnt, asked = (
            jax.tree.map(lambda leaf, rows=rows: leaf[rows], sentences) for rows in (kept, left_out)
        )
        key = jax.random.fold_in(jax.random.key(seed), fold)
        probability[seed, left_out], styles = fitted.tell(key, learnt, asked)
        if translated is not None:
            translated[seed, left_out] = styles
    return LeftOut(probability, style, translated)


def ask(
    encoder: bert_weights.Encoder,
    config: TranslatorConfig,
    learnt: SentenceData,
    asked: SentenceData,
    *,
    seeds: int,
    v_hat: np.ndarray | None = None,
) -> LeftOut:
    """Fits the translator to some sentences and asks it for the styles of others.

    Args:
        encoder: the pre-trained one.
        config: settings of the translator.
        learnt: sentences of all styles, as `translator.prepare_sentences` returns them.
        asked: others.
        seeds: repetitions.
        v_hat: as for `cross_validate`.

    Raises:
        UserError: no repetition.
    """
    _expect_repetition(seeds)
    fitted = _Fitted(encoder, config, int(np.max(learnt.style)) + 1, v_hat)
    told = [
        fitted.tell(jax.random.key(seed), learnt, asked)
        for seed in track(range(seeds), "Fitting to all sentences")
    ]
    translated = None if v_hat is None else np.stack([np.asarray(styles) for _, styles in told])
    probability = np.stack([np.asarray(one) for one, _ in told])
    return LeftOut(probability, np.asarray(asked.style), translated)


def _expect_repetition(seeds: int) -> None:
    if seeds < 1:
        raise UserError(f"seeds is {seeds}; expected at least 1")


class _Fitted:
    """Fits translators to some sentences and asks them for the styles of others."""

    def __init__(
        self,
        encoder: bert_weights.Encoder,
        config: TranslatorConfig,
        styles: int,
        v_hat: np.ndarray | None,
    ):
        self.architecture, self.config = encoder.architecture, config
        self.styles, self.v_hat = styles, v_hat
        initial = translator.init_fine_tuning(encoder, config, styles)
        self._initial = translator.start_fine_tunings(initial, config)
        functions = translator.make_fine_tuning(encoder.architecture, config)
        self._tune = fit.make_fit_chunk(*functions, config.fine_tuning, config.fine_tuning.steps)
        functions = translator.make_translation(config)
        self._translate = fit.make_fit_chunk(
            *functions, config.translation, config.translation.steps
        )
        self._embed = jax.jit(
            lambda layers, data: translator.embed_hidden(
                layers, encoder.architecture, config, data.hidden, data.mask
            )
        )

    def tell(
        self, key: jax.Array, learnt: SentenceData, asked: SentenceData
    ) -> tuple[jax.Array, jax.Array | None]:
        """Probabilities [asked, style], and styles [asked] by the translation, if there is one."""
        keys = jax.random.split(key, 4)
        state = fit.init_fit(keys[0], self._initial, self.config.fine_tuning)
        tuned = translator.average_fine_tunings(self._tune(state, learnt)[0].params)
        embedding = self._embed(tuned["encoder"], asked)
        probability = jax.nn.softmax(
            translator.classify(tuned["classifier"], embedding, self.config)
        )
        if self.v_hat is None:
            return probability, None
        data = translator.prepare_translation(
            keys[1], tuned, self.architecture, self.config, learnt, jnp.asarray(self.v_hat)
        )
        vae = translator.init_translation(
            keys[2], self.architecture, self.config, self.v_hat.shape[-1]
        )
        state = fit.init_fit(keys[3], vae, self.config.translation)
        vae = self._translate(state, data)[0].params
        v_hat = translator.translate_embedding(vae, self.config, embedding)
        return probability, task_language.nearest_style(v_hat, jnp.asarray(self.v_hat))


def run(arguments: Arguments) -> LeftOut:
    """Loads the environment's sentences and cross-validates them, or asks for those of a file.

    Raises:
        UserError: there are no such environment, sentences, record or weights, or they do not fit.
    """
    config, v_hat, strangers = arguments.translator, None, None
    with as_user_error(ValueError, bert_weights.EncoderWeightsError):
        env = envs.make(arguments.environment)
        if arguments.record is not None:
            v_hat = _task_language(arguments.record, arguments.environment, env.style_names)
        if arguments.asked is not None:
            strangers = _asked(arguments.asked, env.style_names)
        instructions = load_instructions(arguments.environment, env.style_names)
        encoder = bert_weights.load_encoder(arguments.encoder or None)
        tokenizer = bert_weights.load_tokenizer(arguments.encoder or None)
        sentences = prepare_instructions(instructions, encoder, tokenizer, config)
        if strangers is not None:
            asked = prepare_instructions(strangers, encoder, tokenizer, config)
            return ask(encoder, config, sentences, asked, seeds=arguments.seeds, v_hat=v_hat)
    return cross_validate(
        encoder,
        config,
        sentences,
        folds=arguments.folds,
        seeds=arguments.seeds,
        v_hat=v_hat,
        authors=arguments.authors,
    )


def _asked(file: Path, style_names: tuple[str, ...]) -> dict[str, Instructions]:
    """The sentences of a file, in the order of the styles; a style may have none."""
    found = read_sentences(file, style_names)
    return {style: Instructions(tuple(found.get(style, ())), ()) for style in style_names}


def _task_language(record: Path, environment: str, style_names: tuple[str, ...]) -> np.ndarray:
    """The record's, float32 [style, U]."""
    found = read_runs([record])[0]
    if found["environment"] != environment or found["styles"] != list(style_names):
        raise UserError(
            f"the record {record} is of {found['environment']} with the styles "
            f"{', '.join(found['styles'])}; expected {environment} and {', '.join(style_names)}"
        )
    return np.array(found["task_language"]["v_hat"], np.float32)


def print_left_out(console: Console, arguments: Arguments, found: LeftOut) -> None:
    """Prints the share of right answers by style, and each sentence that was ever mistaken."""
    env = envs.make(arguments.environment)
    if arguments.asked is None:
        instructions = load_instructions(arguments.environment, env.style_names)
    else:
        instructions = _asked(arguments.asked, env.style_names)
    wordings, _ = training_sentences(instructions)
    machine = ", ".join(f"{name} {value}" for name, value in describe_machine().items())
    by = "classifier" if found.translated is None else "translation"
    title = f"{arguments.environment}: styles told by the {by} from sentences not learnt"
    table = Table("style", "told right", title=title, caption=machine)
    for i, name in enumerate(env.style_names):
        if np.any(found.style == i):
            table.add_row(name, f"{found.right[:, found.style == i].mean():.2f}")
    console.print(table)
    for i, wording in enumerate(wordings):
        wrong = found.told[~found.right[:, i], i]
        if len(wrong):
            names = ", ".join(env.style_names[taken] for taken in sorted(set(wrong.tolist())))
            console.print(f'"{wording}" is taken for {names} ({len(wrong)} of {arguments.seeds})')
    if found.translated is not None:
        console.print(f"Told right by the translation: {found.right.mean():.3f}.")
    console.print(
        f"Told right by the classifier: {found.classified_right.mean():.3f} of "
        f"{found.right.size}; mean negative log-likelihood {found.negative_log_likelihood:.3f}."
    )


@main_guard
def main() -> None:
    """Entry point of `python -m experiments.sentences`."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.sentences", description=__doc__)
    devices.prepare()
    print_left_out(Console(), arguments, run(arguments))


if __name__ == "__main__":
    main()
