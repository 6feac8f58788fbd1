"""The folder of one run: what was asked for, what each stage made, and what happened when.

config.json     the configuration; a run is continued only with the same one
<stage>/        one stage's checkpoints, and metrics.json once the stage is finished
results.json    what every figure and the report are drawn from
figures/        and report.md
log.jsonl       one event a line
recorded.json   only in a run that was made of a record: which one
tensorboard/    the same scalars for TensorBoard
"""

import dataclasses
import enum
import fcntl
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.earlier import with_later_settings
from experiments.errors import UserError

_CONFIGURATION, _METRICS, _LOG, _LOCK = "config.json", "metrics.json", "log.jsonl", ".lock"
_RECORDED = "recorded.json"


class RunFolder:
    """A run's folder, open for writing by one process or for reading by any number.

    Use `RunFolder.write` or `RunFolder.read`; the object is a context manager.
    """

    def __init__(self, path: Path, configuration: dict[str, Any], lock: int | None):
        self.path = path
        self.configuration = configuration
        self._lock = lock
        self._tensorboard: Any = None

    @classmethod
    def write(cls, path: str | Path, configuration: Any) -> "RunFolder":
        """Makes the folder, or opens it to continue the run in it.

        Args:
            path: the folder.
            configuration: a (nested) dataclass; see `to_json`.

        Raises:
            UserError: another process is writing the run; the run was made with another
                configuration; or something else than a run is at `path`.
        """
        path = Path(path)
        _refuse_other_content(path)
        path.mkdir(parents=True, exist_ok=True)
        lock = _take_lock(path)
        try:
            asked = json.loads(json.dumps(to_json(configuration), allow_nan=False))
            if (path / _CONFIGURATION).exists():
                _compare(path, _read_configuration(path), asked)
            else:
                _write_json(path / _CONFIGURATION, asked)
            _drop_unfinished_line(path / _LOG)
        except BaseException:
            os.close(lock)
            raise
        return cls(path, asked, lock)

    @classmethod
    def read(cls, path: str | Path, stages: tuple[str, ...] = ()) -> "RunFolder":
        """Opens a run to read from it, also while another process writes it.

        Args:
            path: the folder.
            stages: the stages that the caller needs.

        Raises:
            UserError: there is no run at `path`, or one of the stages is not finished.
        """
        path = Path(path)
        if not (path / _CONFIGURATION).is_file():
            what = "is not a run folder (it has no config.json)" if path.exists() else "is missing"
            raise UserError(
                f"{path} {what}; make a run with python -m experiments.run --out {path}"
            )
        folder = cls(path, _read_configuration(path), lock=None)
        folder.expect_stages(stages)
        return folder

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Writes out what TensorBoard still holds and lets the next process have the run."""
        if self._tensorboard is not None:
            self._tensorboard.close()
            self._tensorboard = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def stage_path(self, stage: str) -> Path:
        """The folder of a stage; made if the run is open for writing."""
        path = self.path / stage
        if self._lock is not None:
            path.mkdir(exist_ok=True)
        return path

    def stage_done(self, stage: str) -> bool:
        """Whether `finish_stage` was called for the stage, in this process or an earlier one."""
        return (self.path / stage / _METRICS).is_file()

    def expect_stages(self, stages: Iterable[str]) -> None:
        """Checks that stages are finished.

        Raises:
            UserError: one of them is not.
        """
        for stage in stages:
            if self.stage_done(stage):
                continue
            if self.recorded_in is not None:
                raise UserError(
                    f"the run in {self.path} was made of the record {self.recorded_in}, which has "
                    f"players and results only and no '{stage}'; make a run of your own with "
                    "python -m experiments.run"
                )
            raise UserError(
                f"the run in {self.path} is unfinished: its stage '{stage}' is not done; continue "
                "it with the command that began it"
            )

    @property
    def recorded_in(self) -> str | None:
        """The record that the run was made of; None for a run of one's own."""
        there = (self.path / _RECORDED).is_file()
        return self.read_json(_RECORDED)["record"] if there else None

    def mark_as_recorded(self, record: str) -> None:
        """Notes that the run is made of a record, and is not to be trained further."""
        self.write_json(_RECORDED, {"record": record})

    def finish_stage(self, stage: str, metrics: Mapping[str, Any]) -> None:
        """Records that everything that the stage makes is written; its metrics are the mark."""
        self.stage_path(stage)
        self.write_json(f"{stage}/{_METRICS}", metrics)

    def stage_metrics(self, stage: str) -> dict[str, Any]:
        """What was given to `finish_stage`."""
        return self.read_json(f"{stage}/{_METRICS}")

    def write_json(self, name: str, value: Any) -> None:
        """Writes a file of the run, whole or not at all.

        Raises:
            ValueError: the value holds something that JSON does not, such as NaN.
        """
        self._require_writing()
        _write_json(self.path / name, to_json(value))

    def read_json(self, name: str) -> Any:
        """Reads a file of the run.

        Raises:
            UserError: it is missing or damaged.
        """
        return _read_json(self.path / name)

    def append_log(self, event: Mapping[str, Any]) -> None:
        """Adds one line to log.jsonl, with the time in seconds since 1970."""
        self._require_writing()
        line = json.dumps({"time": round(time.time(), 3), **_finite(to_json(event))})
        with (self.path / _LOG).open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")

    def read_log(self) -> Iterator[dict[str, Any]]:
        """The events of log.jsonl in order, without a last line that is still being written."""
        if not (self.path / _LOG).is_file():
            return
        for line in (self.path / _LOG).read_text(encoding="utf-8").splitlines(keepends=True):
            if line.endswith("\n"):
                yield json.loads(line)

    def log_metrics(self, stage: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Adds a stage's scalars at a step to log.jsonl and to TensorBoard."""
        scalars = {name: float(value) for name, value in metrics.items()}
        self.append_log({"event": "metrics", "stage": stage, "step": int(step), **scalars})
        if self._tensorboard is None:
            # The import takes a quarter of a second, which a command that only reads can save.
            from tensorboardX import SummaryWriter

            self._tensorboard = SummaryWriter(str(self.path / "tensorboard"))
        for name, value in scalars.items():
            self._tensorboard.add_scalar(f"{stage}/{name}", value, int(step))

    def _require_writing(self) -> None:
        if self._lock is None:
            raise RuntimeError(f"the run in {self.path} is not open for writing")


def to_json(value: Any) -> Any:
    """The value in JSON's types: dataclasses and mappings become objects, arrays and tuples lists.

    Raises:
        TypeError: a value of another type.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    raise TypeError(f"{value!r} of type {type(value).__name__} cannot be written as JSON")


def _finite(value: Any) -> Any:
    """Numbers that JSON does not have become their names: a log must be able to say NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return repr(value) if isinstance(value, float) and not np.isfinite(value) else value


def _refuse_other_content(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is a file; choose another folder with --out")
    if path.is_dir() and not (path / _CONFIGURATION).exists():
        # A run that was killed in its first moment leaves only hidden files.
        foreign = sorted(entry.name for entry in path.iterdir() if entry.name[0] != ".")
        if foreign:
            raise UserError(
                f"{path} is not empty and not a run folder (it holds {foreign[0]}); choose another "
                "folder with --out"
            )


def _take_lock(path: Path) -> int:
    """The system drops the lock with the process, so a dead process never holds it."""
    descriptor = os.open(path / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
        os.close(descriptor)
        raise UserError(
            f"the run in {path} is being written by process {holder}; wait for it, or choose "
            "another folder with --out"
        ) from None
    os.truncate(descriptor, 0)
    os.write(descriptor, f"{os.getpid()}\n".encode())
    return descriptor


def _read_configuration(path: Path) -> dict[str, Any]:
    return with_later_settings(_read_json(path / _CONFIGURATION))


def _compare(path: Path, made: dict[str, Any], asked: dict[str, Any]) -> None:
    before, now = _flatten(made), _flatten(asked)
    for name in [*now, *(name for name in before if name not in now)]:
        if before.get(name, "not set") != now.get(name, "not set"):
            raise UserError(
                f"the run in {path} was made with {name} = {before.get(name, 'not set')}, but "
                f"{now.get(name, 'not set')} is asked for; ask for the same, choose another folder "
                "with --out, or delete this one to start over"
            )


def _flatten(value: Any, name: str = "") -> dict[str, Any]:
    """The leaves by dotted name: {"ppo.gamma": 1.0} of {"ppo": {"gamma": 1.0}}, lists whole."""
    if not isinstance(value, dict):
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, item in value.items():
        leaves.update(_flatten(item, f"{name}.{key}" if name else key))
    return leaves


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(
            f"{file} is missing; run the command that makes this run to its end"
        ) from None
    except ValueError as error:
        raise UserError(f"{file} is damaged ({error}); delete it and run again") from None


def _write_json(file: Path, value: Any) -> None:
    writing = file.with_name(f".{file.name}.writing")
    with writing.open("w", encoding="utf-8") as stream:
        json.dump(value, stream, indent=1, allow_nan=False)
        stream.write("\n")
        stream.flush()
        os.fsync(stream.fileno())
    writing.replace(file)


def _drop_unfinished_line(log: Path) -> None:
    """Removes what a killed process left of its last line."""
    if not log.is_file():
        return
    with log.open("rb+") as stream:
        content = stream.read()
        if content and not content.endswith(b"\n"):
            stream.truncate(content.rfind(b"\n") + 1)
