"""The commands: what a user can put right is one line and exit status 2, nothing half done."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from refused_command import refused
from toy_game import ToyGame

from experiments import configs, devices, evaluate, generate, run, training
from experiments.run_folder import RunFolder
from experiments.stages import STAGE_NAMES
from haland_jax import partners
from haland_jax.fit import NonFiniteLoss

ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch, tmp_path):
    """The commands run in the tests' process, whose devices and cache are set already."""
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env", "overcooked/crossways"), "unknown environment .*mean 'overcooked/crossway'"),
        (("--env", "overcooked/cramped_room"), "unknown environment 'overcooked/cramped_room'"),
        (
            ("--preset", "fast"),
            "unknown preset 'fast'; expected one of smoke, quick, overnight, paper",
        ),
        (("--seed", "-1"), "seed is -1; expected 0 or more"),
    ],
)
def test_run_refuses_what_it_does_not_know_and_makes_no_folder(
    capsys, monkeypatch, tmp_path, arguments, message
):
    line = refused(capsys, monkeypatch, run, *arguments, "--out", tmp_path / "new")
    assert re.search(message, line), line
    assert list(tmp_path.iterdir()) == []


def test_run_refuses_a_folder_of_another_configuration_and_leaves_it(capsys, monkeypatch, tmp_path):
    made = configs.smoke(configs.DEFAULT_ENVIRONMENT, seed=3)
    RunFolder.write(tmp_path / "made", made).close()
    before = (tmp_path / "made" / "config.json").read_bytes()
    line = refused(
        capsys, monkeypatch, run, "--preset", "smoke", "--seed", 4, "--out", tmp_path / "made"
    )
    assert "made with seed = 3, but 4 is asked for" in line
    assert (tmp_path / "made" / "config.json").read_bytes() == before
    assert {entry.name for entry in (tmp_path / "made").iterdir()} == {"config.json", ".lock"}


def test_run_refuses_a_folder_of_something_else(capsys, monkeypatch, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("mine")
    line = refused(capsys, monkeypatch, run, "--preset", "smoke", "--out", tmp_path / "thesis")
    assert "not a run folder" in line
    assert [entry.name for entry in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]


@pytest.mark.parametrize("command", [evaluate, generate])
def test_a_missing_or_unfinished_run_is_named(capsys, monkeypatch, tmp_path, command):
    sentence = ("I stay left",) if command is generate else ()
    line = refused(capsys, monkeypatch, command, "--run", tmp_path / "nowhere", *sentence)
    assert "nowhere is missing; make a run with python -m experiments.run" in line
    assert not (tmp_path / "nowhere").exists()
    with RunFolder.write(tmp_path / "begun", configs.smoke(configs.DEFAULT_ENVIRONMENT, 0)) as run_:
        for stage in STAGE_NAMES[:3]:
            run_.finish_stage(stage, {})
    line = refused(capsys, monkeypatch, command, "--run", tmp_path / "begun", *sentence)
    assert "unfinished: its stage 'task_language' is not done" in line


def marked_finished(path: Path, configuration) -> Path:
    """A folder that says of every stage that it is done, without any checkpoint."""
    with RunFolder.write(path, configuration) as folder:
        for stage in STAGE_NAMES:
            folder.finish_stage(stage, {})
    return path


def test_a_missing_checkpoint_is_named(capsys, monkeypatch, tmp_path):
    path = marked_finished(tmp_path / "run", configs.smoke(configs.DEFAULT_ENVIRONMENT, 0))
    line = refused(capsys, monkeypatch, generate, "--run", path, "I stay left")
    assert "there is no finished checkpoint at" in line
    assert str(path) in line


def test_a_run_of_another_version_is_refused(capsys, monkeypatch, tmp_path):
    path = marked_finished(tmp_path / "run", configs.smoke(configs.DEFAULT_ENVIRONMENT, 0))
    stored = json.loads((path / "config.json").read_text())
    for change, message in (
        ({"preset": "huge"}, "has the preset 'huge'; expected one of smoke"),
        ({"gone": 1}, "does not fit this version"),
        ({"environment": "overcooked/gone"}, "unknown environment"),
    ):
        (path / "config.json").write_text(json.dumps({**stored, **change}))
        line = refused(capsys, monkeypatch, generate, "--run", path, "I stay left")
        assert re.search(message, line), line


STYLES = ("left_no_onion", "right_no_dish")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("left_no_onion = [", "is no TOML file"),
        ("", 'holds no sentences; write: left_no_onion = \\["sentence"\\]'),
        ('left_no_onions = ["I cook"]', "unknown style .*did you mean 'left_no_onion'"),
        ("left_no_onion = []", "left_no_onion must be a list of at least one sentence"),
        ('left_no_onion = "I cook"', "must be a list"),
        ("left_no_onion = [3]", "must be a list"),
    ],
)
def test_a_wrong_file_of_instructions_is_explained(tmp_path, content, message):
    file = tmp_path / "mine.toml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(evaluate.UserError, match=message):
        evaluate.read_sentences(file, STYLES)


def test_files_of_instructions_may_be_plain_or_packaged(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('left_no_onion = ["I cook"]\n[right_no_dish]\ntrain = ["a"]\ntest = ["b"]')
    found = evaluate.read_sentences(file, STYLES)
    assert found == {"left_no_onion": ["I cook"], "right_no_dish": ["b"]}


@pytest.mark.parametrize(("command", "option"), [(generate, "--gif"), (evaluate, "--json")])
def test_an_output_whose_folder_is_missing_is_refused_first(
    capsys, monkeypatch, tmp_path, command, option
):
    sentence = ("I stay left",) if command is generate else ()
    line = refused(capsys, monkeypatch, command, *sentence, option, tmp_path / "no" / "file")
    assert "does not exist; make it first" in line
    assert not (tmp_path / "no").exists()


def test_a_diverged_training_stops_with_the_stages_name(tmp_path):
    game = ToyGame(ego_weight=float("nan"))
    config = partners.PPOConfig(
        total_steps=40, num_envs=4, rollout_steps=5, num_minibatches=2, epochs=1
    )
    counts = partners.PartnersConfig(
        train_seeds=1, held_out_seeds=1, spare_seeds=0, joint=config, refit=config, oracle=config
    )
    with pytest.raises(NonFiniteLoss, match=r"partners: .* is not finite at step 0"):
        training.train_population(
            game,
            config,
            lambda: partners.init_pairs(game, counts.joint, counts.num_seeds, jax.random.key(0)),
            partners.repeat_styles(game, 2),
            training.Saver(tmp_path / "unfinished"),
            lambda *_: None,
            "partners",
        )
    assert not (tmp_path / "unfinished").exists(), "a broken state was saved"


def test_the_real_command_also_ends_with_one_line_and_status_two(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "experiments.run", "--preset", "fast", "--out", "new"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: unknown preset 'fast'")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_presets_are_complete_and_differ():
    made = [make(configs.DEFAULT_ENVIRONMENT, 0) for make in configs.PRESETS.values()]
    assert [config.preset for config in made] == list(configs.PRESETS)
    steps = [config.partners.joint.total_steps for config in made]
    assert steps == sorted(set(steps))
    with pytest.raises(ValueError, match=r"chunk_steps is 30; expected a divisor of fit\.steps"):
        dataclasses.replace(made[0].compression, chunk_steps=30)
