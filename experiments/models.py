"""Opens trained models by name: a finished run's folder, or one that comes with the package."""

from pathlib import Path

import jax

from envs.instructions import Instructions, load_instructions
from experiments.configs import DEFAULT_ENVIRONMENT
from experiments.errors import UserError, as_user_error, choose
from haland_jax import pretrained
from haland_jax.bert_weights import EncoderWeightsError
from haland_jax.pretrained import TrainedModel

PREFIX = "pretrained:"
DEFAULT_MODEL = PREFIX + DEFAULT_ENVIRONMENT


def open_model(name: str) -> TrainedModel:
    """A trained model.

    Args:
        name: folder of a finished run, or `pretrained:` and an environment.

    Raises:
        UserError: there is no such run, or it is not finished; or no such pretrained model.
        BundleError: the pretrained model's bundle is damaged or does not fit.
    """
    if name.startswith(PREFIX):
        environment = choose("pretrained model", name.removeprefix(PREFIX), pretrained.names())
        with as_user_error(EncoderWeightsError):
            return pretrained.load(environment)
    if name in pretrained.names() and not Path(name).exists():
        raise UserError(f"{name} is no folder of a run; the package's model is {PREFIX}{name}")
    return model_of_run(Path(name))


def model_of_run(path: Path) -> TrainedModel:
    """The model that a finished run made.

    Raises:
        UserError: there is no finished run at `path`.
    """
    # What only a run's folder needs takes seconds to import.
    from experiments.finished_run import open_run
    from experiments.stages import (
        load_archive,
        load_haland,
        load_population,
        load_task_language,
        load_universal,
    )
    from haland_jax.universal import TOLD_NOTHING

    run = open_run(path)
    language = load_task_language(run)
    untold = load_universal(run)[TOLD_NOTHING].actor  # [style, seed]; the same for all styles
    return TrainedModel(
        env=run.env,
        haland=load_haland(run),
        held_out_partners=load_population(run).held_out_partners,
        oracles=load_archive(run).oracles,
        event_names=language.event_names,
        event_scale=language.scale,
        universal=jax.tree.map(lambda leaf: leaf[0], untold),
    )


def instructions_of(model: TrainedModel) -> dict[str, Instructions]:
    """The packaged sentences of the model's environment, in the order of the styles."""
    return load_instructions(model.env.name, model.env.style_names)
