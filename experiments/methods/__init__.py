"""The methods that `python -m experiments.compare` puts beside Haland, by their names there."""

from experiments.methods.ablations import WithoutDiffusion, WithoutTranslator, WithoutVAE
from experiments.methods.base import Given as Given
from experiments.methods.base import Method
from experiments.methods.base import Told as Told
from experiments.methods.base import Trained as Trained
from experiments.methods.fine_tuning import WithoutFineTuning
from experiments.methods.self_play import FictitiousCoPlay, SelfPlay
from experiments.methods.universal import FeedForwardEgos, RecurrentEgos

BASELINES: dict[str, Method] = {
    "universal": RecurrentEgos(),
    "universal-mlp": FeedForwardEgos(),
    "self-play": SelfPlay(),
    "fcp": FictitiousCoPlay(),
}
"""Egos for all styles; they learn with partners."""
ABLATIONS: dict[str, Method] = {
    "cgan-mlp": WithoutDiffusion("mlp"),
    "cgan-unet": WithoutDiffusion("unet"),
    "no-translator": WithoutTranslator(),
    "no-vae": WithoutVAE(),
    "no-vae-clean": WithoutVAE(clean=True),
    "no-fine-tuning": WithoutFineTuning(),
}
"""Haland without a part (Table 1); they need no games."""
METHODS = {**BASELINES, **ABLATIONS}
