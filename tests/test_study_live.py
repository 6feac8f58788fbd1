"""Live rounds: the clock, what is stored when, who is dropped, what a restart takes up."""

import asyncio
import contextlib
import itertools
import time

import numpy as np
import pytest

from experiments.models import open_model
from experiments.study import live as live_module
from experiments.study import recording
from experiments.study.controls import ACT, DOWN, LEFT, RIGHT, UP, Hands, controls_of
from experiments.study.live import Full, message_of
from experiments.study.store import Store
from experiments.study.study import Kitchen, Settings, Study, key_of
from experiments.study.tables import BROKEN, FINISHED, PLAYING

MODEL = "pretrained:lbf/spread"


@pytest.fixture(scope="module")
def kitchen():
    found = Kitchen(MODEL, open_model(MODEL), 2)
    found.compile()
    return found


@pytest.fixture
def study(kitchen, database_url):
    """A study whose game is compiled already, at fifty steps a second."""
    store = Store(database_url)
    yield made(kitchen, store)
    store.close()


def made(kitchen, store, **settings):
    found = Study(Settings(("haland", "oracle"), hertz=30.0, players=2, **settings), store)
    found.kitchens[kitchen.env.name] = kitchen
    found.hall.add(kitchen.arena)
    return found


def begin(study, sentence="The largest food."):
    """Enrols somebody and makes the agent of their next round."""
    participant, token = study.enrol()
    participant = study.store.participant(token)
    return participant, study.make(participant, sentence)


@contextlib.asynccontextmanager
async def running(hall):
    clock = asyncio.create_task(hall.run())
    yield
    clock.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await clock


async def until(true, seconds=20):
    for _ in range(100 * seconds):
        if true():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not happen")


def there(live):
    live.listener, live.absent_since = object(), None


def test_hands_say_what_is_held_or_was_pressed():
    hands = Hands(controls_of("overcooked/crossway"))
    assert hands.act() == 4
    hands.press(UP)
    hands.release(UP)
    assert [hands.act(), hands.act()] == [0, 4], "a short press counts once"
    hands.press(LEFT)
    assert [hands.act() for _ in range(3)] == [3, 3, 3], "the last key held"
    hands.press(RIGHT)
    assert [hands.act(), hands.act()] == [2, 2]
    hands.release(RIGHT)
    assert hands.act() == 3
    hands.press(ACT)
    assert [hands.act(), hands.act()] == [5, 3], "the space bar acts once a press"
    hands.let_go()
    assert hands.act() == 4
    for _ in range(50):
        hands.press(UP)
    assert [hands.act() for _ in range(4)][2:] == [0, 0], "nothing piles up"
    lifting = Hands(controls_of("lbf/spread"))
    lifting.press(ACT)
    assert [lifting.act() for _ in range(3)] == [5, 5, 5], "lifting takes both at once"
    with pytest.raises(ValueError, match="assistive/jaco cannot be played with keys"):
        controls_of("assistive/jaco")


def test_a_round_is_played_stored_and_finished(study):
    participant, (made_agent, begun) = begin(study)

    async def play():
        live = await study.begin(participant, made_agent, begun)
        await asyncio.sleep(0)
        async with running(study.hall):
            await asyncio.sleep(0.3)
            assert live.step == 0, "nobody is there yet"
            there(live)
            await until(lambda: live.step > 30)
            stored = len(study.store.steps(live.number))
            assert 0 < stored < live.step + 1
            await until(lambda: key_of(live.number) not in study.hall.rounds)
            return live

    live = asyncio.run(play())
    assert live.over
    assert live.step == 50
    one = study.store.round(live.number)
    assert (one.status, one.steps) == (FINISHED, 50)
    assert one.timing["late_p99"] >= 0
    film = study.replay(one)
    assert len(film["frames"]) == 51
    assert film["frames"][-1]["score"] == one.score
    shown = {picture for frame in film["frames"] for _, picture in frame["tiles"]}
    assert shown == set(film["pictures"])


def test_steps_that_could_not_be_stored_are_stored_later(study, monkeypatch):
    participant, (made_agent, begun) = begin(study)
    stored, failing = study.hall._save, [True]

    def sometimes(parts):
        if failing[0]:
            raise OSError("the disk is full")
        stored(parts)

    study.hall._save = sometimes

    async def play():
        live = await study.begin(participant, made_agent, begun)
        there(live)
        async with running(study.hall):
            await until(lambda: live.step > 28)
            assert len(study.store.steps(live.number)) == 0
            failing[0] = False
            await until(lambda: key_of(live.number) not in study.hall.rounds)
            return live

    live = asyncio.run(play())
    assert len(study.store.steps(live.number)) == 50


