"""Makes a run of a record, to put further methods beside the recorded ones.

    python -m experiments.restore docs/comparisons/overcooked/diverse_orders
    RUN=runs/overcooked-diverse_orders-quick-6-recorded
    python -m experiments.compare $RUN --methods --add mine.py

The run has the recorded players, partners to learn with and held-out ones, and the recorded
results of all methods, so that a new one is compared with the very same partners and nothing needs
to be trained first. It has no policy VAE, diffusion and translator: ablations of Haland need a run
of one's own (python -m experiments.run).
"""

import dataclasses
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from experiments import devices, players, report
from experiments.compared import COMPARED, PLAYER_STAGES, PLAYERS, STAGE
from experiments.configs import RunConfig
from experiments.errors import UserError, as_user_error, main_guard
from experiments.run_all import default_path
from experiments.run_folder import RunFolder
from experiments.stages import Run


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make a run of a record, to put further methods beside the recorded ones."""

    record: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORD")]
    """Folder of a record with players, such as docs/comparisons/overcooked/diverse_orders."""
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
        UserError: there are no players, they do not fit this version or the results beside them,
            or `out` exists.
    """
    from experiments.finished_run import configuration_from
    from experiments.reading import read_runs

    arrays, texts = players.read(record / PLAYERS)
    (results,) = read_runs((record,))
    with as_user_error():
        config = configuration_from(record, texts["config"])
    players.expect_same_run(record, arrays, config, results)
    path = out or default_path(config.environment, config.preset, config.seed)
    if out is None:
        path = path.with_name(f"{path.name}-recorded")
    if path.exists():
        raise UserError(f"{path} is there already; remove it, or name another folder with --out")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as temporary:
        made = Path(temporary) / path.name
        _fill(made, config, record, arrays, texts, results)
        made.rename(path)
    return path


def _fill(
    path: Path,
    config: RunConfig,
    record: Path,
    arrays: Mapping[str, Any],
    texts: Mapping[str, Any],
    results: dict[str, Any],
) -> None:
    """Makes the run folder of a record."""
    with RunFolder.write(path, config) as folder:
        folder.mark_as_recorded(record.as_posix())
        players.unpack_into(Run(config, folder), arrays, texts)
        for stage, metrics in methods_of(results).items():
            folder.finish_stage(stage, metrics)
        folder.write_json("results.json", results)
        for stage in PLAYER_STAGES:
            folder.finish_stage(stage, {})
        episodes = record / "figures" / "episodes"
        if episodes.is_dir():
            shutil.copytree(episodes, path / "figures" / "episodes")
        report.write_report(results, path)
        folder.finish_stage("report", {})


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
