"""Makes a run of a record, to put further methods beside the recorded ones.

    python -m experiments.restore docs/comparisons/overcooked/crossway
    python -m experiments.compare runs/overcooked-crossway-quick-0-recorded --methods --add mine.py

The run has the recorded players, partners to learn with and held-out ones, and the recorded
results of all methods, so that a new one is compared with the very same partners and nothing needs
to be trained first. It has no policy VAE, diffusion and translator: ablations of Haland need a run
of one's own (python -m experiments.run).
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from experiments import devices
from experiments.compared import COMPARED, PLAYERS, STAGE
from experiments.errors import UserError, as_user_error, main_guard
from experiments.run_all import default_path
from experiments.run_folder import RunFolder

RESTORED = ("partners", "best_responses", "task_language")
"""The stages that a record's players stand for."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make a run of a record, to put further methods beside the recorded ones."""

    record: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORD")]
    """Folder of a record with players, such as docs/comparisons/lbf/spread."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder; runs/<environment>-<preset>-<seed>-recorded by default."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.restore")
    devices.prepare()
    path = restore(arguments.record, arguments.out)
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"Run: {path}")
    console.print(f"Next: python -m experiments.compare {path} --methods --add FILE")


def restore(record: Path, out: Path | None = None) -> Path:
    """Makes the run; see the module.

    Args:
        record: folder of a record with players.
        out: the run folder, which must not be there.

    Returns:
        The run folder.

    Raises:
        UserError: there are no players, they do not fit this version, or `out` exists.
    """
    from experiments import players, report
    from experiments.finished_run import configuration_from
    from experiments.stages import Run

    arrays, texts = players.read(record / PLAYERS)
    file = record / "results.json"
    if not file.is_file():
        raise UserError(f"{file} is missing; name a record made by python -m experiments.record")
    results = json.loads(file.read_text(encoding="utf-8"))
    with as_user_error():
        config = configuration_from(record, texts["config"])
    path = out or default_path(config.environment, config.preset, config.seed)
    if out is None:
        path = path.with_name(f"{path.name}-recorded")
    if path.exists():
        raise UserError(f"{path} is there already; remove it, or name another folder with --out")
    with RunFolder.write(path, config) as folder:
        players.unpack_into(Run(config, folder), arrays, texts)
        for stage, metrics in methods_of(results).items():
            folder.finish_stage(stage, metrics)
        folder.write_json("results.json", results)
        for stage in RESTORED:
            folder.finish_stage(stage, {})
        report.write_report(results, path)
        folder.finish_stage("report", {})
    return path


def methods_of(results: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What `experiments.compare` kept of each method in a folder of its own, by that folder."""
    return {
        f"{STAGE}{name}": {
            **found,
            **{
                what: {shown: results[what][shown] for shown in found["by_ego"]}
                for what in ("methods", "descriptions")
            },
        }
        for name, found in results.get(COMPARED, {}).items()
    }


if __name__ == "__main__":
    main()
