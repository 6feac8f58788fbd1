"""What the study keeps, on SQLite and, where it is installed, on a PostgreSQL server."""

import datetime as dt
import threading

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from experiments.study import recording, store
from experiments.study.plan import Planned
from experiments.study.store import Begun, Store
from experiments.study.tables import BROKEN, END, FINISHED, PLAYING, Base, Participant

PLAN = [Planned("haland", 3), Planned("oracle", 0)]


@pytest.fixture
def kept(database_url):
    found = Store(database_url)
    yield found
    found.close()


def begun(number=0, **changes):
    values = {
        "number": number,
        "condition": "haland",
        "environment": "lbf/spread",
        "model": "pretrained:lbf/spread",
        "fingerprint": "f" * 64,
        "style": "level_1",
        "sentence": "Robert'); DROP TABLE rounds;-- <script>alert(1)</script>",
        "sounds_like": "level_2",
        "agent_seed": 2**31 - 1,
        "game_seed": 0,
        "policy": bytes(range(256)),
        "hertz": 6.0,
    }
    return Begun(**(values | changes))


def test_a_new_database_has_the_tables_that_the_code_expects(kept):
    with kept._engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []


def test_a_participant_is_found_by_what_the_browser_holds(kept, database_url):
    seen = []

    def plan_of(before):
        seen.append(before)
        return PLAN

    first, token = kept.enrol(plan_of)
    second, other = kept.enrol(plan_of)
    assert seen == [0, 1]
    assert first.code != second.code
    found = kept.participant(token)
    assert (found.id, found.stage, found.rounds) == (first.id, "instructions", [])
    assert found.consented.tzinfo is not None
    assert abs(found.consented - dt.datetime.now(dt.UTC)) < dt.timedelta(minutes=1)
    assert kept.participant(other).id == second.id
    assert kept.participant("' OR 1=1 --") is None
    with kept.session() as session:
        stored = session.get_one(Participant, first.id)
        assert token not in stored.token, "only its hash is stored"
    kept.go_on(first.id, END)
    again = Store(database_url)  # nothing is lost, and nothing is made twice
    assert again.participant(token).ended is not None
    assert again.progress()["end"] == 1
    assert again.progress()["instructions"] == 1
    again.close()


def test_a_round_from_its_beginning_to_its_rating(kept):
    participant, token = kept.enrol(lambda _: PLAN)
    assert store.next_round(kept.participant(token)) == (0, PLAN[0])
    number = kept.begin_round(participant.id, begun())
    found = kept.participant(token)
    assert store.going_on(found).id == number
    assert store.unrated(found) is None
    assert store.next_round(found) == (1, PLAN[1])
    with pytest.raises(sa.exc.IntegrityError):
        kept.begin_round(participant.id, begun())
    steps = [(1, 2, 20.0, 3), (4, 5, 0.0, 70_000), (0, 0, -0.5, 0)]
    kept.add_steps([(number, 0, recording.pack(steps[:2])), (number, 2, recording.pack(steps[2:]))])
    kept.add_steps([])
    with pytest.raises(sa.exc.IntegrityError):
        kept.add_steps([(number, 2, b"")])
    assert kept.steps(number)["reward"].tolist() == [20.0, 0.0, -0.5]
    kept.end_round(number, FINISHED, timing={"late_p99": 3.5})
    found = kept.participant(token)
    assert store.going_on(found) is None
    assert store.unrated(found).id == number
    kept.rate(number, 5, "<b>fine</b>")
    found = kept.participant(token)
    assert store.unrated(found) is None
    (one,) = found.rounds
    assert (one.status, one.steps, one.score, one.rating) == (FINISHED, 3, 19.5, 5)
    assert (one.comment, one.timing, one.sentence) == (
        "<b>fine</b>", {"late_p99": 3.5}, begun().sentence
    )  # fmt: skip
    assert kept.round(number).policy == bytes(range(256))
    second = kept.begin_round(participant.id, begun(1))
    kept.end_round(second, BROKEN)
    assert kept.progress()[PLAYING] == 0
    assert [one.id for one in kept.rounds(BROKEN)] == [second]
    assert [one.participant.code for one in kept.rounds()] == [participant.code] * 2
    assert store.next_round(kept.participant(token)) is None


@pytest.mark.parametrize("rating", [0, 6, -1])
def test_the_database_takes_no_rating_that_is_none(kept, rating):
    participant, _ = kept.enrol(lambda _: PLAN)
    number = kept.begin_round(participant.id, begun())
    with pytest.raises(sa.exc.IntegrityError):
        kept.rate(number, rating, "")


def test_many_write_at_once(kept):
    """Twenty rounds store steps while others read, and nothing is lost."""
    numbers = []
    for _ in range(20):
        participant, _ = kept.enrol(lambda _: PLAN)
        numbers.append(kept.begin_round(participant.id, begun()))
    failed = []

    def write(number):
        try:
            for first in range(0, 60, 6):
                kept.add_steps([(number, first, recording.pack([(1, 2, 1.0, 0)] * 6))])
                kept.steps(number)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(number,)) for number in numbers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert [len(kept.steps(number)) for number in numbers] == [60] * 20
