"""A browser's connection to a round: keys come in, what changed goes out."""

import asyncio
import contextlib
import json
import time
from typing import Any, NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from experiments.study.controls import BUTTONS
from experiments.study.guard import MOST_FRAME_BYTES, Bucket, client_of, refused
from experiments.study.live import Hall, Live, message_of

MESSAGES_A_SECOND, MESSAGES_AT_ONCE = 60, 120
MOST_MALFORMED = 3
POLICY_VIOLATION, GONE, TAKEN_OVER = 1008, 4004, 4001
"""Why a connection was closed; the page knows these numbers."""


class Press(NamedTuple):
    """A button that went down or up."""

    button: str
    down: bool


class Away(NamedTuple):
    """The page was left: nothing is held any more."""


class Echo(NamedTuple):
    """The server's time, in milliseconds, as the browser got it a moment ago."""

    sent: float


def read_message(text: str) -> Press | Away | Echo:
    """What a browser says.

    Raises:
        ValueError: no page of ours says that.
    """
    if len(text) > MOST_FRAME_BYTES:
        raise ValueError(f"{len(text)} characters")
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("no JSON") from None
    match said:
        case {"button": str(button), "down": bool(down)} if button in BUTTONS and len(said) == 2:
            return Press(button, down)
        case {"away": True} if len(said) == 1:
            return Away()
        case {"echo": int(sent) | float(sent)} if len(said) == 1 and not isinstance(sent, bool):
            return Echo(float(sent))
    raise ValueError("no message of ours")


async def connect(socket: WebSocket, hall: Hall, live: Live) -> None:
    """Plays a round with a browser until it ends or the browser goes away.

    A second connection to the same round takes the place of the first.
    """
    await socket.accept()
    own = object()
    live.listener, live.absent_since = own, None
    live.hands.let_go()
    live.changed.set()  # wakes a former connection, which sees that it was replaced
    sender = asyncio.create_task(_send_changes(socket, hall, live, own))
    reader = asyncio.create_task(_read_keys(socket, live, own))
    try:
        await asyncio.wait((sender, reader), return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (sender, reader):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await task
        if live.listener is own:
            live.listener, live.absent_since = None, time.monotonic()
            live.hands.let_go()
        if socket.application_state is WebSocketState.CONNECTED:
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(TAKEN_OVER if live.listener is not None else 1000)


async def _send_changes(socket: WebSocket, hall: Hall, live: Live, own: object) -> None:
    """Sends what changed, as fast as the browser takes it: who is slow sees fewer steps."""
    shown: list[int] | None = None
    known: set[int] = set()
    while True:
        live.changed.clear()
        if live.listener is not own and not live.over:
            return
        message: dict[str, Any] = message_of(live, hall.pictures, shown, known)
        shown = live.board
        message["sent"] = round(1000 * time.monotonic(), 1)
        await socket.send_text(json.dumps(message, separators=(",", ":")))
        if live.over:
            return
        await live.changed.wait()


async def _read_keys(socket: WebSocket, live: Live, own: object) -> None:
    bucket, malformed = Bucket(MESSAGES_A_SECOND, MESSAGES_AT_ONCE), 0
    who = client_of(dict(socket.scope))
    while live.listener is own:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        if not bucket.take():
            refused("too many messages a second", who)
            await socket.close(POLICY_VIOLATION, "too many messages")
            return
        try:
            said = read_message(message.get("text") or "")
        except ValueError as error:
            malformed += 1
            refused(f"a message: {error}", who)
            if malformed > MOST_MALFORMED:
                await socket.close(POLICY_VIOLATION, "messages that make no sense")
                return
            continue
        match said:
            case Press(button, True):
                live.hands.press(button)
            case Press(button, False):
                live.hands.release(button)
            case Away():
                live.hands.let_go()
            case Echo(sent):
                delay = 1000 * time.monotonic() - sent
                if 0 <= delay < 60_000:
                    live.delays.append(delay)
