"""What keeps hostile input out: sizes, origins, rates, headers."""

import logging
import time
from collections import deque
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BODY_BYTES = 16_384
MOST_FRAME_BYTES = 512
_HEADERS = {
    b"content-security-policy": b"default-src 'self'; frame-ancestors 'none'; form-action 'self'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"same-origin",
    b"cache-control": b"no-store",
}
_log = logging.getLogger("experiments.study.refused")


def refused(why: str, who: str) -> None:
    """Writes to the log that something was refused; what strangers sent is quoted and cut."""
    _log.warning("refused: %s, from %s", why, who)


class Guard:
    """Wraps the application: foreign origins and large bodies never reach it."""

    def __init__(self, app: ASGIApp):
        """Wraps an ASGI application."""
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves one request or connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers, who = Headers(scope=scope), client_of(scope)
        asks = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if asks and not same_origin(headers):
            refused(f"origin {headers.get('origin', '')[:100]!r}", who)
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                await PlainTextResponse("another site asked for this", 403)(scope, receive, send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MOST_BODY_BYTES:
            refused(f"a body of {length[:20]!r} bytes", who)
            await PlainTextResponse("too long", 413)(scope, receive, send)
            return
        received = 0

        async def limited() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > MOST_BODY_BYTES:
                refused("a body that is longer than it said", who)
                return {"type": "http.disconnect"}
            return message

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = {name.lower() for name, _ in message.get("headers", [])}
                added = [pair for pair in _HEADERS.items() if pair[0] not in own]
                message = {**message, "headers": [*message.get("headers", []), *added]}
            await send(message)

        await self._app(scope, limited, with_headers)


class Bucket:
    """Lets through `rate` events a second on average, `burst` at once."""

    def __init__(self, rate: float, burst: float):
        """A full bucket."""
        self._rate, self._burst = rate, burst
        self._left, self._then = burst, time.monotonic()

    def take(self) -> bool:
        """Whether one more event may pass."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + (now - self._then) * self._rate)
        self._then = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Attempts:
    """Counts failures: after `most` in `seconds` there is a pause for everybody."""

    def __init__(self, most: int = 5, seconds: float = 60.0):
        """No failures yet."""
        self._failures: deque[float] = deque(maxlen=most)
        self._most, self._seconds = most, seconds

    @property
    def too_many(self) -> bool:
        """Whether there were too many failures lately."""
        return (
            len(self._failures) == self._most
            and time.monotonic() - self._failures[0] < self._seconds
        )

    def failed(self) -> None:
        """Counts a failure."""
        self._failures.append(time.monotonic())


def same_origin(headers: Headers) -> bool:
    """Whether a browser says that a page of this server asks; other programs say nothing."""
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc == headers.get("host", "")


def client_of(scope: Scope) -> str:
    """The address that a connection comes from."""
    client = scope.get("client")
    return client[0] if client else "unknown"
