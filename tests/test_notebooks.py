"""The notebooks run from top to bottom, and what is committed of them is fit to be read."""

import itertools
import os
import re
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "docs" / "notebooks").glob("*.ipynb"))
LARGEST = 1_500_000
MACHINE_PATH = re.compile(
    r"(?<![\w.:/])/(home|root|tmp|usr|opt|work|mnt|var|Users|private)/|[A-Z]:\\\\|site-packages"
)


def code_cells(notebook) -> list:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts_of(output) -> list[str]:
    """What an output shows as text."""
    data = output.get("data", {})
    shown = [value for kind, value in data.items() if not kind.startswith("image/")]
    return [str(text) for text in (*shown, output.get("text", ""), output.get("traceback", ""))]


def test_there_is_a_notebook():
    assert [path.name for path in NOTEBOOKS] == ["rollouts.ipynb"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("/home/ada/runs", True),
        ("in '/tmp/x.gif'", True),
        ("python3.11/site-packages/jax", True),
        ("C:\\\\Users", True),
        ("steps/s", False),
        ("overcooked/crossway", False),
        ("https://example.org/home/", False),
    ],
)
def test_paths_of_a_machine_are_recognised(text, found):
    assert bool(MACHINE_PATH.search(text)) == found


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_committed_outputs_are_whole_small_and_from_no_machine(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < LARGEST
    cells = code_cells(notebook)
    numbers = [cell.execution_count for cell in cells]
    assert numbers == list(range(1, len(cells) + 1)), "executed once, from top to bottom"
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    for output in outputs:
        for text in texts_of(output):
            assert not MACHINE_PATH.search(text), text


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_the_notebook_runs_from_top_to_bottom(path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", os.environ.get("JAX_PLATFORMS", "cpu"))
    committed = nbformat.read(path, as_version=4)
    notebook = nbformat.read(path, as_version=4)
    for cell in code_cells(notebook):
        cell.outputs, cell.execution_count = [], None
    folder = {"metadata": {"path": str(path.parent)}}
    # Raises CellExecutionError, with the cell and its traceback, at the first cell that fails.
    nbclient.NotebookClient(
        notebook, kernel_name="python3", timeout=500, resources=folder
    ).execute()
    for before, after in zip(code_cells(committed), code_cells(notebook), strict=True):
        assert kinds_of(before) == kinds_of(after)


def kinds_of(cell) -> list[list[str]]:
    """What kinds of outputs a cell has; how its printing is cut into pieces varies."""
    kinds = [sorted(o.get("data", {})) or [o.output_type] for o in cell.outputs]
    return [kind for kind, _ in itertools.groupby(kinds)]
