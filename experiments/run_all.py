"""Several environments one after the other, each in a process of its own.

A process frees its memory and its compiled programs at its end, and whatever ends it, an exception
or the system's want of memory, the other environments still run.
"""

import contextlib
import dataclasses
import json
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

import envs
from experiments.configs import PRESETS, RunConfig
from experiments.errors import UserError, as_user_error, choose
from experiments.overview import Overview, number, overview, percent
from experiments.run_folder import RunFolder, to_json

ALL = "all"
SECONDS_TO_STOP = 120.0  # A program that is being compiled cannot be interrupted.
_LINES_SHOWN = 12
_WIDTH_OF_A_LOG = 160
_DONE, _DONE_EARLIER, _FAILED = "done", "done earlier", "failed"
_INTERRUPTED, _NOT_BEGUN = "interrupted", "not begun"
_COLOURS = {_DONE: "green", _DONE_EARLIER: "green", _FAILED: "bold red"}


@dataclasses.dataclass(frozen=True)
class Plan:
    """One environment's run: its configuration and its folder."""

    config: RunConfig
    path: Path


@dataclasses.dataclass
class Outcome:
    """What became of a plan; the reason is that of a failure, in lines."""

    plan: Plan
    status: str = _NOT_BEGUN
    reason: tuple[str, ...] = ()


def default_path(environment: str, preset: str, seed: int, parent: Path = Path("runs")) -> Path:
    """Where a run goes if nothing else is said."""
    return parent / f"{environment.replace('/', '-')}-{preset}-{seed}"


def asked_environments(asked: str) -> list[str]:
    """The environments of `--env`: one name, several with commas between, or `all`.

    Raises:
        UserError: one of them is unknown, or none is named.
    """
    known = envs.names(styled_only=True)
    names = [name.strip() for name in asked.split(",") if name.strip()]
    if not names:
        raise UserError(f"no environment in '{asked}'; expected one of {', '.join(known)}, all")
    chosen = list(dict.fromkeys(choose("environment", name, [*known, ALL]) for name in names))
    return list(known) if ALL in chosen else chosen


def make_plans(environments: Sequence[str], preset: str, seed: int, out: Path | None) -> list[Plan]:
    """A plan for each environment; the run folders lie in `out`, or in runs/.

    Raises:
        UserError: `out` is itself a run, or the preset does not fit an environment.
    """
    if out is not None and (out / "config.json").exists():
        raise UserError(
            f"{out} is the folder of one run; with several environments --out names the folder "
            "that holds their run folders"
        )
    with as_user_error():
        return [
            Plan(
                PRESETS[preset](name, seed),
                default_path(name, preset, seed, Path("runs") if out is None else out),
            )
            for name in environments
        ]


def command_of(plan: Plan) -> list[str]:
    """The command that runs, or continues, one environment."""
    config = plan.config
    return [
        *(sys.executable, "-m", "experiments.run", "--env", config.environment),
        *("--preset", config.preset, "--seed", str(config.seed), "--out", str(plan.path)),
    ]


def run_all(
    plans: Sequence[Plan],
    console: Console | None = None,
    command: Callable[[Plan], Sequence[str]] = command_of,
) -> int:
    """Runs or continues every plan, whatever becomes of the others, and shows a table at the end.

    Args:
        plans: what to run, in order.
        console: where to print; standard output by default. The runs' own progress goes to this
            process's standard output and error.
        command: makes a plan's command line; a test may give another.

    Returns:
        The exit status: 0 if every plan is finished, 1 if one failed.

    Raises:
        KeyboardInterrupt: after the running environment has stopped and the table was shown.
    """
    console = console or Console(highlight=False)
    if not console.is_terminal:
        console.width = max(console.width, _WIDTH_OF_A_LOG)
    outcomes = [Outcome(plan) for plan in plans]
    try:
        with _signals_as_interrupts():
            for index, outcome in enumerate(outcomes):
                name = outcome.plan.config.environment
                console.rule(f"{name} ({index + 1} of {len(plans)})", style="dim")
                if is_finished(outcome.plan):
                    outcome.status = _DONE_EARLIER
                    console.print(f"finished earlier: {outcome.plan.path}", soft_wrap=True)
                    continue
                outcome.status = _INTERRUPTED
                _run_one(outcome, command(outcome.plan))
                if outcome.status == _FAILED:
                    console.print(_failure(outcome), style="bold red", markup=False)
    finally:
        console.rule(style="dim")
        console.print(outcome_table(outcomes))
        for outcome in outcomes:
            if outcome.status == _FAILED:
                _print_reason(console, outcome)
    failed = [outcome for outcome in outcomes if outcome.status == _FAILED]
    if failed:
        console.print(
            f"{len(failed)} of {len(plans)} failed; the same command tries them again and "
            "continues where they stopped."
        )
    return 1 if failed else 0


