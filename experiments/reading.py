"""Reads the results of several runs."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.errors import UserError


def read_runs(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """The results of runs, in the order of their environments' names.

    Raises:
        UserError: a folder has no results.json, it is damaged, or two are of one environment.
    """
    found: dict[str, dict[str, Any]] = {}
    for folder in folders:
        file = folder / "results.json"
        try:
            results = json.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise UserError(
                f"{file} cannot be read ({error.strerror}); name folders of runs"
            ) from None
        except ValueError as error:
            raise UserError(f"{file} is damaged ({error}); make the run again") from None
        if "environment" not in results or "methods" not in results:
            raise UserError(f"{file} holds no results of a run; name folders of runs")
        name = results["environment"]
        if name in found:
            raise UserError(f"{folder} is another run of {name}; name one of each environment")
        found[name] = results
    return [found[name] for name in sorted(found)]
