"""A crash in the middle of twenty rounds: what was stored stays, and every round goes on."""

import asyncio
import random
import time

import numpy as np
import pytest
from study_server import MODEL, free_port, serving, stop_hard

from experiments.models import open_model
from experiments.study.crowd import Player
from experiments.study.recording import actions_of
from experiments.study.store import Store
from experiments.study.study import Kitchen
from experiments.study.tables import FINISHED, PLAYING

pytestmark = [pytest.mark.slow, pytest.mark.timeout(500)]
PLAYERS, HERTZ = 20, 6.0
LOST_AT_MOST = HERTZ * 1.0


async def begin(port):
    crowd = [Player(f"http://127.0.0.1:{port}") for _ in range(PLAYERS)]
    for player in crowd:
        await player.enrol()
        await player.begin("Food number eight, please.")
    return crowd


async def play(crowd, seconds, after=None):
    """All play; after some time, something happens."""
    playing = [
        asyncio.create_task(player.play(seconds, random.Random(index), presses=1.0))
        for index, player in enumerate(crowd)
    ]
    if after is not None:
        wait, happen = after
        await asyncio.sleep(wait)
        happen()
    await asyncio.gather(*playing)


def test_no_round_is_lost(tmp_path, database_url):
    port = free_port()
    more = ("--hertz", str(HERTZ), "--database", database_url)
    with serving(tmp_path, port, *more, model=MODEL) as (process, _):
        crowd = asyncio.run(begin(port))
        asyncio.run(play(crowd, 30, after=(3.3, lambda: stop_hard(process))))
    seen = [max((step for step, _, _ in player.frames), default=0) for player in crowd]
    assert min(seen) >= 3
    store = Store(database_url)
    rounds = store.rounds()
    assert [one.status for one in rounds] == [PLAYING] * PLAYERS
    stored = {one.id: store.steps(one.id) for one in rounds}
    for one, steps in zip(rounds, seen, strict=True):
        assert len(stored[one.id]) >= steps - LOST_AT_MOST

    with serving(tmp_path, port, *more, model=MODEL):
        for player in crowd:
            player.frames.clear()
        # Half of them come back.
        back = crowd[: PLAYERS // 2]
        asyncio.run(play(back, 20))
        assert all(player.over for player in back)
        for player, one in zip(back, rounds, strict=False):
            first, score, _ = player.frames[0]
            before = stored[one.id]
            assert first >= len(before) - 1, "the game goes on where it was stored"
            assert score >= before["reward"].sum() - 1e-6
        time.sleep(2)
        found = {one.id: one for one in store.rounds()}
        kitchen = Kitchen("x", open_model(MODEL), 1)
        for index, one in enumerate(rounds):
            if index >= len(back):
                assert found[one.id].status == PLAYING, "who is away may still come back"
                continue
            assert found[one.id].status == FINISHED
            steps = store.steps(one.id)
            before = stored[one.id]
            np.testing.assert_array_equal(steps[: len(before)], before)
            assert len(steps) == found[one.id].steps > len(before)
            style = kitchen.env.style_names.index(one.style)
            again = kitchen.arena.replay(style, one.game_seed, actions_of(steps))
            np.testing.assert_array_equal(again.rewards, steps["reward"])
    store.close()
