"""What the study keeps, in SQLite or PostgreSQL. Every function is one transaction."""

import datetime as dt
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from sqlalchemy import event, select
from sqlalchemy.orm import Session, joinedload, sessionmaker

from experiments.study import recording
from experiments.study.plan import Planned
from experiments.study.tables import (
    BROKEN,
    END,
    FINISHED,
    PLAYING,
    STAGES,
    Chunk,
    Participant,
    Round,
)

MIGRATIONS = Path(__file__).parent / "migrations"
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"  # none that looks like another


class Begun(NamedTuple):
    """What is stored when a round begins; see `tables.Round`."""

    number: int
    condition: str
    environment: str
    model: str
    fingerprint: str
    style: str
    sentence: str
    sounds_like: str
    agent_seed: int
    game_seed: int
    policy: bytes
    hertz: float


class Store:
    """The study's database."""

    def __init__(self, url: str):
        """Opens the database and brings its tables up to date.

        Args:
            url: such as sqlite:///study.db or postgresql+psycopg://user:password@host/name.

        Raises:
            sqlalchemy.exc.SQLAlchemyError: it cannot be opened.
        """
        parsed = sa.make_url(url)
        if parsed.drivername == "postgresql":
            parsed = parsed.set(drivername="postgresql+psycopg")
        self._engine = sa.create_engine(parsed, pool_pre_ping=True)
        if self._engine.dialect.name == "sqlite":
            event.listen(self._engine, "connect", _set_up_sqlite)
        self._session = sessionmaker(self._engine, expire_on_commit=False)
        with self._engine.begin() as connection:
            config = Config()
            config.set_main_option("script_location", str(MIGRATIONS))
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    @property
    def shown_url(self) -> str:
        """Where the database is, without the password."""
        return self._engine.url.render_as_string(hide_password=True)

    def close(self) -> None:
        """Closes all connections."""
        self._engine.dispose()

    @contextmanager
    def session(self) -> Iterator[Session]:
        """A transaction: committed at the end, rolled back after an exception."""
        with self._session.begin() as session:
            yield session

    # --- Participants ----------------------------------------------------------------------------

    def enrol(self, plan_of: Any) -> tuple[Participant, str]:
        """A new participant, and what their browser must hold.

        Args:
            plan_of: gives the rounds, `Planned`, from the number of participants before.
        """
        token = secrets.token_urlsafe(32)
        with self.session() as session:
            before = session.scalar(select(sa.func.count()).select_from(Participant)) or 0
            planned: list[Planned] = plan_of(before)
            participant = Participant(
                code="".join(secrets.choice(_LETTERS) for _ in range(10)),
                token=_hashed(token),
                stage=STAGES[0],
                plan=[one._asdict() for one in planned],
                consented=_now(),
            )
            session.add(participant)
        return participant, token

    def participant(self, token: str) -> Participant | None:
        """Who holds a token, with their rounds."""
        with self.session() as session:
            found = session.scalar(select(Participant).where(Participant.token == _hashed(token)))
            if found is not None:
                _ = found.rounds
            return found

    def go_on(self, participant: int, stage: str) -> None:
        """Takes a participant to a stage."""
        with self.session() as session:
            found = session.get_one(Participant, participant)
            found.stage = stage
            if stage == END:
                found.ended = _now()

    # --- Rounds ----------------------------------------------------------------------------------

    def begin_round(self, participant: int, begun: Begun) -> int:
        """Stores that a round has begun; returns its number in the database.

        Raises:
            sqlalchemy.exc.IntegrityError: the participant has had that round.
        """
        with self.session() as session:
            one = Round(participant_id=participant, status=PLAYING, began=_now(), **begun._asdict())
            session.add(one)
            session.flush()
            return one.id

    def add_steps(self, parts: Iterable[tuple[int, int, bytes]]) -> None:
        """Stores steps of any rounds in one transaction: round, first step, packed steps."""
        rows = [{"round_id": one, "first": first, "data": data} for one, first, data in parts]
        if rows:
            with self.session() as session:
                session.execute(sa.insert(Chunk), rows)

    def end_round(
        self, number: int, status: str, *, timing: Mapping[str, Any] | None = None
    ) -> None:
        """Marks a round as finished or broken; steps and score come from what is stored.

        Raises:
            ValueError: it is said to be finished, but its recording is damaged.
        """
        read = recording.sound_part if status == BROKEN else recording.unpack
        with self.session() as session:
            one = session.get_one(Round, number)
            steps = read((c.first, c.data) for c in one.chunks)
            one.status, one.ended = status, _now()
            one.steps, one.score = len(steps), float(steps["reward"].sum())
            one.timing = None if timing is None else dict(timing)

    def rate(self, number: int, rating: int, comment: str) -> None:
        """Stores what the player thought of a round."""
        with self.session() as session:
            one = session.get_one(Round, number)
            one.rating, one.comment = rating, comment or None

    def steps(self, number: int) -> np.ndarray:
        """A round's steps, [T] of `recording.STEP`."""
        with self.session() as session:
            rows = session.execute(
                select(Chunk.first, Chunk.data).where(Chunk.round_id == number)
            ).all()
        return recording.unpack((row.first, row.data) for row in rows)

    def round(self, number: int) -> Round:
        """A round with its policy."""
        with self.session() as session:
            found = session.get_one(Round, number)
            _ = found.policy
            return found

    def rounds(self, *statuses: str) -> list[Round]:
        """All rounds, or those of some status, oldest first, with their participants."""
        query = select(Round).order_by(Round.id)
        if statuses:
            query = query.where(Round.status.in_(statuses))
        with self.session() as session:
            found = list(session.scalars(query.options(joinedload(Round.participant))))
        return found

    def progress(self) -> dict[str, int]:
        """How many participants are at each stage, and rounds of each status."""
        with self.session() as session:
            stages = session.execute(
                select(Participant.stage, sa.func.count()).group_by(Participant.stage)
            ).all()
            statuses = session.execute(
                select(Round.status, sa.func.count()).group_by(Round.status)
            ).all()
        found = dict.fromkeys((*STAGES, PLAYING, FINISHED, BROKEN), 0)
        return found | {row[0]: row[1] for row in (*stages, *statuses)}


def next_round(participant: Participant) -> tuple[int, Planned] | None:
    """Number and content of the participant's next round; None where all have been begun."""
    number = len(participant.rounds)
    if number >= len(participant.plan):
        return None
    return number, Planned(**participant.plan[number])


def unrated(participant: Participant) -> Round | None:
    """The finished round that still is to be rated, if there is one."""
    found = (one for one in participant.rounds if one.status == FINISHED and one.rating is None)
    return next(found, None)


def going_on(participant: Participant) -> Round | None:
    """The round that the participant is in, if there is one."""
    return next((one for one in participant.rounds if one.status == PLAYING), None)


def _set_up_sqlite(connection: Any, record: Any) -> None:
    """Readers beside a writer, checked references, and patience with a busy database."""
    del record
    cursor = connection.cursor()
    for setting in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {setting}")
    cursor.execute("PRAGMA busy_timeout=10000")
    cursor.close()


def _hashed(token: str) -> str:
    return sha256(token.encode()).hexdigest()


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
