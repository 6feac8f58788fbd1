"""Keeps what a reader needs of finished runs, and makes the page that compares them.

    python -m experiments.record runs/*-overnight-0     record these runs in docs/results
    python -m experiments.record                        make pages and reports anew, from what is
                                                        recorded, as after new remarks
    python -m experiments.record runs/*-quick-0 --out docs/comparisons --readme None --players

Each run goes to docs/results/<environment>/: results.json, the report and the figures that are made
of it, one or two episodes and, if asked for, the players. docs/results/README.md is made from all
that is recorded there, and so is the table in the README between its two markers. Where other
methods were compared, the paper's figures that show them are drawn too, from all that is recorded.
Remarks by hand go to docs/results/remarks.md, which is included; everything else in that folder is
written by this command.
"""

import dataclasses
import io
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import tyro
from PIL import Image
from rich.console import Console

from experiments import report, results_page
from experiments.compared import COMPARED, PLAYER_STAGES, PLAYERS
from experiments.errors import UserError, main_guard
from experiments.figures import draw_figures
from experiments.overview import overview
from experiments.reading import read_runs
from experiments.run_folder import RunFolder
from experiments.standing import overall_shares

OUT = Path("docs/results")
LIMIT_BYTES = 4_000_000
DIGITS = 7
"""As many as single precision has."""
EPISODES = 2
FIGURES = "figures"
"""The folder of the figures that show all recorded runs."""
COMPARING = ("figure_3", "figure_4", "figure_6a", "universal_learning", "table_1")
"""The paper's figures that show other methods."""
_COLOURS = 128
_MARKERS = ("<!-- results -->", "<!-- /results -->")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Record finished runs for readers: results, report, figures and a few episodes.

    A run replaces what was recorded of its environment. Without runs, only pages and reports are
    made anew from what is recorded.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders of finished runs, at most one for each environment."""
    out: Path = OUT
    """Folder of the recorded results."""
    readme: Path | None = Path("README.md")
    """File whose table between the markers <!-- results --> and <!-- /results --> is written; None
    for records that the README does not show."""
    players: bool = False
    """Record the players too, so that others can compare methods with the very same partners
    (python -m experiments.restore)."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.record")
    changed = record(arguments.runs, arguments.out, arguments.readme, arguments.players)
    console = Console(highlight=False)
    for path in changed:
        console.print(f"written: {path}", soft_wrap=True)
    if not changed:
        console.print("nothing has changed")


def record(
    runs: Sequence[Path], out: Path, readme: Path | None, players: bool = False
) -> list[Path]:
    """Records the runs and makes the pages; the runs are checked before anything is written.

    Args:
        runs: folders of finished runs.
        out: folder of the recorded results.
        readme: file with the two markers, if any.
        players: whether to record the players too.

    Returns:
        The files that changed; empty if everything was up to date.

    Raises:
        UserError: a run is unfinished or too large, two are of one environment, nothing is
            recorded, or the README lacks its markers.
    """
    if readme is not None:
        _split_readme(readme)
    recorded: dict[str, dict[PurePosixPath, bytes]] = {}
    for path in runs:
        environment, files = recorded_files(path, players)
        if environment in recorded:
            raise UserError(f"{path} is a second run of {environment}; record one of each")
        recorded[environment] = files
    changed = []
    for environment, files in recorded.items():
        folder = out / environment
        changed += [f for f in _stale_files(folder, files) if _remove(f)]
        changed += [folder / name for name, data in files.items() if _write(folder / name, data)]
    runs_here = read_recorded(out)
    for run in runs_here:
        changed += make_report(run, out / run["environment"])
    overviews = [overview(run) for run in runs_here]
    drawn = drawn_comparisons(runs_here, out)
    remarks = out / "remarks.md"
    page = results_page.page(
        overviews,
        remarks.read_text(encoding="utf-8") if remarks.is_file() else "",
        next((_relative(file, out) for file in drawn if file.stem == "figure_3"), ""),
        _options(out, readme),
        overall_shares([run for run in runs_here if COMPARED in run]),
    )
    changed += [out / "README.md"] if _write(out / "README.md", page.encode()) else []
    changed += [file for file, data in drawn.items() if _write(file, data)]
    earlier = sorted((out / FIGURES).glob("*.png"))
    changed += [file for file in earlier if file not in drawn and _remove(file)]
    if readme is None:
        return changed
    before, after = _split_readme(readme)
    table = results_page.short_table(overviews, _relative(out, readme.parent))
    text = f"{before}{_MARKERS[0]}\n\n{table}\n\n{_MARKERS[1]}{after}"
    return [*changed, readme] if _write(readme, text.encode()) else changed


