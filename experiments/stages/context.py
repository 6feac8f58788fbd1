"""What every stage is given."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax

import envs
from envs.instructions import Instructions, load_instructions
from experiments.configs import RunConfig
from experiments.errors import UserError
from experiments.run_folder import RunFolder

STAGE_NAMES = (
    "partners",
    "universal",
    "best_responses",
    "task_language",
    "policy_vae",
    "diffusion",
    "translator",
)

SENTENCES = "sentences"
"""Where the metrics of the translator's stage keep the digest of its training sentences."""
STAGES_OF_SENTENCES = ("translator", "evaluation", "report")
"""What depends on the sentences."""


@dataclasses.dataclass
class Run:
    """A run: its configuration, its folder and its environment."""

    config: RunConfig
    folder: RunFolder

    def __post_init__(self):
        self.env: Any = envs.make(self.config.environment, max_steps=self.config.max_steps)

    def key(self, stage: str) -> jax.Array:
        """The stage's own key: the same whichever stages ran before in this process."""
        root = jax.random.key(self.config.seed)
        return jax.random.fold_in(root, STAGE_NAMES.index(stage))

    def instructions(self) -> dict[str, Instructions]:
        """The packaged sentences, in the order of the styles, of `train` those that it uses."""
        packaged = load_instructions(self.config.environment, self.env.style_names)
        most = self.config.training_sentences
        if not most:
            return packaged
        return {
            style: sentences._replace(train=sentences.training_sample(most))
            for style, sentences in packaged.items()
        }

    def sentences_digest(self) -> str:
        """SHA-256 of the run's training sentences, in the order of the styles."""
        sentences = [style.train for style in self.instructions().values()]
        return hashlib.sha256(json.dumps(sentences).encode()).hexdigest()

    def expect_learnt_sentences(self) -> None:
        """Makes sure that the translator has learnt from the packaged training sentences.

        Raises:
            UserError: it has learnt from others, those of another version.
        """
        # A run from before this was noted does not say.
        learnt = self.folder.stage_metrics("translator").get(SENTENCES)
        if learnt not in (None, self.sentences_digest()):
            folders = ", ".join(str(self.folder.path / n) for n in STAGES_OF_SENTENCES)
            raise UserError(
                "the training sentences have changed since the translator of this run learnt from "
                f"them; remove {folders}, and the folders of its methods, and continue the run"
            )

    def path(self, stage: str, name: str) -> Path:
        """Where a checkpoint of a stage lies."""
        return self.folder.stage_path(stage) / name