def is_finished(plan: Plan) -> bool:
    """Whether the plan's folder holds a run with this very configuration, from start to report."""
    try:
        folder = RunFolder.read(plan.path, ("report",))
        folder.read_json("results.json")
    except UserError:
        return False
    return folder.configuration == json.loads(json.dumps(to_json(plan.config)))


def outcome_table(outcomes: Sequence[Outcome]) -> Table:
    """One row an environment: what was found where the run is finished, and its status."""
    table = Table(title="All environments", title_justify="left")
    table.add_column("environment", overflow="fold")
    for name in (
        *("Oracle", "upper\nbound", "Oracle\n/ bound", "best resp.\n/ Oracle"),
        *("Haland\n/ Oracle", "wrong\nsentence", "trans-\nlator", "min-\nutes", "gates\nmet"),
    ):
        table.add_column(name, justify="right")
    table.add_column("status")
    for outcome in outcomes:
        cells = [""] * 9
        if outcome.status in (_DONE, _DONE_EARLIER):
            results = RunFolder.read(outcome.plan.path).read_json("results.json")
            cells = _cells(overview(results))
        colour = _COLOURS.get(outcome.status, "yellow")
        status = f"[{colour}]{outcome.status}[/]"
        table.add_row(outcome.plan.config.environment, *cells, status)
    return table


def _cells(row: Overview) -> list[str]:
    return [
        row.amount_with_spread(row.oracle),
        row.amount(row.upper_bound),
        number(row.oracle_of_bound, 2),
        number(row.ceiling, 2),
        number(row.share, 2),
        number(row.wrong_share, 2),
        percent(row.accuracy),
        number(row.minutes),
        f"{row.gates_met} of {row.gates}",
    ]


def _run_one(outcome: Outcome, command: Sequence[str]) -> None:
    """Runs a plan's command to its end; sets the outcome's status and reason.

    Standard output is the terminal's own, so that the run draws its live display on it. Standard
    error passes through here, so that its last lines can be shown again. The process has a group
    of its own: Ctrl-C reaches this process alone, which then stops the run once.
    """
    began = time.time()
    process = subprocess.Popen(list(command), stderr=subprocess.PIPE, process_group=0)
    lines: deque[str] = deque(maxlen=_LINES_SHOWN)
    reader = threading.Thread(target=_pass_through, args=(process, lines), daemon=True)
    reader.start()
    try:
        status = process.wait()
    except BaseException:
        _stop(process)
        raise
    finally:
        reader.join(timeout=5.0)
    if status == 0 and is_finished(outcome.plan):
        outcome.status = _DONE
        return
    outcome.status = _FAILED
    outcome.reason = (_ending(status) + _last_stage(outcome.plan.path, began), *lines)


def _pass_through(process: "subprocess.Popen[bytes]", lines: deque[str]) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        text = line.decode(errors="replace")
        sys.stderr.write(text)
        sys.stderr.flush()
        if text.strip():
            lines.append(text.rstrip())


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """Asks the process to stop as Ctrl-C does, and ends it if that takes too long."""
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # The process has inherited that.
    print("stopping; Ctrl-C again ends it at once", file=sys.stderr)
    process.send_signal(signal.SIGTERM if ignored else signal.SIGINT)
    try:
        process.wait(SECONDS_TO_STOP)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        process.wait()


@contextlib.contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """A closed terminal, or a polite `kill`, stops the running environment as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {which: signal.getsignal(which) for which in (signal.SIGTERM, signal.SIGHUP)}
    # What is ignored stays ignored: that is what `nohup` is for.
    caught = {which: old for which, old in before.items() if old is not signal.SIG_IGN}
    for which in caught:
        signal.signal(which, interrupt)
    try:
        yield
    finally:
        for which, old in caught.items():
            signal.signal(which, old)


def _ending(status: int) -> str:
    """How the process ended, in words."""
    if status == -signal.SIGKILL:
        return "killed by the system (signal SIGKILL), most likely for want of memory"
    if status < 0:
        return f"ended by signal {signal.Signals(-status).name}"
    if status == 0:
        return "ended without having finished"
    return f"ended with exit status {status}"


def _last_stage(path: Path, since: float) -> str:
    """The stage that the run was in when it ended, from its log."""
    try:
        events = [event for event in RunFolder.read(path).read_log() if event["time"] >= since]
    except (UserError, ValueError):
        return ""
    stages = [event["stage"] for event in events if "stage" in event]
    return f", in the stage '{stages[-1]}'" if stages else ""


def _failure(outcome: Outcome) -> str:
    return f"{outcome.plan.config.environment} failed: {outcome.reason[0]}"


def _print_reason(console: Console, outcome: Outcome) -> None:
    console.print(_failure(outcome), style="bold red", markup=False, soft_wrap=True)
    for line in outcome.reason[1:]:
        console.print(f"    {line}", markup=False, soft_wrap=True)