def recorded_files(path: Path, players: bool = False) -> tuple[str, dict[PurePosixPath, bytes]]:
    """What is kept of a run: its environment, and the content of each file.

    Args:
        path: folder of a finished run.
        players: whether its players are kept too.

    Raises:
        UserError: the run is unfinished, or its results are larger than the limit.
    """
    folder = RunFolder.read(path, ("report",))
    results = rounded(without_paths(folder.read_json("results.json")))
    overview(results)
    files = {PurePosixPath("results.json"): (json.dumps(results, indent=1) + "\n").encode()}
    used = _size(files)
    if used > LIMIT_BYTES:
        raise UserError(
            f"the results of {path} have {used:,} bytes; expected at most {LIMIT_BYTES:,}"
        )
    styles = results["styles"]
    for style in styles[:: -(-len(styles) // EPISODES)]:
        file = path / "figures" / "episodes" / f"{style}.gif"
        if file.is_file() and used + file.stat().st_size <= LIMIT_BYTES:
            files[PurePosixPath("figures", "episodes", file.name)] = file.read_bytes()
            used += file.stat().st_size
    if players:
        from experiments.finished_run import open_run
        from experiments.players import packed

        files[PurePosixPath(PLAYERS)] = packed(open_run(path, PLAYER_STAGES))
    return results["environment"], files


def make_report(results: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draws the figures of a record and writes its report, from its results.

    Args:
        results: the recorded results.
        folder: where they are recorded, with the episodes.

    Returns:
        The files that changed.
    """
    figures = folder / "figures"
    with tempfile.TemporaryDirectory() as temporary:
        drawn = {
            figures / file.name: _with_fewer_colours(file)
            for file in draw_figures(results, temporary)
        }
    earlier = [file for file in sorted(figures.glob("*.png")) if file not in drawn]
    changed = [file for file in earlier if _remove(file)]
    changed += [file for file, data in drawn.items() if _write(file, data)]
    text = report.report_text(results, folder, list(drawn))
    return changed + ([folder / "report.md"] if _write(folder / "report.md", text.encode()) else [])


def without_paths(value: Any) -> Any:
    """The results with absolute paths, which only mean something on one machine, made names."""
    if isinstance(value, dict):
        return {key: without_paths(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_paths(item) for item in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def rounded(value: Any) -> Any:
    """The results with numbers of `DIGITS` digits, which halves the file."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def read_recorded(out: Path) -> list[dict[str, Any]]:
    """The results of all recorded environments, by name.

    Raises:
        UserError: nothing is recorded, or a file is damaged.
    """
    files = sorted(out.rglob("results.json"))
    if not files:
        raise UserError(f"nothing is recorded in {out}; name the folders of finished runs")
    return read_runs([file.parent for file in files])


def _options(out: Path, readme: Path | None) -> str:
    """What a command has to say that records what is recorded here."""
    said = "" if out == OUT else f" --out {out.as_posix()}"
    said += " --readme None" if readme is None else ""
    return said + (" --players" if any(out.rglob(PLAYERS)) else "")


def drawn_comparisons(recorded: Sequence[Mapping[str, Any]], out: Path) -> dict[Path, bytes]:
    """The paper's figures that compare methods, by their places; none where none were compared."""
    from experiments.figures import paper

    runs = [run for run in recorded if COMPARED in run]
    if not runs:
        return {}
    with tempfile.TemporaryDirectory() as temporary:
        paper.draw_paper(runs, Path(temporary), COMPARING)
        return {
            out / FIGURES / file.name: _with_fewer_colours(file)
            for file in sorted(Path(temporary).glob("*.png"))
        }


def _with_fewer_colours(file: Path) -> bytes:
    """The picture as a PNG with a palette: a third of the size, and no difference to see."""
    with Image.open(file) as picture:
        flat = Image.new("RGB", picture.size, "white")
        with_alpha = picture.convert("RGBA")
        flat.paste(with_alpha, mask=with_alpha)
    written = io.BytesIO()
    flat.quantize(_COLOURS, dither=Image.Dither.NONE).save(written, "PNG", optimize=True)
    return written.getvalue()


def _size(files: Mapping[PurePosixPath, bytes]) -> int:
    return sum(len(data) for data in files.values())


def _stale_files(folder: Path, files: Mapping[PurePosixPath, bytes]) -> list[Path]:
    """Episodes and players of an earlier record that the new one does not have."""
    return [
        file
        for file in (*sorted((folder / "figures" / "episodes").glob("*.gif")), folder / PLAYERS)
        if file.is_file() and PurePosixPath(file.relative_to(folder).as_posix()) not in files
    ]


def _remove(file: Path) -> bool:
    file.unlink()
    return True


def _write(file: Path, data: bytes) -> bool:
    """Writes the file if that changes it; says whether it did."""
    if file.is_file() and file.read_bytes() == data:
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)
    return True


def _split_readme(readme: Path) -> tuple[str, str]:
    """The text before the first marker and after the second."""
    if not readme.is_file():
        raise UserError(f"{readme} is missing; name the README with --readme")
    before, first, rest = readme.read_text(encoding="utf-8").partition(_MARKERS[0])
    _, second, after = rest.partition(_MARKERS[1])
    if not first or not second:
        raise UserError(
            f"{readme} lacks the markers {_MARKERS[0]} and {_MARKERS[1]}; write them where the "
            "table of results belongs"
        )
    return before, after


def _relative(path: Path, start: Path) -> str:
    """The path as a link in a file in `start`."""
    return Path(os.path.relpath(path, start)).as_posix()


if __name__ == "__main__":
    main()
