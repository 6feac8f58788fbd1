"""The web study under load: many players at once, each in a round of their own."""

import asyncio
import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from experiments.study.crowd import Player
from experiments.study.store import Store

BARS = {"lateness of a tick, p99": 50.0, "steps lost": 0.0, "sentence to game, slowest": 1000.0}
"""At most; milliseconds but for the steps."""
SENTENCES = (
    "We serve onion soup at the first window.",
    "Tomato soup goes to window four.",
    "I want onions cooked for the third counter.",
    "Second window, tomato soup, please.",
)
_STARTUP_SECONDS = 300


@contextlib.contextmanager
def server(folder: Path, port: int, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Runs the study's server in a process of its own until it serves.

    Raises:
        RuntimeError: it did not begin to serve.
    """
    with (folder / "server.log").open("a") as log:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "experiments.study", "--port", str(port)),
                *("--out", str(folder), "--free", *arguments),
            ],
            stdout=log, stderr=log, text=True, env={**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"},
        )  # fmt: skip
        try:
            _wait_until_it_serves(process, port)
            yield process
        finally:
            process.terminate()
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_until_it_serves(process: subprocess.Popen[str], port: int) -> None:
    for _ in range(4 * _STARTUP_SECONDS):
        if process.poll() is not None:
            raise RuntimeError(f"the server ended with status {process.returncode}")
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1):
                return
        except OSError:
            time.sleep(0.25)
    raise RuntimeError(f"the server did not begin to serve in {_STARTUP_SECONDS} s")


def measure_study(players: int, seconds: float, port: int = 8765) -> dict[str, Any]:
    """Plays with many players at once.

    Args:
        players: at once.
        seconds: how long they play.
        port: to serve on.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with server(folder, port, "--players", str(players)):
            crowd = asyncio.run(_play(f"http://127.0.0.1:{port}", players, seconds))
        store = Store(f"sqlite:///{folder / 'study.db'}")
        late, lost = [], 0
        for one, player in zip(store.rounds(), crowd, strict=True):
            steps = store.steps(one.id)
            late.append(steps["late"])
            seen = max(step for step, _, _ in player.frames)
            lost += max(0, seen - len(steps))
        store.close()
    gaps = np.concatenate([1000 * np.diff([at for _, _, at in p.frames]) for p in crowd])
    values = np.concatenate(late)
    return {
        "players": players,
        "steps": int(sum(len(part) for part in late)),
        "lateness of a tick, p50": float(np.percentile(values, 50)),
        "lateness of a tick, p99": float(np.percentile(values, 99)),
        "time between frames at a browser, p1": float(np.percentile(gaps, 1)),
        "time between frames at a browser, p99": float(np.percentile(gaps, 99)),
        "sentence to game, slowest": 1000 * max(player.waited for player in crowd),
        "steps lost": lost,
    }


async def _play(address: str, players: int, seconds: float) -> list[Player]:
    rng = random.Random(0)
    crowd = [Player(address) for _ in range(players)]
    for player in crowd:  # one after the other, as people come
        await player.enrol()
        await player.begin(rng.choice(SENTENCES))
    await asyncio.gather(*(p.play(seconds, random.Random(index)) for index, p in enumerate(crowd)))
    return crowd


def study_table(found: dict[str, Any]) -> Table:
    """The load's measures for the terminal."""
    table = Table(
        title=f"web study, {found['players']} players at once",
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    for column in ("what", "measured", "bar", ""):
        table.add_column(column, justify="left" if column == "what" else "right")
    for name, value in found.items():
        if name in ("machine", "players"):
            continue
        unit = "" if name.startswith("steps") else " ms"
        bar = BARS.get(name)
        verdict = "" if bar is None else "[green]met[/]" if value <= bar else "[red]missed[/]"
        shown = "" if bar is None else f"<= {bar:,.0f}{unit}"
        table.add_row(name, f"{value:,.0f}{unit}", shown, verdict)
    return table
