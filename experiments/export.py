"""Makes a finished run into a bundle that `generate` and `evaluate` use without training.

    python -m experiments.export RUN
    python -m experiments.export RUN --out FOLDER

By default the bundle goes to where `--run pretrained:ENV` finds it. It is read back and measured
beside the run itself before it is put there.
"""

import dataclasses
import datetime
import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from experiments import devices
from experiments.errors import UserError, main_guard

MEGABYTE = 1_000_000


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Store what a finished run made as a small bundle, and say what was lost by it."""

    run: tyro.conf.Positional[Path]
    """Folder of a finished run."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Where the bundle goes; by default to the package's own."""
    limit: float = 12.0
    """Largest size of the bundle, in megabytes."""
    games: int = 8
    """Games of each pair when the bundle is compared with the run."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.export")
    devices.prepare()
    if arguments.games < 1:
        raise UserError(f"games is {arguments.games}; expected at least 1")
    from haland_jax import pretrained

    with tempfile.TemporaryDirectory() as temporary:
        made = Path(temporary) / "bundle"
        environment, table = export(arguments.run, made, arguments.limit, arguments.games)
        out = arguments.out or pretrained.FOLDER / environment
        out.mkdir(parents=True, exist_ok=True)
        for file in sorted(made.iterdir()):
            shutil.copyfile(file, out / file.name)
    console = Console()
    console.print(table)
    console.print(f"Bundle: {out}", highlight=False)
    if arguments.out is None:
        console.print(
            f'Next: python -m experiments.generate --run pretrained:{environment} "I …"',
            highlight=False,
        )


def export(path: Path, folder: Path, limit: float, games: int) -> tuple[str, Table]:
    """Writes the bundle of a run into a folder and measures it.

    Args:
        path: folder of a finished run.
        folder: where the bundle goes.
        limit: its largest size in megabytes.
        games: games of each pair in the comparison.

    Returns:
        The environment's name, and a table of sizes and losses.

    Raises:
        UserError: the run is not finished, its encoder is a folder of this machine, or the
            bundle is too large.
    """
    from experiments import bundle_card
    from experiments.finished_run import open_run
    from experiments.models import model_of_run
    from haland_jax import bert_weights, pretrained

    run = open_run(path)
    if Path(run.config.encoder).is_dir() and run.config.encoder:
        raise UserError(
            f"the run in {path} was fine-tuned from the folder {run.config.encoder}, which others "
            "do not have; only a run with the packaged encoder or one of the hub can be exported"
        )
    model = model_of_run(path)
    about: dict[str, Any] = {
        "encoder": run.config.encoder,
        "run": run.folder.configuration,
        "exported": datetime.date.today().isoformat(),
    }
    if (run.folder.path / "results.json").is_file():
        about["results"] = bundle_card.mean_returns(run.folder.read_json("results.json"))
    encoder = bert_weights.load_encoder(run.config.encoder or None)
    sizes = pretrained.write(folder, model, encoder, about)
    sizes["configuration"] = (folder / pretrained.CONFIGURATION).stat().st_size
    total = sum(file.stat().st_size for file in folder.iterdir())
    if total > limit * MEGABYTE:
        largest = ", ".join(
            f"{name} {size / MEGABYTE:.1f} MB"
            for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:4]
        )
        raise UserError(
            f"the bundle would take {total / MEGABYTE:.1f} MB (largest: {largest}), more than "
            f"{limit:g} MB; store less, or raise --limit"
        )
    losses = bundle_card.measure_losses(model, pretrained.read(folder), games)
    card = bundle_card.card(model.env.name, about, sizes, losses)
    (folder / "card.md").write_text(card, encoding="utf-8")
    return model.env.name, bundle_card.table_of(model.env.name, sizes, losses)


if __name__ == "__main__":
    main()
