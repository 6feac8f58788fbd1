"""The study's database: participants, their rounds, the steps of the rounds."""

import datetime as dt
from typing import Any

from sqlalchemy import (
    JSON,
    CheckConstraint,
    DateTime,
    ForeignKey,
    LargeBinary,
    MetaData,
    String,
    TypeDecorator,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship

PLAYING, FINISHED, BROKEN = "playing", "finished", "broken"
"""What a round is: it goes on, it came to its end, or it will not be played to its end."""
INSTRUCTIONS, DEMONSTRATION, ROUNDS, END = "instructions", "demonstration", "rounds", "end"
STAGES = (INSTRUCTIONS, DEMONSTRATION, ROUNDS, END)
"""Where a participant is."""


class Moment(TypeDecorator[dt.datetime]):
    """A moment in UTC, also on databases that keep no time zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: dt.datetime | None, dialect: Any) -> dt.datetime | None:
        """To the database."""
        del dialect
        return None if value is None else value.astimezone(dt.UTC)

    def process_result_value(self, value: dt.datetime | None, dialect: Any) -> dt.datetime | None:
        """From the database."""
        del dialect
        return value if value is None or value.tzinfo else value.replace(tzinfo=dt.UTC)


class Base(DeclarativeBase):
    """All tables; constraints have names, so that migrations can change them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(column_0_label)s",
            "uq": "uq_%(table_name)s_%(column_0_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class Participant(Base):
    """A person who takes part; nothing says who.

    Attributes:
        code: opaque; what the person is told, to be named by when records are to be deleted.
        token: SHA-256 of what the person's browser holds.
        stage: where the person is, one of `STAGES`.
        plan: the rounds to come, a list of {"condition", "style"}.
        consented: when.
        ended: when the last page was reached.
    """

    __tablename__ = "participants"

    id: Mapped[int] = mapped_column(primary_key=True)
    code: Mapped[str] = mapped_column(String(16), unique=True)
    token: Mapped[str] = mapped_column(String(64), unique=True)
    stage: Mapped[str] = mapped_column(String(16))
    plan: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    consented: Mapped[dt.datetime] = mapped_column(Moment)
    ended: Mapped[dt.datetime | None] = mapped_column(Moment)
    rounds: Mapped[list["Round"]] = relationship(
        back_populates="participant", order_by="Round.number", cascade="all, delete-orphan"
    )


class Round(Base):
    """A round that was begun.

    Attributes:
        number: of the participant's rounds, from 0.
        condition: the agent's kind, hidden from the player.
        environment: its name.
        model: what the agent came from, as `--run` names it.
        fingerprint: SHA-256 of that model's parameters.
        style: what the player was asked to be.
        sentence: what the player said of it.
        sounds_like: the style whose task language is nearest to the sentence's.
        agent_seed: of the agent's making.
        game_seed: of the game.
        policy: the agent's parameters, packed.
        status: one of `PLAYING`, `FINISHED`, `BROKEN`.
        hertz: steps a second.
        steps: how many were played; written at the end.
        score: sum of rewards; written at the end.
        rating: 1 (very dissatisfied) to 5 (very satisfied).
        comment: what else the player said.
        timing: how evenly the game ran, a dictionary of milliseconds.
    """

    __tablename__ = "rounds"
    __table_args__ = (
        UniqueConstraint("participant_id", "number"),
        CheckConstraint("rating BETWEEN 1 AND 5", name="rating"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participants.id"), index=True)
    number: Mapped[int]
    condition: Mapped[str] = mapped_column(String(32))
    environment: Mapped[str] = mapped_column(String(64))
    model: Mapped[str] = mapped_column(String(256))
    fingerprint: Mapped[str] = mapped_column(String(64))
    style: Mapped[str] = mapped_column(String(64))
    sentence: Mapped[str] = mapped_column(String(500))
    sounds_like: Mapped[str] = mapped_column(String(64))
    agent_seed: Mapped[int]
    game_seed: Mapped[int]
    policy: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    status: Mapped[str] = mapped_column(String(16), index=True)
    hertz: Mapped[float]
    began: Mapped[dt.datetime] = mapped_column(Moment)
    ended: Mapped[dt.datetime | None] = mapped_column(Moment)
    steps: Mapped[int | None]
    score: Mapped[float | None]
    rating: Mapped[int | None]
    comment: Mapped[str | None] = mapped_column(String(2000))
    timing: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    participant: Mapped[Participant] = relationship(back_populates="rounds")
    chunks: Mapped[list["Chunk"]] = relationship(
        back_populates="round", order_by="Chunk.first", cascade="all, delete-orphan"
    )


class Chunk(Base):
    """Some steps of a round, packed as in `recording`."""

    __tablename__ = "chunks"

    round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), primary_key=True)
    first: Mapped[int] = mapped_column(primary_key=True)
    data: Mapped[bytes] = mapped_column(LargeBinary)
    round: Mapped[Round] = relationship(back_populates="chunks")
