"""Rounds that are being played: one clock, one batched step an environment and tick.

At each tick the keys that the players hold are read, all games of an environment make one step,
and every browser is told what changed. Steps are kept in memory and stored once a second, all in
one transaction, so that a crash loses no more than that.
"""

import asyncio
import contextlib
import dataclasses
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from experiments.study import recording
from experiments.study.arena import Arena
from experiments.study.controls import Hands, controls_of
from experiments.study.pictures import Pictures, changes
from experiments.study.tables import BROKEN, FINISHED
from haland_jax.networks import Policy

SECONDS_BETWEEN_SAVES = 0.8
MOST_ABSENT_SECONDS = 120.0
"""A player who does not come back for so long will not."""
_log = logging.getLogger(__name__)


@dataclasses.dataclass
class Live:
    """One round that is being played.

    Attributes:
        number: in the database; None for a game that is not recorded.
        arena: where it is played.
        seat: which game there.
        style: number of the player's style.
        board: numbers of the tiles' pictures now.
        hands: the buttons that the player holds.
        step: steps played.
        score: sum of rewards.
        over: whether it came to its end.
        unsaved: steps that are not stored yet, from `saved` on.
        saved: steps that are stored.
        late: how late each tick came, milliseconds.
        delays: round-trip times that the browser measured, milliseconds.
        changed: set after every change, for who sends them.
        listener: identifies the connection that plays now.
        absent_since: when the player was last seen, `time.monotonic`; None while connected.
        leaving: whether its end is being stored.
    """

    number: int | None
    arena: Arena
    seat: int
    style: int
    board: list[int]
    hands: Hands
    step: int = 0
    score: float = 0.0
    over: bool = False
    unsaved: list[tuple[int, int, float, float]] = dataclasses.field(default_factory=list)
    saved: int = 0
    late: list[float] = dataclasses.field(default_factory=list)
    delays: list[float] = dataclasses.field(default_factory=list)
    changed: asyncio.Event = dataclasses.field(default_factory=asyncio.Event)
    listener: object | None = None
    absent_since: float | None = dataclasses.field(default_factory=time.monotonic)
    leaving: bool = False

    def timing(self) -> dict[str, float]:
        """How evenly the game ran, for the researcher."""
        found: dict[str, float] = {}
        for name, values in (("late", self.late), ("round_trip", self.delays)):
            for share in (50, 99):
                if values:
                    found[f"{name}_p{share}"] = round(float(np.percentile(values, share)), 2)
        return found


class Full(Exception):
    """Every seat is taken."""


