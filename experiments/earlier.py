"""Configurations of runs that were made before a setting was there."""

import copy
from typing import Any

_TRAININGS = (
    ("partners", "joint"),
    ("partners", "refit"),
    ("partners", "oracle"),
    ("universal", "training"),
)


def with_later_settings(stored: dict[str, Any]) -> dict[str, Any]:
    """Adds the settings that a configuration lacks, as the code of then did without them.

    So records and runs can still be opened. What a preset says today is no answer: it would claim
    of a run what it did not do.

    Args:
        stored: content of a config.json.

    Returns:
        A copy of it.
    """
    filled = copy.deepcopy(stored)
    for path in _TRAININGS:
        training: Any = filled
        for name in path:
            training = training.get(name, {})
        if training:
            training.setdefault("guidance", 0.0)
            training.setdefault("guidance_until", 0.5)
    partners = filled.get("partners", {})
    if "refit" in partners:
        partners.setdefault("universal_rate", partners["refit"]["learning_rate"])
        partners.setdefault("told_start", False)
    if "translator" in filled:
        filled["translator"].setdefault("fine_tunings", 1)
        filled.setdefault("training_sentences", 0)
    return filled