def test_who_stays_away_is_dropped_and_seats_are_free_again(study, monkeypatch):
    people = [begin(study) for _ in range(3)]

    async def play():
        lives = [await study.begin(person, *agent) for person, agent in people[:2]]
        with pytest.raises(Full, match="all 2 games of lbf/spread are taken"):
            await study.begin(people[2][0], *people[2][1])
        there(lives[1])
        monkeypatch.setattr(live_module, "MOST_ABSENT_SECONDS", 0.2)
        async with running(study.hall):
            await until(lambda: key_of(lives[0].number) not in study.hall.rounds)
            third = begin(study)
            late = await study.begin(third[0], *third[1])
            assert late.seat == lives[0].seat
        return lives

    lives = asyncio.run(play())
    assert study.store.round(lives[0].number).status == BROKEN
    refused = [one for one in study.store.rounds() if one.participant_id == people[2][0].id]
    assert [one.status for one in refused] == [BROKEN]


def test_a_browser_is_told_what_changed(study):
    participant, (made_agent, begun) = begin(study)

    async def play():
        live = await study.begin(participant, made_agent, begun)
        known: set[int] = set()
        first = message_of(live, study.hall.pictures, None, known)
        assert len(first["tiles"]) == 81
        assert set(first["pictures"]) == known
        there(live)
        board, ways = live.board, itertools.cycle((UP, LEFT, DOWN, RIGHT))

        def somebody_moved():
            live.hands.press(next(ways))  # a wall or food may be in one way, and the agent may wait
            return live.board != board

        async with running(study.hall):
            await until(somebody_moved)
        following = message_of(live, study.hall.pictures, board, known)
        assert 0 < len(following["tiles"]) < 10
        assert following["step"] == live.step

    asyncio.run(play())


def test_what_cannot_go_on_is_marked_broken(study, kitchen):
    """Another model, other parameters, a recording with a hole; and one that is sound."""
    numbers = []
    for change in ("fingerprint", "policy", "environment", "steps", None):
        participant, (_, begun) = begin(study)
        number = study.store.begin_round(participant.id, begun)
        numbers.append(number)
        steps = recording.pack([(0, 0, 0.0, 1.0)] * 3)
        study.store.add_steps([(number, 0 if change != "steps" else 2, steps)])
        if change in ("fingerprint", "policy", "environment"):
            with study.store.session() as session:
                one = session.get_one(type(study.store.round(number)), number)
                setattr(one, change, b"1234" if change == "policy" else "another")
    again = made(kitchen, study.store)
    assert asyncio.run(again.resume()) == {"resumed": 1, BROKEN: 4}
    statuses = [study.store.round(number).status for number in numbers]
    assert statuses == [BROKEN] * 4 + [PLAYING]
    (live,) = again.hall.rounds.values()
    assert (live.step, live.saved) == (3, 3)


def test_settings_that_make_no_sense_are_refused(kitchen):
    for name, value in (("blocks", 0), ("hertz", 1000.0), ("players", 0)):
        with pytest.raises(ValueError, match=f"{name} is {value}; expected"):
            Settings(("haland",), **{name: value})
    with pytest.raises(ValueError, match="conditions is empty"):
        Settings(())
    with pytest.raises(ValueError, match="the model has no agent 'universal'; expected haland"):
        kitchen.agents.make("universal", "The largest food.", 0)


def test_agents_are_what_they_should_be(kitchen):
    agents, model = kitchen.agents, kitchen.model
    oracle = agents.make("oracle", "Please lift the largest food with me.", 5)
    assert oracle.sounds_like == "level_8"
    chosen = model.oracles["params"]
    leaf = next(iter(sorted(chosen)))
    expected = {k: v[7, 5 % model.held_out_seeds] for k, v in chosen[leaf].items()}
    for name, value in expected.items():
        np.testing.assert_array_equal(oracle.policy["params"][leaf][name], value)
    start = time.monotonic()
    one, other = (agents.make("haland", "Level 3, please.", seed) for seed in (1, 2))
    assert time.monotonic() - start < 5
    same = agents.make("haland", "Level 3, please.", 1)
    assert agents.pack(one.policy) == agents.pack(same.policy)
    assert agents.pack(one.policy) != agents.pack(other.policy)
    assert agents.pack(agents.unpack(agents.pack(one.policy))) == agents.pack(one.policy)