class Hall:
    """All rounds that are being played.

    Attributes:
        hertz: ticks a second.
        pictures: of all tiles that were ever shown.
        rounds: those that go on, by any key.
        late: how late the last ticks came, milliseconds.
    """

    def __init__(
        self,
        hertz: float,
        save: Callable[[list[tuple[int, int, bytes]]], None],
        end: Callable[[int, str, dict[str, float]], None],
    ):
        """Prepares an empty hall; `run` is the clock.

        Args:
            hertz: ticks a second.
            save: stores steps: round, first step, packed steps.
            end: stores that a round ended: its number, its status, its timing.
        """
        self.hertz = hertz
        self.arenas: dict[str, Arena] = {}
        self.pictures = Pictures()
        self.rounds: dict[str, Live] = {}
        self.late: deque[float] = deque(maxlen=int(60 * hertz))
        self._free: dict[str, list[int]] = {}
        self._save, self._end = save, end
        # JAX and the database each have a thread, so that neither makes the clock wait.
        self._player = ThreadPoolExecutor(1, "arena")
        self._writer = ThreadPoolExecutor(1, "writer")
        self._saving: asyncio.Task[None] | None = None

    def add(self, arena: Arena) -> None:
        """Adds a compiled arena."""
        name = arena.env.name
        self._free[name] = list(range(arena.size))
        self.arenas = {**self.arenas, name: arena}  # the clock may be looking

    # --- Rounds ----------------------------------------------------------------------------------

    async def begin(
        self,
        key: str,
        environment: str,
        policy: Policy,
        style: int,
        seed: int,
        number: int | None = None,
        played: np.ndarray | None = None,
    ) -> Live:
        """Seats a round; it is played while somebody is connected to it.

        Args:
            key: to find it by.
            environment: its name.
            policy: the ego's actor.
            style: number of the player's style.
            seed: of the game.
            number: in the database; None where nothing is to be recorded.
            played: steps that were played before a crash, of `recording.STEP`.

        Raises:
            Full: all seats are taken.
        """
        arena, free = self.arenas[environment], self._free[environment]
        if not free:
            raise Full(f"all {arena.size} games of {environment} are taken")
        seat = free.pop(0)
        played = np.zeros(0, recording.STEP) if played is None else played
        actions = recording.actions_of(played)
        try:
            state = await self._in_arena(arena.resume, seat, policy, style, seed, actions)
        except BaseException:
            free.insert(0, seat)
            raise
        live = Live(
            number=number,
            arena=arena,
            seat=seat,
            style=style,
            board=self._board(arena, state, style),
            hands=Hands(controls_of(environment)),
            step=len(played),
            score=float(played["reward"].sum()),
            saved=len(played),
        )
        self.rounds[key] = live
        if live.step >= arena.env.max_steps:
            live.over = True
        return live

    async def leave(self, key: str, status: str = BROKEN) -> None:
        """Ends a round: stores what is left, frees its seat."""
        live = self.rounds.get(key)
        if live is None or live.leaving:
            return
        live.leaving, live.listener = True, None  # no more steps
        try:
            if live.number is not None:
                await self.save()
                number, timing = live.number, live.timing()
                # Found until the database knows, so that nobody takes it for lost.
                await self.in_writer(lambda: self._end(number, status, timing))
        except BaseException:
            live.leaving = False  # to be tried again
            raise
        del self.rounds[key]
        self._free[live.arena.env.name].append(live.seat)
        live.changed.set()

    # --- The clock -------------------------------------------------------------------------------

    async def run(self) -> None:
        """Ticks until it is cancelled."""
        period = 1.0 / self.hertz
        due = time.monotonic() + period
        saved = time.monotonic()
        while True:
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            try:
                await self._tick(due)
            except Exception:
                _log.exception("a tick failed")
            if time.monotonic() - saved >= SECONDS_BETWEEN_SAVES:
                saved = time.monotonic()
                if self._saving is None or self._saving.done():
                    self._saving = asyncio.create_task(self._save_and_drop())
            # A tick that came so late that the next one is due too does not make two.
            due = max(due + period, time.monotonic())

    async def _tick(self, due: float) -> None:
        """One step of all games whose players are there."""
        for arena in self.arenas.values():
            present = [
                (key, live)
                for key, live in self.rounds.items()
                if live.arena is arena and live.listener is not None and not live.over
            ]
            if not present:
                continue
            actions = np.zeros(arena.size, np.int32)
            playing = np.zeros(arena.size, bool)
            for _, live in present:
                actions[live.seat] = live.hands.act()
                playing[live.seat] = True
            seats = [(live.seat, live.style) for _, live in present]
            played, boards = await self._in_arena(self._advance, arena, actions, playing, seats)
            late = 1000 * (time.monotonic() - due)
            self.late.append(late)
            for (key, live), board in zip(present, boards, strict=True):
                if self.rounds.get(key) is not live:
                    continue  # it ended meanwhile
                seat = live.seat
                reward = float(played.reward[seat])
                live.unsaved.append(
                    (int(played.ego_action[seat]), int(actions[seat]), reward, late)
                )
                live.late.append(late)
                live.board = board
                live.step += 1
                live.score += reward
                live.over = bool(played.done[seat])
                live.changed.set()

    def _advance(
        self,
        arena: Arena,
        actions: np.ndarray,
        playing: np.ndarray,
        seats: list[tuple[int, int]],
    ) -> Any:
        played, states = arena.advance(actions, playing)
        boards = [
            self._board(arena, jax.tree.map(lambda leaf, s=seat: leaf[s], states), style)
            for seat, style in seats
        ]
        return played, boards

    def _board(self, arena: Arena, state: Any, style: int) -> list[int]:
        return self.pictures.board(arena.draw(state, style))

    async def _drop_the_absent(self) -> None:
        """Ends rounds whose players have been away for too long, and games that came to an end."""
        now = time.monotonic()
        for key, live in list(self.rounds.items()):
            away = live.absent_since
            if live.over and live.number is not None:
                await self.leave(key, FINISHED)
            elif away is not None and now - away > MOST_ABSENT_SECONDS:
                await self.leave(key, FINISHED if live.over else BROKEN)

    # --- Storing ---------------------------------------------------------------------------------

    async def save(self) -> None:
        """Stores all steps that are not stored yet, in one transaction."""
        taken = [(live, *self._take(live)) for live in list(self.rounds.values())]
        parts: list[tuple[int, int, bytes]] = []
        for live, first, steps in taken:
            if live.number is not None and steps:
                parts.append((live.number, first, recording.pack(steps)))
        if not parts:
            return
        try:
            await self.in_writer(lambda: self._save(parts))
        except BaseException:
            for live, first, steps in taken:  # to be stored another time
                live.unsaved[:0], live.saved = steps, first
            raise

    @staticmethod
    def _take(live: Live) -> tuple[int, list[tuple[int, int, float, float]]]:
        """A round's steps that are not stored yet, and the number of the first; none are left."""
        first, steps = live.saved, live.unsaved
        live.saved, live.unsaved = first + len(steps), []
        return first, steps

    async def _save_and_drop(self) -> None:
        """What happens beside the clock, once a second."""
        try:
            await self.save()
            await self._drop_the_absent()
        except Exception:
            _log.exception("steps could not be stored; they will be tried again")

    async def close(self) -> None:
        """Stores everything; rounds that were going on can be gone on with."""
        with contextlib.suppress(Exception):
            if self._saving is not None:
                await self._saving
        await self.save()
        self._player.shutdown()
        self._writer.shutdown()

    async def _in_arena(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(
            self._player, lambda: function(*arguments)
        )

    async def in_writer(self, function: Callable[[], Any]) -> Any:
        """Runs a function that uses the database, after those that were asked for before."""
        return await asyncio.get_running_loop().run_in_executor(self._writer, function)


def message_of(live: Live, pictures: Pictures, shown: list[int] | None, known: set[int]) -> Any:
    """What a browser is told of a round.

    Args:
        live: the round.
        pictures: of all tiles.
        shown: what the browser shows; None for nothing.
        known: numbers of pictures that it has; those that are sent are added.
    """
    tiles = changes(shown, live.board)
    new = {number for _, number in tiles} - known
    known |= new
    return {
        "step": live.step,
        "score": round(live.score, 3),
        "tiles": tiles,
        "pictures": {number: pictures[number] for number in sorted(new)},
        "over": live.over,
    }
