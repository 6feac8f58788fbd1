"""Other methods beside Haland: all of them on a finished run, one of one's own, and the figures."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from refused_command import refused

from experiments import compare, configs, devices, training
from experiments.errors import UserError
from experiments.figures import __main__ as figures
from experiments.figures import paper
from experiments.methods import METHODS
from experiments.methods.base import EGOS
from experiments.progress import StageProgress
from haland_jax import checkpoint

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "docs" / "examples" / "retrieval.py"
STEPS = 8000
# All but three, which others cover: FCP's pool learns as self-play does, tests/test_cgan.py has the
# UNet as generator, tests/test_diffusion.py the clean prediction.
TRIED = tuple(
    name for name in compare.NAMES if name not in ("self-play", "cgan-unet", "no-vae-clean")
)

pytestmark = [
    pytest.mark.timeout(1500),
    pytest.mark.usefixtures("no_drawing"),
]


@pytest.fixture(scope="module", autouse=True)
def training_in_pieces():
    """The egos' few updates are done in two pieces, as hundreds are in many."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(training, "UPDATES_PER_PIECE", 6)
        yield


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch, tmp_path):
    """The commands run in the tests' process, whose devices and cache are set already."""
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    monkeypatch.chdir(tmp_path)


def run_command(monkeypatch, command, *arguments) -> None:
    monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert not stopped.value.code


@pytest.fixture(scope="module")
def compared_run(smoke_run, tmp_path_factory, no_drawing):
    """A copy of the smoke run with all methods."""
    path = Path(shutil.copytree(smoke_run, tmp_path_factory.mktemp("compared") / "run"))
    compare.measure(path, TRIED, STEPS, 2, EXAMPLE)
    return path


def read(path: Path) -> dict:
    return json.loads((path / "results.json").read_text())


def test_the_command_knows_all_methods():
    assert tuple(METHODS) == compare.NAMES


@pytest.mark.slow
def test_all_methods_are_measured_beside_haland(smoke_run, compared_run):
    before, results = read(smoke_run), read(compared_run)
    trained, descriptions = results.pop("compared"), results.pop("descriptions")
    added = {name: results["methods"].pop(name) for name in descriptions}
    assert results == before, "nothing else has changed"
    assert set(added) == {
        *("General Ego", "Instructed Ego", "Adaptive Ego", "FCP"),
        *("General Ego (MLP)", "Instructed Ego (MLP)"),
        *("CGAN (MLP)", "Without translator", "Without VAE"),
        *("Without fine-tuning", "Retrieval"),
    }
    assert set(trained) == {*TRIED, "retrieval"}
    report = (compared_run / "report.md").read_text()
    config = configs.smoke(configs.DEFAULT_ENVIRONMENT, 0)
    egos = 4 * config.evaluation.samples
    for name, by_style in added.items():
        assert list(by_style) == results["styles"]
        found = np.array([style["returns"] for style in by_style.values()])
        assert found.shape == (8, config.partners.held_out_seeds)
        assert np.isfinite(found).all()
        (method,) = (one for one in trained.values() if name in one["by_ego"])
        by_ego = np.asarray(method["by_ego"][name])
        assert by_ego.shape == (8, egos)
        np.testing.assert_allclose(by_ego.mean(axis=1), found.mean(axis=1), rtol=1e-5)
        assert f"| {name} |" in report
        assert descriptions[name] in report
    for name in ("universal", "universal-mlp", "fcp"):
        assert 0 < trained[name]["steps"] <= 1.5 * STEPS
        for curve in trained[name]["curve_returns"].values():
            assert np.shape(curve) == (2, len(trained[name]["curve_steps"]))
        kept = checkpoint.exists(compared_run / f"method_{name}" / EGOS)
        assert kept, "the trained egos stay"
    spoken = trained["no-fine-tuning"]["translations"]
    after = np.asarray(spoken["after"]["train"])
    assert np.shape(spoken["before"]["test"]) == (8, 4, after.shape[-1])
    assert np.abs(after - np.asarray(spoken["before"]["train"])).max() > 1e-3


