"""Players without people: they go through the pages and press buttons, to try the server out."""

import asyncio
import dataclasses
import json
import random
import time
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from experiments.study.controls import BUTTONS
from experiments.study.web import COOKIE


class NoRedirect(urllib.request.HTTPRedirectHandler):
    """Shows redirections instead of following them."""

    def redirect_request(self, *_: Any) -> None:
        """Follows nothing."""


@dataclasses.dataclass
class Player:
    """A player and what they saw.

    Attributes:
        address: of the server, http://host:port.
        token: what a browser would hold.
        frames: step, score and moment (`time.monotonic`) of each message of the round.
        over: whether the round came to its end.
        waited: seconds from the sentence to a game that is ready.
    """

    address: str
    token: str = ""
    frames: list[tuple[int, float, float]] = dataclasses.field(default_factory=list)
    over: bool = False
    waited: float = 0.0

    def post(self, path: str, **fields: str) -> int:
        """Sends a form; returns the status. What the server gives to hold is held."""
        request = urllib.request.Request(
            self.address + path,
            data=urllib.parse.urlencode(fields).encode(),
            headers={"Cookie": f"{COOKIE}={self.token}"} if self.token else {},
        )
        try:
            with urllib.request.build_opener(NoRedirect).open(request, timeout=60) as answer:
                status, headers = answer.status, answer.headers
        except urllib.error.HTTPError as error:
            status, headers = error.code, error.headers
        for cookie in headers.get_all("set-cookie") or []:
            name, _, value = cookie.partition(";")[0].partition("=")
            if name == COOKIE:
                self.token = value
        return status

    async def enrol(self) -> None:
        """Consents, reads the instructions, skips the demonstration."""
        for path, fields in (
            ("/consent", {"agree": "yes"}),
            ("/study/next", {}),
            ("/study/next", {}),
        ):
            await asyncio.to_thread(lambda p=path, f=fields: self.post(p, **f))

    async def begin(self, sentence: str) -> None:
        """Describes how to work; the round is ready after that."""
        start = time.monotonic()
        status = await asyncio.to_thread(lambda: self.post("/study/describe", sentence=sentence))
        self.waited = time.monotonic() - start
        if status != 303:
            raise RuntimeError(f"the server answered {status} to a sentence")

    def socket(self) -> connect:
        """A connection to the round."""
        address = self.address.replace("http", "ws", 1) + "/study/play"
        return connect(address, additional_headers={"Cookie": f"{COOKIE}={self.token}"})

    async def play(self, seconds: float, rng: random.Random, presses: float = 4.0) -> None:
        """Presses buttons at random until the round is over or the time is up.

        Args:
            seconds: how long at most.
            rng: of what is pressed.
            presses: a second, on average.
        """
        async with self.socket() as socket:
            pressing = asyncio.create_task(self._press(socket, rng, presses))
            try:
                async with asyncio.timeout(seconds):
                    async for text in socket:
                        said = json.loads(text)
                        self.frames.append((said["step"], said["score"], time.monotonic()))
                        if said["over"]:
                            self.over = True
                            return
            except (TimeoutError, ConnectionClosed):
                return
            finally:
                pressing.cancel()

    async def _press(self, socket: ClientConnection, rng: random.Random, presses: float) -> None:
        try:
            while True:
                await asyncio.sleep(rng.expovariate(presses))
                button = rng.choice(BUTTONS)
                for down in (True, False):
                    await socket.send(json.dumps({"button": button, "down": down}))
                    await asyncio.sleep(0.05)
        except ConnectionClosed:
            return
