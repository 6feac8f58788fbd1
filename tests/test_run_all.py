"""Several environments in a row: failures stay alone, finished ones are skipped, the end is told.

The runs are short programs that make a finished folder, fail, or wait: what is tested is the
command around them.
"""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from made_up_results import made_up_results
from refused_command import refused
from rich.console import Console

import envs
from experiments import configs, devices, run, run_all
from experiments.errors import UserError
from experiments.run_folder import RunFolder

ROOT = Path(__file__).parent.parent
CENTER, CROSSWAY, ORDERS = (
    "overcooked/center_pots",
    "overcooked/crossway",
    "overcooked/diverse_orders",
)
COPY = "import shutil, sys; shutil.copytree(sys.argv[1], sys.argv[2], dirs_exist_ok=True)"
FAIL = """
import sys
print("Traceback: a first line", file=sys.stderr)
print("ValueError: the pot is [empty]", file=sys.stderr)
sys.exit(3)
"""
KILL = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"


@pytest.fixture(autouse=True)
def interruptible():
    """The tests may themselves be run in the background, where an interruption is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def plans(tmp_path):
    return run_all.make_plans((CENTER, CROSSWAY, ORDERS), "smoke", 0, tmp_path / "runs")


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=160)


def finish(path: Path, config) -> None:
    """A folder as a finished run leaves it, with invented results."""
    results = {**made_up_results(), "environment": config.environment, "preset": config.preset}
    with RunFolder.write(path, config) as folder:
        folder.write_json("results.json", results)
        folder.finish_stage("report", {})


def commands(tmp_path, scripts):
    """Makes the command line of each environment from its script; notes which were begun."""
    begun = []

    def command(plan):
        name = plan.config.environment
        begun.append(name)
        made = tmp_path / "made" / name
        if not made.exists():
            finish(made, plan.config)
        return [sys.executable, "-c", scripts.get(name, COPY), str(made), str(plan.path)]

    return command, begun


def shown(console) -> str:
    return " ".join(console.file.getvalue().split())


def rows_of(console) -> dict[str, list[str]]:
    """The table's rows by environment; the last table counts."""
    lines = [line for line in console.file.getvalue().splitlines() if line.startswith("│")]
    cells = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]
    return {row[0]: row[1:] for row in cells if "/" in row[0]}


def test_all_are_run_in_order_and_compared(tmp_path, plans, console):
    command, begun = commands(tmp_path, {})
    assert run_all.run_all(plans, console, command) == 0
    assert begun == [CENTER, CROSSWAY, ORDERS]
    rows = rows_of(console)
    assert list(rows) == begun
    for row in rows.values():
        assert row[-1] == "done"
        assert row[-2] == "1 of 2", "gates met"
        assert row[-3] == "9", "557 seconds in minutes"
        assert row[-4] == "94%", "30 of 32 sentences"
        assert row[1:3] == ["240", "0.75"], "upper bound, and the Oracle's share of it"


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        (FAIL, "ended with exit status 3 Traceback: a first line ValueError: the pot is [empty]"),
        (KILL, "killed by the system (signal SIGKILL), most likely for want of memory"),
        ("", "ended without having finished"),
    ],
)
def test_one_that_fails_does_not_stop_the_others_and_says_why(
    tmp_path, plans, console, script, reason
):
    command, begun = commands(tmp_path, {CROSSWAY: script})
    assert run_all.run_all(plans, console, command) == 1
    assert begun == [CENTER, CROSSWAY, ORDERS]
    rows = rows_of(console)
    assert [row[-1] for row in rows.values()] == ["done", "failed", "done"]
    assert rows[CROSSWAY][0] == ""
    text = shown(console)
    assert f"{CROSSWAY} failed: {reason}" in text[text.index("All environments") :]
    assert "1 of 3 failed; the same command tries them again" in text


def test_the_same_command_skips_what_is_finished_and_tries_the_rest(tmp_path, plans, console):
    command, _ = commands(tmp_path, {CROSSWAY: FAIL})
    run_all.run_all(plans, console, command)
    command, begun = commands(tmp_path, {})
    before = {plan.path: (plan.path / "results.json").stat().st_mtime_ns for plan in plans[::2]}
    assert run_all.run_all(plans, console, command) == 0
    assert begun == [CROSSWAY]
    statuses = [row[-1] for row in rows_of(console).values()]
    assert statuses == ["done earlier", "done", "done earlier"]
    for path, changed in before.items():
        assert (path / "results.json").stat().st_mtime_ns == changed


def test_a_finished_run_of_another_configuration_is_not_skipped(tmp_path, plans, console):
    finish(plans[0].path, configs.smoke(CENTER, seed=7))
    assert not run_all.is_finished(plans[0])
    finish(plans[1].path, plans[1].config)
    assert run_all.is_finished(plans[1])
    (plans[1].path / "report" / "metrics.json").unlink()
    assert not run_all.is_finished(plans[1])