@pytest.mark.slow
def test_what_is_measured_is_not_measured_again(compared_run, tmp_path):
    copy = Path(shutil.copytree(compared_run, tmp_path / "copy"))
    made = (copy / "results.json").read_bytes()
    compare.measure(copy, TRIED, STEPS, 2, EXAMPLE)
    assert (copy / "results.json").read_bytes() == made
    with pytest.raises(UserError, match="'fcp' with steps = 8,000 already, not 9,000; remove its"):
        compare.measure(copy, ("fcp",), 9000, 2)
    (copy / "method_fcp" / "metrics.json").unlink()
    with pytest.raises(UserError, match="steps is 5,000; fictitious co-play needs at least 7,680"):
        compare.measure(copy, ("fcp",), 5000, 2)
    with pytest.raises(UserError, match="'universal' with seeds = 2 already, not 3"):
        compare.measure(copy, ("universal",), STEPS, 3)


class Interrupted(Exception):
    """Stands for the signal that ends a command."""


@pytest.mark.slow
def test_an_interrupted_method_ends_alike(monkeypatch, smoke_run, compared_run, tmp_path):
    copy = Path(shutil.copytree(smoke_run, tmp_path / "copy"))
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    update = StageProgress.update
    heard: list[int] = []

    def end_the_second_time(task, done, metrics=None):
        heard.append(done)
        if len(heard) == 2:
            raise Interrupted
        update(task, done, metrics)

    monkeypatch.setattr(StageProgress, "update", end_the_second_time)
    with pytest.raises(Interrupted):
        compare.measure(copy, ("universal",), STEPS, 2)
    compare.measure(copy, ("universal",), STEPS, 2)
    # What was being done when it was ended is done again, and nothing before it.
    assert heard == [6, 12, 12]
    found, expected = (read(run)["compared"]["universal"] for run in (copy, compared_run))
    assert found["by_ego"] == expected["by_ego"]
    assert found["curve_returns"] == expected["curve_returns"]


@pytest.mark.slow
def test_the_figures_of_the_paper_are_drawn_from_the_results_alone(
    monkeypatch, capsys, compared_run, tmp_path
):
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(compared_run / "results.json", alone)
    run_command(monkeypatch, figures, alone, "--out", tmp_path / "drawn")
    said = capsys.readouterr().out
    assert "missing" not in said
    for name, drawing in paper.FIGURES.items():
        stem = name if drawing.together else f"{name}_diverse_coordination"
        assert (tmp_path / "drawn" / f"{stem}.png").stat().st_size > 5000, name
        assert (tmp_path / "drawn" / f"{stem}.pdf").read_bytes().startswith(b"%PDF")
    table = (tmp_path / "drawn" / "table_1_diverse_coordination.md").read_text()
    assert "| Without VAE |" in table
    assert "left no onion" in table


@pytest.mark.slow
def test_a_run_that_learnt_other_sentences_is_refused(smoke_run, tmp_path):
    copy = Path(shutil.copytree(smoke_run, tmp_path / "copy"))
    metrics = json.loads((copy / "translator" / "metrics.json").read_text())
    assert len(metrics["sentences"]) == 64
    (copy / "translator" / "metrics.json").write_text(json.dumps(metrics | {"sentences": "other"}))
    with pytest.raises(UserError, match=r"training sentences have changed .*remove .*translator"):
        compare.measure(copy, ("no-vae",), STEPS, 2)


def test_methods_that_are_none_are_refused(capsys, monkeypatch, smoke_run, tmp_path):
    line = refused(capsys, monkeypatch, compare, smoke_run, "--methods", "fpc")
    assert "did you mean 'fcp'?" in line
    line = refused(capsys, monkeypatch, compare, smoke_run, "--methods")
    assert "methods is empty" in line
    line = refused(capsys, monkeypatch, compare, smoke_run, "--seeds", 0)
    assert "seeds is 0; expected at least 1" in line
    own = tmp_path / "own.py"
    line = refused(capsys, monkeypatch, compare, smoke_run, "--methods", "--add", own)
    assert "own.py is missing" in line
    own.write_text("METHODS = {}")
    line = refused(capsys, monkeypatch, compare, smoke_run, "--methods", "--add", own)
    assert "defines no METHODS" in line
    own.write_text("METHODS = {'fcp': None}")
    line = refused(capsys, monkeypatch, compare, smoke_run, "--methods", "--add", own)
    assert "'fcp', which is one of ours" in line
