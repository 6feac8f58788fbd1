"""What `experiments.compare` adds to a run's results: kept by method, joined into results.json."""

from typing import Any

from experiments.errors import UserError
from experiments.run_folder import RunFolder
from experiments.summary import COMPARISONS, METHODS

NAMES = (
    *("universal", "universal-mlp", "self-play", "fcp"),
    *("cgan-mlp", "cgan-unet", "no-translator", "no-vae", "no-vae-clean", "no-fine-tuning"),
)
"""The methods that come with the project."""
COMPARED = "compared"
"""Where results.json says what the methods were trained with."""
PLAYERS = "players.safetensors"
"""The file of a record that has the players."""
PLAYER_STAGES = ("partners", "best_responses", "task_language")
"""The stages of a run that its players stand for."""
STAGE = "method_"
"""What the folders of methods begin with."""


def with_compared(results: dict[str, Any], folder: RunFolder) -> dict[str, Any]:
    """The results with all methods that were compared in the run.

    Args:
        results: content of results.json; what it has of compared methods is replaced.
        folder: the run.

    Raises:
        UserError: two methods show the same name.
    """
    results = {**results, "methods": dict(results["methods"])}
    for shown in results.pop("descriptions", {}):
        results["methods"].pop(shown, None)
    results.pop(COMPARED, None)
    stages = [path.parent.name for path in sorted(folder.path.glob(f"{STAGE}*/metrics.json"))]
    descriptions: dict[str, str] = {}
    compared: dict[str, Any] = {}
    for stage in stages:
        found = dict(folder.stage_metrics(stage))
        name, measured = stage.removeprefix(STAGE), found.pop("methods")
        for shown in measured:
            if shown in results["methods"]:
                raise UserError(
                    f"the method '{name}' calls an ego '{shown}', which another method has; rename "
                    f"it, and remove the run's folder '{stage}'"
                )
        results["methods"] |= measured
        descriptions |= found.pop("descriptions")
        compared[name] = found
    return {**results, "descriptions": descriptions, COMPARED: compared} if compared else results


def refuse_taken_names(name: str, shown: list[str]) -> None:
    """Checks that a method does not show the name of one that every run has.

    Raises:
        UserError: it does.
    """
    taken = [one for one in shown if one in (*METHODS, *COMPARISONS)]
    if taken:
        raise UserError(
            f"the method '{name}' calls an ego '{taken[0]}', as the run does; rename it"
        )
