"""The rounds that people played, from a study's folder, its database, or an exported file."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.base import Pair
from experiments.errors import UserError


class Recorded(NamedTuple):
    """A round that was played to its end.

    Attributes:
        participant: the player's code.
        condition: the agent's kind.
        environment: its name.
        style: what the player was asked to be.
        game_seed: of the game.
        rating: 1 to 5; None where the player gave none.
        actions: what both did, `Pair` of int32 [T].
        rewards: float32 [T].
    """

    participant: str
    condition: str
    environment: str
    style: str
    game_seed: int
    rating: int | None
    actions: Pair
    rewards: np.ndarray

    @property
    def score(self) -> float:
        """Sum of rewards."""
        return float(self.rewards.sum())


def read_rounds(source: str) -> list[Recorded]:
    """The rounds of a study that were played to their end.

    Args:
        source: a study's folder, its database's URL, or rounds.jsonl from its administration.

    Raises:
        UserError: there are none, or the source cannot be read.
    """
    found = _from_file(Path(source)) if source.endswith(".jsonl") else _from_database(source)
    if not found:
        raise UserError(
            f"{source} holds no finished rounds; let people play some: python -m experiments.study"
        )
    return found


def _from_file(path: Path) -> list[Recorded]:
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return [
            _recorded(
                row,
                Pair(*(np.array(row["recorded"][who], np.int32) for who in ("ego", "person"))),
                np.array(row["recorded"]["reward"], np.float32),
            )
            for row in rows
            if row["status"] == "finished"
        ]
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no rounds.jsonl of a study ({error!r})") from None


def _from_database(source: str) -> list[Recorded]:
    from sqlalchemy.exc import SQLAlchemyError

    from experiments.study.export import described
    from experiments.study.recording import actions_of
    from experiments.study.store import Store
    from experiments.study.tables import FINISHED

    if "://" not in source:
        file = Path(source) / "study.db"
        if not file.is_file():
            raise UserError(f"{file} is missing; name a study's folder, a URL or rounds.jsonl")
        source = f"sqlite:///{file}"
    try:
        store = Store(source)
    except SQLAlchemyError as error:
        raise UserError(f"the database cannot be opened: {str(error).splitlines()[0]}") from None
    found = []
    for one in store.rounds(FINISHED):
        steps = store.steps(one.id)
        found.append(_recorded(described(one), actions_of(steps), steps["reward"]))
    store.close()
    return found


def _recorded(row: dict[str, Any], actions: Pair, rewards: np.ndarray) -> Recorded:
    names = ("participant", "condition", "environment", "style", "game_seed", "rating")
    return Recorded(**{name: row[name] for name in names}, actions=actions, rewards=rewards)