def test_the_stage_of_a_failure_is_taken_from_the_log(tmp_path, plans, console):
    script = (
        "import json, pathlib, sys, time\n"
        "path = pathlib.Path(sys.argv[2]); path.mkdir(parents=True)\n"
        "(path / 'config.json').write_text('{}')\n"
        "event = {'time': time.time(), 'event': 'stage began', 'stage': 'policy_vae'}\n"
        "(path / 'log.jsonl').write_text(json.dumps(event) + chr(10)); sys.exit(1)"
    )
    command, _ = commands(tmp_path, {CENTER: script})
    assert run_all.run_all(plans[:1], console, command) == 1
    assert "exit status 1, in the stage 'policy_vae'" in shown(console)


def test_what_a_run_prints_passes_through(tmp_path, plans, console, capfd):
    script = "import sys; print('on the screen'); print('gone wrong', file=sys.stderr); sys.exit(1)"
    command, _ = commands(tmp_path, {CENTER: script})
    run_all.run_all(plans[:1], console, command)
    printed = capfd.readouterr()
    assert "on the screen" in printed.out
    assert "gone wrong" in printed.err


WAIT = """
import pathlib, sys, time
pathlib.Path(sys.argv[2] + ".begun").touch()
try:
    time.sleep(60)
except KeyboardInterrupt:
    pathlib.Path(sys.argv[2] + ".stopped").touch()
    sys.exit(130)
"""


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_stops_the_running_one_and_begins_no_other(tmp_path, plans, console, sent):
    command, begun = commands(tmp_path, {CROSSWAY: WAIT})
    plans[1].path.parent.mkdir(exist_ok=True)
    waiting = plans[1].path.with_name(plans[1].path.name + ".begun")

    def interrupt():
        while not waiting.exists():
            time.sleep(0.02)
        time.sleep(0.2)
        os.kill(os.getpid(), sent)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run_all.run_all(plans, console, command)
    assert plans[1].path.with_name(plans[1].path.name + ".stopped").exists()
    assert begun == [CENTER, CROSSWAY]
    statuses = [row[-1] for row in rows_of(console).values()]
    assert statuses == ["done", "interrupted", "not begun"]


def test_one_that_does_not_stop_is_ended(tmp_path, plans, console, monkeypatch):
    monkeypatch.setattr(run_all, "SECONDS_TO_STOP", 0.3)
    stubborn = (
        "import pathlib, signal, sys, time; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "pathlib.Path(sys.argv[2] + '.begun').touch(); time.sleep(60)"
    )
    command, _ = commands(tmp_path, {CENTER: stubborn})
    plans[0].path.parent.mkdir()
    waiting = plans[0].path.with_name(plans[0].path.name + ".begun")

    def interrupt():
        while not waiting.exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_all.run_all(plans[:1], console, command)
    assert time.monotonic() - began < 20


def test_environments_are_named_one_by_one_or_all_together():
    known = list(envs.names(styled_only=True))
    assert run_all.asked_environments("all") == known
    assert run_all.asked_environments(CROSSWAY) == [CROSSWAY]
    assert run_all.asked_environments(f"{CROSSWAY}, {CENTER},{CROSSWAY}") == [CROSSWAY, CENTER]
    with pytest.raises(UserError, match=r"unknown environment 'al'.* all; did you mean 'all'"):
        run_all.asked_environments("al")
    with pytest.raises(UserError, match="no environment in ','"):
        run_all.asked_environments(",")


def test_each_environment_has_a_folder_and_the_command_that_makes_it(tmp_path):
    plans = run_all.make_plans((CENTER, CROSSWAY), "overnight", 2, None)
    assert plans[1].path == Path("runs/overcooked-crossway-overnight-2")
    assert run_all.command_of(plans[1])[1:] == [
        *("-m", "experiments.run", "--env", CROSSWAY, "--preset", "overnight", "--seed", "2"),
        *("--out", "runs/overcooked-crossway-overnight-2"),
    ]
    plans = run_all.make_plans((CENTER, CROSSWAY), "smoke", 0, tmp_path)
    assert plans[0].path == tmp_path / "overcooked-center_pots-smoke-0"


def test_a_run_folder_cannot_hold_the_runs_of_several(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    finish(tmp_path / "one", configs.smoke(CENTER, 0))
    line = refused(capsys, monkeypatch, run, "--env", "all", "--out", tmp_path / "one")
    assert "is the folder of one run" in line


@pytest.mark.slow
def test_the_real_command_passes_on_the_exit_status_and_a_locked_folder_is_refused(tmp_path):
    """With nothing left to do but a folder that another process holds."""
    plans = run_all.make_plans((CENTER, CROSSWAY), "smoke", 0, tmp_path / "runs")
    finish(plans[0].path, plans[0].config)
    with RunFolder.write(plans[1].path, plans[1].config):
        done = subprocess.run(
            [
                *(sys.executable, "-m", "experiments.run", "--env", f"{CENTER},{CROSSWAY}"),
                *("--preset", "smoke", "--out", "runs"),
            ],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            timeout=300,
            check=False,
        )
    assert done.returncode == 1, done.stderr
    assert re.search(rf"finished earlier: .*{plans[0].path.name}", done.stdout)
    assert f"being written by process {os.getpid()}" in done.stdout
    assert json.loads((plans[1].path / "config.json").read_text())["environment"] == CROSSWAY
