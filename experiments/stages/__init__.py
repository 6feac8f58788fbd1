"""The stages of a run: each reads what earlier ones made and writes what later ones need.

A stage is a function of a `Run` and its progress; it saves its result as a checkpoint, which
the matching `load_…` restores, and returns metrics.
"""

from experiments.stages.best_responses import Archive as Archive
from experiments.stages.best_responses import load_archive as load_archive
from experiments.stages.best_responses import load_task_language as load_task_language
from experiments.stages.best_responses import make_best_responses, make_task_language
from experiments.stages.context import STAGE_NAMES as STAGE_NAMES
from experiments.stages.context import Run as Run
from experiments.stages.model import fit_diffusion, fit_policy_vae, fit_translator
from experiments.stages.model import fit_latent_diffusion as fit_latent_diffusion
from experiments.stages.model import fit_translation as fit_translation
from experiments.stages.model import load_haland as load_haland
from experiments.stages.model import load_pretrained as load_pretrained
from experiments.stages.model import load_vae as load_vae
from experiments.stages.model import prepare_instructions as prepare_instructions
from experiments.stages.population import load_population as load_population
from experiments.stages.population import make_partners
from experiments.stages.population import population_shapes as population_shapes
from experiments.stages.universal import load_universal as load_universal
from experiments.stages.universal import load_universal_in as load_universal_in
from experiments.stages.universal import train_universal
from experiments.stages.universal import train_universal_in as train_universal_in

STAGES = dict(
    zip(
        STAGE_NAMES,
        (
            make_partners,
            train_universal,
            make_best_responses,
            make_task_language,
            fit_policy_vae,
            fit_diffusion,
            fit_translator,
        ),
        strict=True,
    )
)
