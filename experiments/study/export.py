"""What was recorded, for analysis: JSON lines, Parquet, and replays as GIFs."""

import io
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.study import tables
from experiments.study.recording import actions_of
from experiments.study.store import Store
from experiments.study.study import Kitchen

COLUMNS = (
    *("number", "condition", "environment", "model", "fingerprint", "style", "sentence"),
    *("sounds_like", "agent_seed", "game_seed", "status", "hertz", "steps", "score", "rating"),
    *("comment", "timing"),
)


def described(one: tables.Round) -> dict[str, Any]:
    """A round without its steps; the participant is a code."""
    return {
        "round": one.id,
        "participant": one.participant.code,
        **{name: getattr(one, name) for name in COLUMNS},
        "began": one.began.isoformat(),
        "ended": None if one.ended is None else one.ended.isoformat(),
    }


def rounds_jsonl(store: Store) -> Iterator[str]:
    """A line a round, with its steps' actions and rewards."""
    for one in store.rounds():
        steps = store.steps(one.id)
        recorded = {name: steps[name].tolist() for name in steps.dtype.names or ()}
        yield json.dumps({**described(one), "recorded": recorded}) + "\n"


def rounds_parquet(store: Store) -> bytes:
    """A row a round."""
    rows = [{**row, "timing": json.dumps(row["timing"])} for row in map(described, store.rounds())]
    return _parquet(pa.Table.from_pylist(rows) if rows else pa.table({"round": pa.array([], "i8")}))


def steps_parquet(store: Store) -> bytes:
    """A row a step, with its round and number."""
    columns: dict[str, list[np.ndarray]] = {}
    for one in store.rounds():
        steps = store.steps(one.id)
        found = {"round": np.full(len(steps), one.id), "step": np.arange(len(steps))}
        found |= {name: steps[name] for name in steps.dtype.names or ()}
        for name, values in found.items():
            columns.setdefault(name, []).append(values)
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return _parquet(pa.table(joined or {"round": np.zeros(0, np.int64)}))


def save_replay(path: Path, store: Store, kitchen: Kitchen, one: tables.Round) -> None:
    """A round as an animated picture.

    Raises:
        ValueError: nothing of it was recorded.
    """
    steps = store.steps(one.id)
    if not len(steps):
        raise ValueError(f"round {one.id} has no steps")
    index = kitchen.env.style_names.index(one.style)
    again = kitchen.arena.replay(index, one.game_seed, actions_of(steps))
    scores = np.concatenate([[0.0], np.cumsum(again.rewards)])
    kitchen.env.viewer.save_gif(
        path,
        kitchen.env,
        jax.tree.map(np.asarray, again.states),
        style=kitchen.env.style(one.style),
        scores=scores,
        title=one.style.replace("_", " "),
        caption=one.sentence,
    )


def _parquet(table: pa.Table) -> bytes:
    written = io.BytesIO()
    pq.write_table(table, written)
    return written.getvalue()


def write_all(folder: Path, store: Store) -> list[Path]:
    """Writes rounds.jsonl, rounds.parquet and steps.parquet; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[str, Iterable[bytes]] = {
        "rounds.jsonl": (line.encode() for line in rounds_jsonl(store)),
        "rounds.parquet": [rounds_parquet(store)],
        "steps.parquet": [steps_parquet(store)],
    }
    for name, parts in files.items():
        with (folder / name).open("wb") as stream:
            stream.writelines(parts)
    return [folder / name for name in files]
