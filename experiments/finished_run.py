"""Opens a run that was made earlier, to generate policies from it."""

from pathlib import Path
from typing import Any

from experiments.configs import PRESETS, RunConfig
from experiments.earlier import with_later_settings
from experiments.errors import UserError, as_user_error
from experiments.run_folder import RunFolder
from experiments.stages import STAGE_NAMES, Run
from haland_jax.configuration import filled


def open_run(path: Path, stages: tuple[str, ...] = STAGE_NAMES) -> Run:
    """Opens a run whose policy-making stages are all finished.

    Args:
        path: the run folder.
        stages: those that are needed; all by default.

    Raises:
        UserError: there is no finished run, or it was made by another version's preset.
    """
    folder = RunFolder.read(path, stages)
    with as_user_error():
        return Run(configuration_from(path, folder.configuration), folder)


def configuration_from(path: Path, stored: dict[str, Any]) -> RunConfig:
    """The run's configuration as dataclasses, from its config.json.

    Raises:
        UserError: it was made by another version's preset.
    """
    template = PRESETS.get(stored.get("preset", ""))
    if template is None:
        raise UserError(
            f"the run in {path} has the preset {stored.get('preset')!r}; expected one of "
            f"{', '.join(PRESETS)}"
        )
    try:
        known = template(stored["environment"], stored["seed"])
        return filled(known, with_later_settings(stored))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"config.json of the run in {path} does not fit this version ({error}); make the run "
            "again"
        ) from error
