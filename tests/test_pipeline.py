"""The whole method at toy size: a complete run, the commands on it, and interrupted runs.

All that needs the finished run is in this file, so that one process makes it once.
"""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from refused_command import refused

from experiments import (
    configs,
    devices,
    evaluate,
    evaluation,
    generate,
    pipeline,
    run,
    sight,
    training,
)
from experiments.pipeline import run_pipeline
from experiments.stages import STAGES
from experiments.stages.best_responses import IMAGE, OWN, UNIVERSAL
from haland_jax.universal import VARIANTS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

METHODS = {
    evaluation.ORACLE,
    evaluation.BEST_RESPONSE,
    evaluation.RECONSTRUCTION,
    evaluation.TRUE_LANGUAGE,
    evaluation.TRAINING_SENTENCES,
    evaluation.TEST_SENTENCES,
    evaluation.WRONG_SENTENCE,
    *evaluation.COMPARISONS,
}


@pytest.fixture(scope="module")
def results(smoke_run):
    return json.loads((smoke_run / "results.json").read_text())


def numbers(value) -> list[float]:
    """All numbers in nested lists and objects."""
    if isinstance(value, dict):
        return [n for item in value.values() for n in numbers(item)]
    if isinstance(value, list):
        return [n for item in value for n in numbers(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def test_results_hold_every_method_style_and_held_out_seed(results):
    config = configs.smoke(configs.DEFAULT_ENVIRONMENT, 0).partners
    styles = results["styles"]
    assert len(styles) == 8
    assert set(results["methods"]) == METHODS
    for method, by_style in results["methods"].items():
        assert list(by_style) == styles, method
        for style, values in by_style.items():
            assert len(values["returns"]) == config.held_out_seeds, (method, style)
    assert list(results["oracle"]) == styles
    assert np.shape(results["cross_play"]) == (8, 8)
    assert set(results["times"]) == {*STAGES, "evaluation"}
    assert np.shape(results["task_language"]["v_hat"]) == (
        8,
        len(results["task_language"]["events"]),
    )
    for style in styles:
        assert len(results["partners"]["joint_returns"][style]) == config.num_seeds
        curve = np.shape(results["curves"]["returns"][style])
        assert curve == (config.num_seeds, len(results["curves"]["steps"]))
    starts = results["best_responses"]
    assert set(starts["starts"]) == set(styles)
    assert (
        set(starts["starts"].values())
        <= set(starts["start_returns"])
        == {
            *(OWN, UNIVERSAL),
            *(IMAGE.format(start) for start in (OWN, UNIVERSAL)),
        }
    )
    assert np.shape(starts["kept_egos"]) == (8, config.train_seeds)
    for returns in starts["start_returns"].values():
        assert np.shape(returns) == (8, config.train_seeds)
    universal = results["universal"]
    assert (universal["steps"], universal["guided_steps"]) == (640, 0)
    for variant in VARIANTS:
        assert np.shape(universal["curve_returns"][variant]) == (2, len(universal["curve_steps"]))
    assert {"value", "bar", "met"} <= set(next(iter(results["gates"].values())))
    assert np.isfinite(numbers(results)).all()


def test_best_responses_cost_their_pairs_the_universal_egos_and_their_refits(results):
    # Of 8 styles 2 pairs of 1,280 steps; 2 universal egos of both kinds of 640 steps; 2 refits of
    # 640 from each start.
    steps = 8 * 2 * 1280 + 2 * 2 * 640 + 8 * 2 * 2 * 640
    assert results["universal"]["best_response_steps"] == steps


def as_run(config, results):
    """As much of a run as says what its best responses cost."""
    return SimpleNamespace(config=config, env=SimpleNamespace(style_names=results["styles"]))


def test_universal_egos_that_nobody_starts_from_cost_best_responses_nothing(results):
    config = configs.smoke(configs.DEFAULT_ENVIRONMENT, 0)

    def steps(**changes) -> int:
        changed = dataclasses.replace(config.partners, **changes)
        made = as_run(dataclasses.replace(config, partners=changed), results)
        return pipeline._universal(made, results["universal"])["best_response_steps"]

    assert steps() - steps(told_start=True) == 2 * 640
    refits = 8 * 2 * 640
    assert steps() - steps(universal_start=False) == 2 * 2 * 640 + refits


def test_egos_of_a_run_from_before_guidance_were_not_guided(results):
    made = as_run(configs.smoke(configs.DEFAULT_ENVIRONMENT, 0), results)
    earlier = {k: v for k, v in results["universal"].items() if k != "guided_steps"}
    assert pipeline._universal(made, earlier) == results["universal"]


def test_the_run_folder_is_complete(smoke_run, results):
    for stage in (*STAGES, "evaluation", "report"):
        assert (smoke_run / stage / "metrics.json").is_file(), stage
    report = (smoke_run / "report.md").read_text()
    assert results["styles"][0] in report.replace(" ", "_")
    assert len(list((smoke_run / "figures").glob("*.png"))) >= 4
    assert any((smoke_run / "tensorboard").iterdir())
    assert (smoke_run / "log.jsonl").stat().st_size > 0
    for style in results["styles"]:
        with Image.open(smoke_run / "figures" / "episodes" / f"{style}.gif") as episode:
            assert episode.n_frames > 1


def run_command(monkeypatch, command, *arguments) -> None:
    monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert not stopped.value.code


def test_evaluate_measures_sentences_of_ones_own(monkeypatch, capsys, smoke_run, tmp_path):
    own, out = tmp_path / "mine.toml", tmp_path / "out.json"
    own.write_text('left_no_onion = ["I cook on the left.", "Bring me onions."]')
    arguments = ("--run", smoke_run, "--instructions", own, "--json", out, "--games", 4)
    run_command(monkeypatch, evaluate, *arguments)
    found = json.loads(out.read_text())
    assert list(found["styles"]) == ["left_no_onion"]
    sentences = found["styles"]["left_no_onion"]["sentences"]
    assert [s["sentence"] for s in sentences] == ["I cook on the left.", "Bring me onions."]
    assert "left_no_onion" in capsys.readouterr().out
    first = out.read_bytes()
    run_command(monkeypatch, evaluate, *arguments)
    assert out.read_bytes() == first, "the same seed gives the same result"


def test_generate_plays_an_episode_and_draws_it(monkeypatch, capsys, smoke_run, tmp_path):
    gif = tmp_path / "episode.gif"
    run_command(monkeypatch, generate, "--run", smoke_run, "I will cook on the left", "--gif", gif)
    shown = capsys.readouterr().out
    assert "I will cook on the left" in shown
    assert "ms" in shown
    with Image.open(gif) as episode:
        assert episode.n_frames > 1


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch, tmp_path):
    """The commands run in the tests' process, whose devices and cache are set already."""
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def copied_run(smoke_run, tmp_path):
    """A copy of the smoke run that a test may damage."""
    return Path(shutil.copytree(smoke_run, tmp_path / "copy"))


def test_sight_adds_egos_that_see_the_partner_nearby(monkeypatch, capsys, copied_run, results):
    run_command(monkeypatch, sight, copied_run, "--cells", 1)
    assert "1 cell away" in capsys.readouterr().out
    found = json.loads((copied_run / "results.json").read_text())
    (measured,) = found.pop("partner_sight")
    assert found == results
    assert measured["cells"] == 1
    assert set(measured["methods"]) == set(evaluation.COMPARISONS)
    assert all(
        np.shape(by_style["left_no_onion"]["returns"]) == (1,)
        for by_style in measured["methods"].values()
    )
    assert "| 1 cell away |" in (copied_run / "report.md").read_text()
    # Neither the same command nor the run's own makes or loses any of it.
    made = (copied_run / "results.json").read_bytes()
    run_command(monkeypatch, sight, copied_run, "--cells", 1)
    run_command(monkeypatch, run, "--preset", "smoke", "--out", copied_run)
    assert (copied_run / "results.json").read_bytes() == made


def test_sight_refuses_what_is_no_distance(capsys, monkeypatch, smoke_run):
    line = refused(capsys, monkeypatch, sight, smoke_run, "--cells", 2, -1)
    assert "cells is -1; expected numbers from 0 up" in line


def test_a_sentence_must_hold_words_and_not_too_many(capsys, monkeypatch, smoke_run):
    for sentence, message in (("  ", "blank"), ("onion " * 60, "the maximum is 40")):
        line = refused(capsys, monkeypatch, generate, "--run", smoke_run, sentence)
        assert message in line


def test_an_unknown_style_is_refused_with_a_suggestion(capsys, monkeypatch, smoke_run):
    line = refused(
        capsys, monkeypatch, generate, "--run", smoke_run, "I cook", "--style", "left_no_oninon"
    )
    assert "did you mean 'left_no_onion'?" in line


@pytest.mark.parametrize("command", [evaluate, generate])
def test_one_flipped_byte_in_a_checkpoint_is_found(capsys, monkeypatch, copied_run, command):
    arrays = copied_run / "translator" / "model" / "arrays"
    file = max((f for f in arrays.rglob("*") if f.is_file()), key=lambda f: f.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    sentence = ("I stay left",) if command is generate else ("--json", "out.json")
    line = refused(capsys, monkeypatch, command, "--run", copied_run, *sentence)
    assert "is damaged" in line
    assert file.name in line
    assert not Path("out.json").exists()


def test_missing_encoder_weights_are_named(capsys, monkeypatch, copied_run):
    stored = json.loads((copied_run / "config.json").read_text())
    stored["encoder"] = str(copied_run / "no_such_bert")
    (copied_run / "config.json").write_text(json.dumps(stored))
    line = refused(capsys, monkeypatch, generate, "--run", copied_run, "I stay left")
    assert "no_such_bert" in line


def test_a_finished_run_is_not_continued_with_another_seed(capsys, monkeypatch, smoke_run):
    before = {f: f.stat().st_mtime_ns for f in smoke_run.rglob("*.json")}
    line = refused(capsys, monkeypatch, run, "--preset", "smoke", "--seed", 1, "--out", smoke_run)
    assert "made with seed = 0, but 1 is asked for" in line
    assert {f: f.stat().st_mtime_ns for f in smoke_run.rglob("*.json")} == before


class Killed(BaseException):
    """Stands for a process that dies; not an Exception, so that nothing may catch it."""


def run_until_killed(monkeypatch, config, path: Path, checkpoint_folder: str) -> None:
    """Runs until the first checkpoint in the middle of a stage is written."""
    original = training.Saver.save_if_due

    def save_and_die(saver, state):
        original(saver, state)
        if saver.path.parts[-2:] == tuple(checkpoint_folder.split("/")):
            raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(training.Saver, "save_if_due", save_and_die)
        with pytest.raises(Killed):
            run_pipeline(config, path)
    assert (path / checkpoint_folder / "manifest.json").is_file()
    assert not (path / checkpoint_folder).parent.joinpath("metrics.json").exists()


def lasting(results: dict) -> dict:
    """The results without what differs between two runs of the same thing."""
    kept = {k: v for k, v in results.items() if k not in ("times", "machine", "generation")}
    return json.loads(json.dumps(kept))


def test_a_run_killed_thrice_ends_with_the_results_of_an_uninterrupted_one(
    monkeypatch, no_drawing, smoke_run, tmp_path
):
    monkeypatch.setattr(training, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    monkeypatch.setattr(training, "UPDATES_PER_PIECE", 4)
    config = configs.smoke(configs.DEFAULT_ENVIRONMENT, seed=0)
    path = tmp_path / "interrupted"
    run_until_killed(monkeypatch, config, path, "partners/unfinished")
    run_until_killed(monkeypatch, config, path, "universal/unfinished")
    run_until_killed(monkeypatch, config, path, "policy_vae/unfinished")
    partners_done = (path / "partners" / "metrics.json").stat().st_mtime_ns
    run_pipeline(config, path)
    assert (path / "partners" / "metrics.json").stat().st_mtime_ns == partners_done
    expected, found = (
        lasting(json.loads((folder / "results.json").read_text())) for folder in (smoke_run, path)
    )
    # Threads add up floats in any order; what is learnt and counted must not notice.
    near, same = (kept.pop("memorisation") for kept in (found, expected))
    assert near == pytest.approx(same, rel=1e-5)
    assert found == expected
    for stage in STAGES:
        whole, resumed = (
            set(json.loads((folder / stage / "metrics.json").read_text()))
            for folder in (smoke_run, path)
        )
        assert resumed == whole, f"metrics of stage {stage}"
