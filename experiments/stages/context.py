"""What every stage is given."""

import dataclasses
from pathlib import Path
from typing import Any

import jax

import envs
from envs.instructions import Instructions, load_instructions
from experiments.configs import RunConfig
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
        """The packaged sentences, in the order of the styles."""
        return load_instructions(self.config.environment, self.env.style_names)

    def path(self, stage: str, name: str) -> Path:
        """Where a checkpoint of a stage lies."""
        return self.folder.stage_path(stage) / name
