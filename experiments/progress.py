"""The whole run on the screen: one line a stage, live in a terminal, plain lines elsewhere."""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from experiments.run_folder import RunFolder

_SECONDS_BETWEEN_LINES = 10.0
_SYMBOLS = {
    "pending": Text("·", style="dim"),
    "running": Text("▸", style="bold cyan"),
    "done": Text("✓", style="green"),
    "stopped": Text("✗", style="red"),
}


class StageProgress:
    """One stage of a run, as a context manager; made by `RunProgress.stage`."""

    def __init__(self, run: "RunProgress", name: str):
        self.name = name
        self.state = "pending"
        self.done = 0
        self.total: int | None = None
        self.metrics: dict[str, float] = {}
        self.note = ""
        self._run = run
        self._began = self._ended = 0.0
        self._first: tuple[float, int] | None = None

    def update(self, done: int, metrics: Mapping[str, Any] | None = None) -> None:
        """Reports that `done` of the stage's steps are done, and the metrics as they stand.

        The metrics (scalars; arrays of one number will do) also go into the run's log.
        """
        self.done = int(done)
        self.metrics = {name: float(value) for name, value in (metrics or {}).items()}
        if self._first is None:
            # The first update comes after compilation, and maybe from a resumed state: neither
            # says anything about the speed.
            self._first = (self._run.clock(), self.done)
        if metrics and self._run.folder is not None:
            self._run.folder.log_metrics(self.name, self.done, self.metrics)
        self._run.show(self)

    def elapsed(self) -> float:
        """Seconds in this stage."""
        if self.state == "pending":
            return 0.0
        return (self._run.clock() if self.state == "running" else self._ended) - self._began

    def seconds_left(self) -> float | None:
        """An estimate from the speed since the first update; None where there is none yet."""
        if self.state != "running" or self.total is None or self._first is None:
            return None
        since, from_step = self._first
        if self.done <= from_step:
            return None
        return (self._run.clock() - since) / (self.done - from_step) * (self.total - self.done)

    def begin(self, total: int | None) -> "StageProgress":
        self.total, self.state, self._began = total, "running", self._run.clock()
        return self

    def __enter__(self) -> "StageProgress":
        self._run.log({"event": "stage began", "stage": self.name, "total": self.total})
        self._run.show(self, at_once=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._ended = self._run.clock()
        self.state = "stopped" if kind else "done"
        if kind is None and self.total is not None:
            self.done = self.total
        event = {"event": f"stage {self.state}", "stage": self.name}
        self._run.log({**event, "seconds": round(self.elapsed(), 3)})
        self._run.show(self, at_once=True)


class RunProgress:
    """The stages of a run in order, as a context manager that owns the display.

        with RunProgress(("partners", "policy_vae"), folder) as progress:
            with progress.stage("partners", total=1000) as task:
                task.update(100, metrics={"return": 123.4})

    Args:
        stages: their names, in order.
        folder: where the metrics are logged, if anywhere.
        console: where to draw; standard output by default.
        clock: the time in seconds.
    """

    def __init__(
        self,
        stages: Iterable[str],
        folder: RunFolder | None = None,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.folder = folder
        self.clock = clock
        self.stages = {name: StageProgress(self, name) for name in stages}
        self._console = console or Console(highlight=False)
        self._live: Live | None = None
        self._last_line = -_SECONDS_BETWEEN_LINES
        self._began = clock()

    def __enter__(self) -> "RunProgress":
        self._began = self.clock()
        if self._console.is_terminal:
            live = Live(get_renderable=self.table, console=self._console, refresh_per_second=4)
            live.start()
            self._live = live
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def stage(self, name: str, total: int | None = None) -> StageProgress:
        """The stage of that name, now running, with its number of steps where it is known."""
        return self.stages[name].begin(total)

    def skip(self, name: str, note: str = "made earlier") -> None:
        """Shows a stage as done without running it."""
        self.stages[name].state, self.stages[name].note = "done", note
        self.show(self.stages[name], at_once=True)

    def log(self, event: Mapping[str, Any]) -> None:
        """Adds an event to the run's log."""
        if self.folder is not None:
            self.folder.append_log(event)

    def message(self, text: str) -> None:
        """Prints a line above the display, and logs it."""
        self._console.print(text, markup=False)
        self.log({"event": "message", "text": text})

    def show(self, stage: StageProgress, at_once: bool = False) -> None:
        """Draws the stage anew; without a terminal at most one line in ten seconds."""
        if self._live is not None:
            return  # The display asks for `table` by itself.
        if at_once or self.clock() - self._last_line >= _SECONDS_BETWEEN_LINES:
            self._last_line = self.clock()
            self._console.print(_line(stage), markup=False, soft_wrap=True)

    def table(self) -> Table:
        """The live display."""
        table = Table.grid(padding=(0, 2))
        for stage in self.stages.values():
            bar = (
                ProgressBar(total=stage.total, completed=stage.done, width=24)
                if stage.state in ("running", "stopped") and stage.total
                else Text("")
            )
            style = "dim" if stage.state == "pending" else "bold" * (stage.state == "running")
            table.add_row(
                _SYMBOLS[stage.state],
                Text(stage.name.replace("_", " "), style=style),
                bar,
                Text(_steps(stage), justify="right"),
                Text(_metrics(stage.metrics), style="cyan"),
                Text("  ".join(_times(stage)), style="dim"),
            )
        table.add_row("", Text("elapsed"), Text(_duration(self.clock() - self._began)))
        return table


def _line(stage: StageProgress) -> str:
    parts = [_steps(stage), _metrics(stage.metrics), *_times(stage)]
    state = ("" if stage.done else "began") if stage.state == "running" else stage.state
    return "  ".join(part for part in (f"[{stage.name}]", state, *parts) if part)


def _steps(stage: StageProgress) -> str:
    if stage.total is None:
        return f"{stage.done:,}" if stage.done else ""
    return f"{stage.done:,} of {stage.total:,}" if stage.done else f"{stage.total:,} steps"


def _metrics(metrics: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in list(metrics.items())[:3])


def _times(stage: StageProgress) -> list[str]:
    if stage.note:
        return [stage.note]
    left = stage.seconds_left()
    shown = [] if stage.state == "pending" else [_duration(stage.elapsed())]
    return shown if left is None else [*shown, f"{_duration(left)} left"]


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else f"{seconds} s"
