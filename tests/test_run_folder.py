"""A run is continued with its own configuration alone, by one process at a time."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from experiments.errors import UserError, as_user_error, choose, main_guard
from experiments.progress import RunProgress
from experiments.run_folder import RunFolder, to_json
from haland_jax.checkpoint import MissingCheckpoint

_ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    learning_rate: float = 1e-3
    hidden: tuple[int, ...] = (64, 64)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    env: str = "overcooked/center_pots"
    ppo: TrainingConfig = TrainingConfig()
    seed: int = 0


def test_a_run_is_continued_with_the_same_configuration(tmp_path):
    with RunFolder.write(tmp_path / "run", RunConfig()) as folder:
        assert not folder.stage_done("partners")
        (folder.stage_path("partners") / "half").write_text("unfinished")
        assert not folder.stage_done("partners")
        folder.finish_stage("partners", {"return": np.float32(12.5)})
    with RunFolder.write(tmp_path / "run", RunConfig()) as folder:
        assert folder.stage_done("partners")
        assert folder.stage_metrics("partners") == {"return": 12.5}


def test_another_configuration_is_refused_naming_the_field_and_both_values(tmp_path):
    RunFolder.write(tmp_path, RunConfig()).close()
    changed = RunConfig(ppo=TrainingConfig(learning_rate=3e-4), seed=1)
    with pytest.raises(UserError, match=r"ppo\.learning_rate = 0\.001, but 0\.0003 .*--out"):
        RunFolder.write(tmp_path, changed)
    made_earlier = {"env": "overcooked/center_pots", "seed": 0, "gone": 5}
    (tmp_path / "config.json").write_text(json.dumps(made_earlier))
    with pytest.raises(UserError, match=r"ppo\.learning_rate = not set"):
        RunFolder.write(tmp_path, RunConfig())
    # A refused run must not stay locked.
    (tmp_path / "config.json").write_text(json.dumps(to_json(RunConfig())))
    RunFolder.write(tmp_path, RunConfig()).close()


def test_a_second_writer_is_refused_and_a_dead_one_is_not_in_the_way(tmp_path):
    code = (
        "import sys; from experiments.run_folder import RunFolder\n"
        "folder = RunFolder.write(sys.argv[1], {'seed': 0}); print('open', flush=True)\n"
        "sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(_ROOT)},
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(UserError, match=f"process {other.pid}"):
            RunFolder.write(tmp_path, {"seed": 0})
        assert RunFolder.read(tmp_path).configuration == {"seed": 0}
        other.kill()
        other.wait()
    with RunFolder.write(tmp_path, {"seed": 0}) as folder:
        folder.append_log({"event": "taken over"})


def test_reading_says_what_is_missing_unfinished_or_damaged(tmp_path):
    with pytest.raises(UserError, match="nowhere is missing"):
        RunFolder.read(tmp_path / "nowhere")
    with pytest.raises(UserError, match="not a run folder"):
        RunFolder.read(tmp_path)
    RunFolder.write(tmp_path / "run", RunConfig()).close()
    with pytest.raises(UserError, match="stage 'translator' is not done"):
        RunFolder.read(tmp_path / "run", stages=("translator",))
    folder = RunFolder.read(tmp_path / "run")
    with pytest.raises(UserError, match=r"results\.json is missing"):
        folder.read_json("results.json")
    with pytest.raises(RuntimeError, match="not open for writing"):
        folder.write_json("results.json", {})
    (tmp_path / "run" / "config.json").write_text('{"env": ')
    with pytest.raises(UserError, match=r"config\.json is damaged"):
        RunFolder.read(tmp_path / "run")


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(UserError, match=r"holds thesis\.tex"):
        RunFolder.write(tmp_path, RunConfig())
    with pytest.raises(UserError, match="is a file"):
        RunFolder.write(tmp_path / "thesis.tex", RunConfig())
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    with RunFolder.write(tmp_path, RunConfig()) as folder:
        folder.write_json("results.json", {"returns": np.arange(3)})
        with pytest.raises(ValueError, match="Out of range"):
            folder.write_json("results.json", {"returns": [1.0, float("nan")]})
        assert folder.read_json("results.json") == {"returns": [0, 1, 2]}


def test_the_log_outlives_a_killed_writer(tmp_path):
    with RunFolder.write(tmp_path, RunConfig()) as folder:
        folder.append_log({"event": "one", "loss": float("nan")})
    with (tmp_path / "log.jsonl").open("a") as stream:
        stream.write('{"event": "hal')
    assert [event["event"] for event in RunFolder.read(tmp_path).read_log()] == ["one"]
    with RunFolder.write(tmp_path, RunConfig()) as folder:
        folder.append_log({"event": "two"})
        events = list(folder.read_log())
    assert [event["event"] for event in events] == ["one", "two"]
    assert events[0]["loss"] == "nan"


def test_progress_prints_few_lines_and_logs_every_metric(tmp_path, capsys):
    now = [0.0]
    console = Console(force_terminal=False, width=120)
    with RunFolder.write(tmp_path, RunConfig()) as folder:
        with RunProgress(("partners", "fit"), folder, console, clock=lambda: now[0]) as progress:
            progress.skip("partners")
            with progress.stage("fit", total=400) as task:
                for step in range(1, 401):
                    now[0] += 0.1
                    task.update(step, metrics={"loss": np.float32(1 / step)})
                    if step == 200:
                        assert task.seconds_left() == pytest.approx(20.0)
        logged = [event for event in folder.read_log() if event["event"] == "metrics"]
    lines = capsys.readouterr().out.splitlines()
    # The stage made earlier, the beginning, one line in ten of the forty seconds, the end.
    assert len(lines) in (6, 7), lines
    assert "loss 0.0025" in lines[-1]
    assert "done  400 of 400" in lines[-1]
    assert [event["step"] for event in logged] == list(range(1, 401))
    assert logged[3]["loss"] == pytest.approx(0.25)
    assert any((tmp_path / "tensorboard").glob("events*"))


def test_the_live_display_shows_every_stage(tmp_path, capsys):
    console = Console(force_terminal=True, width=120)
    with RunProgress(("partners", "policy_vae", "report"), console=console) as progress:
        with progress.stage("partners", total=10) as task:
            task.update(10, {"return": 123.4})
        with pytest.raises(RuntimeError, match="bug"), progress.stage("policy_vae", total=10):
            raise RuntimeError("bug")
    shown = capsys.readouterr().out
    for expected in ("partners", "policy vae", "report", "10 of 10", "return 123.4", "✗"):
        assert expected in shown


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (UserError("no such\nenvironment"), 2, "error: no such environment\n"),
        (MissingCheckpoint("none at runs/a"), 2, "error: none at runs/a\n"),
        (PermissionError(13, "Permission denied", "runs/a"), 2, "Permission denied: runs/a\n"),
        (KeyboardInterrupt(), 130, "run the same command again to continue\n"),
    ],
)
def test_what_a_user_can_act_on_is_one_line(capsys, error, status, line):
    @main_guard
    def main():
        raise error

    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == status
    shown = capsys.readouterr().err
    assert shown.endswith(line)
    assert len(shown.strip().splitlines()) == 1


def test_a_bug_keeps_its_traceback():
    @main_guard
    def main():
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        main()


def test_a_wrong_setting_becomes_a_user_error():
    with pytest.raises(UserError, match="steps"), as_user_error():
        raise ValueError("steps must be positive")


def test_choose_suggests_the_nearest_name():
    names = ("overcooked/center_pots", "overcooked/crossway", "lbf/spread")
    assert choose("environment", "lbf/spread", names) == "lbf/spread"
    with pytest.raises(UserError, match="did you mean 'overcooked/center_pots'"):
        choose("environment", "overcooked/centre_pots", names)
    with pytest.raises(UserError) as error:
        choose("environment", "chess", names)
    assert "did you mean" not in str(error.value)
