"""Hostile input is refused and logged, and other players notice nothing."""

import asyncio
import http.client
import json
import random
import time
import urllib.parse

import pytest
from study_server import MODEL, SECRET, free_port, log_of, serving
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from experiments.study.crowd import Player
from experiments.study.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
SENTENCE = "Let us take the smallest food."


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A server; gives its folder and its port."""
    folder, port = tmp_path_factory.mktemp("study"), free_port()
    with serving(folder, port, "--hertz", "10", "--blocks", "10", model=MODEL):
        yield folder, port


def request(port, method, path, body="", **headers):
    """One request as written, without what libraries make tidy; status, headers, text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest(method, path, skip_accept_encoding=True)
    data = body.encode()
    headers = {"content-length": str(len(data)), **headers}
    if method == "POST":
        headers.setdefault("content-type", "application/x-www-form-urlencoded")
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders(data)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read().decode(errors="replace")
    connection.close()
    return found


def form(**fields):
    return urllib.parse.urlencode(fields)


async def ready(port):
    player = Player(f"http://127.0.0.1:{port}")
    await player.enrol()
    await player.begin(SENTENCE)
    return player


def beside_another(study, attack):
    """Runs an attack while somebody plays, who gets every step in time."""
    _, port = study

    async def both():
        bystander = await ready(port)
        playing = asyncio.create_task(bystander.play(4.0, random.Random(0)))
        await asyncio.sleep(0.5)
        found = await attack(port)
        await playing
        return bystander, found

    bystander, found = asyncio.run(both())
    steps = [step for step, _, _ in bystander.frames]
    assert steps == sorted(steps)
    assert bystander.over or steps[-1] >= 25
    gaps = [
        b - a for (_, _, a), (_, _, b) in zip(bystander.frames, bystander.frames[1:], strict=False)
    ]
    assert max(gaps) < 1.5
    return found


async def closed_with(socket):
    """Reads until the server closes; its code."""
    try:
        async with asyncio.timeout(10):
            async for _ in socket:
                pass
        return socket.close_code
    except ConnectionClosed as error:
        return error.rcvd.code if error.rcvd else socket.close_code


@pytest.mark.parametrize(
    "frame",
    ["", "{", "[]", "null", '{"button": "fire", "down": true}', '{"button": "up", "down": 1}',
     '{"button": ["up"], "down": true}', '{"echo": true}', '{"echo": "1"}', "[" * 400,
     '{"button": "up", "down": true, "more": 1}', '{"away": 1}', b"\xff\x00\xfe", "9" * 400],
)  # fmt: skip
def test_messages_that_make_no_sense_end_the_connection(study, frame):
    async def attack(port):
        player = await ready(port)
        async with player.socket() as socket:
            for _ in range(6):
                try:
                    await socket.send(frame)
                except ConnectionClosed:
                    break
            return await closed_with(socket)

    _, port = study
    assert asyncio.run(attack(port)) == 1008
    assert "refused: a message" in log_of(study[0])


def test_a_frame_that_is_too_large_ends_the_connection(study):
    async def attack(port):
        player = await ready(port)
        async with player.socket() as socket:
            await socket.send("x" * 1_000_000)
            return await closed_with(socket)

    assert beside_another(study, attack) == 1009


def test_thousands_of_messages_a_second_end_the_connection(study):
    async def attack(port):
        player = await ready(port)
        async with player.socket() as socket:
            try:
                for _ in range(5000):
                    await socket.send('{"button":"up","down":true}')
            except ConnectionClosed:
                pass
            return await closed_with(socket)

    assert beside_another(study, attack) == 1008
    assert "too many messages a second" in log_of(study[0])


def test_a_session_of_somebody_else_is_of_no_use(study):
    _, port = study

    async def attack(port):
        player = await ready(port)
        found = []
        for cookie in ("", "participant=", "participant=' OR 1=1 --", "participant=" + "A" * 43):
            address = f"ws://127.0.0.1:{port}/study/play"
            headers = {"Cookie": cookie} if cookie else {}
            async with connect(address, additional_headers=headers) as socket:
                found.append(await closed_with(socket))
        # Somebody else's game among the free ones is not found by its number either.
        for key in ("round 1", "round%201", "1", "../study/play"):
            address = f"ws://127.0.0.1:{port}/free/{urllib.parse.quote(key)}/play"
            try:
                async with connect(address) as socket:
                    found.append(await closed_with(socket))
            except InvalidStatus as error:
                found.append(error.response.status_code)
        await player.play(0.5, random.Random(0))
        return found, player

    found, player = asyncio.run(attack(port))
    assert set(found) <= {4004, 403, 404}
    assert found[:4] == [4004] * 4
    assert player.frames, "the owner still plays"
    other = Player(f"http://127.0.0.1:{port}")
    asyncio.run(other.enrol())
    cookie = f"participant={other.token}"
    assert request(port, "GET", "/study/replay/0", cookie=cookie)[0] == 404
    assert request(port, "GET", "/study/replay/0")[0] == 401
    assert request(port, "GET", "/study/replay/-1", cookie=cookie)[0] == 404
    assert request(port, "GET", "/study/replay/9e99", cookie=cookie)[0] == 422


def test_other_sites_may_not_ask(study):
    _, port = study
    body = form(agree="yes")
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert request(port, "POST", "/consent", body, origin=origin)[0] == 403

        async def attack(port, origin=origin):
            with pytest.raises(InvalidStatus):
                await connect(f"ws://127.0.0.1:{port}/study/play", origin=origin)

        asyncio.run(attack(port))
    own = {"origin": f"http://127.0.0.1:{port}", "host": f"127.0.0.1:{port}"}
    assert request(port, "POST", "/consent", body, **own)[0] == 303
    assert "refused: origin 'http://evil.example'" in log_of(study[0])


def test_cookies_cannot_be_read_by_scripts_nor_sent_from_elsewhere(study):
    _, port = study
    _, headers, _ = request(port, "POST", "/consent", form(agree="yes"))
    cookie = headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    _, headers, _ = request(port, "GET", "/")
    assert headers["content-security-policy"].startswith("default-src 'self'")
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "path",
    ["/static/../study.py", "/static/%2e%2e/study.py", "/static/..%2fstudy.py",
     "/static//etc/passwd", "/static/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
     "/static/..\\study.py", "/admin/replay/../rounds.jsonl",
     "/admin/replay/..%2f..%2fx.gif", "/pages/admin.html",
     "/static/\x7f", "/static/%00"],
)  # fmt: skip
def test_paths_lead_nowhere_else(study, path):
    _, port = study
    try:
        status, _, text = request(port, "GET", path)
    except http.client.InvalidURL:
        return
    assert status in (400, 403, 404, 422)
    assert "root:" not in text
    assert "import" not in text


def test_forms_that_are_too_long_or_wrong_are_refused(study):
    folder, port = study
    player = asyncio.run(ready(port))
    cookie = f"participant={player.token}"
    assert (
        request(port, "POST", "/study/rate", form(comment="x" * 100_000), cookie=cookie)[0] == 413
    )
    assert request(port, "POST", "/consent", "x", content_length="zero")[0] in (400, 413)
    for rating in ("0", "6", "five", "1 OR 1=1", ""):
        body = form(rating=rating, comment="fine")
        assert request(port, "POST", "/study/rate", body, cookie=cookie)[0] == 422
    fresh = Player(f"http://127.0.0.1:{port}")
    asyncio.run(fresh.enrol())
    cookie = f"participant={fresh.token}"
    for sentence, said in (
        ("", "blank"), ("   ", "blank"), ("x" * 301, "at most 300"), ("word " * 59, "32"),
    ):  # fmt: skip
        status, _, text = request(
            port, "POST", "/study/describe", form(sentence=sentence), cookie=cookie
        )
        assert status == 422, sentence
        assert said in text
    assert request(port, "POST", "/free", form(environment="x", style="y", sentence="z"))[0] == 422
    assert "refused: a body of '100" in log_of(folder)


def test_scripts_and_sql_are_words_like_others(study):
    folder, port = study
    evil = "<script>alert('x')</script>'); DROP TABLE rounds;-- {{ 7*7 }}"

    async def play(port):
        player = Player(f"http://127.0.0.1:{port}")
        await player.enrol()
        await player.begin(evil)
        await player.play(20, random.Random(3), presses=0.1)
        return player

    player = asyncio.run(play(port))
    assert player.over
    time.sleep(2)  # the round's end is stored within a second
    assert player.post("/study/rate", rating="1", comment=evil) == 303
    store = Store(f"sqlite:///{folder / 'study.db'}")
    (one,) = (one for one in store.rounds() if one.sentence == evil)
    assert one.comment == evil
    store.close()
    _, headers, _ = request(port, "POST", "/admin", form(secret=SECRET))
    pass_ = headers["set-cookie"].split(";")[0]
    _, _, text = request(port, "GET", "/admin", cookie=pass_)
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert" in text
    assert "{{ 7*7 }}" in text
    status, _, text = request(port, "GET", "/admin/rounds.jsonl", cookie=pass_)
    assert status == 200
    rows = [json.loads(line) for line in text.splitlines()]
    (row,) = (row for row in rows if row["sentence"] == evil)
    assert len(row["recorded"]["person"]) == row["steps"] == 50
    assert request(port, "GET", f"/admin/replay/{row['round']}.gif", cookie=pass_)[0] == 200


def test_administration_needs_the_secret(study):
    folder, port = study
    pages = ("rounds.jsonl", "rounds.parquet", "steps.parquet", "replay/1.gif")
    for cookie in ("", "administration=", "administration=0", f"administration={SECRET}"):
        for page in pages:
            assert request(port, "GET", f"/admin/{page}", cookie=cookie)[0] == 403
        _, _, text = request(port, "GET", "/admin", cookie=cookie)
        assert "participants" not in text
        assert 'type="password"' in text
    statuses = [request(port, "POST", "/admin", form(secret=f"guess {i}"))[0] for i in range(8)]
    assert statuses == [403] * 5 + [429] * 3
    assert request(port, "POST", "/admin", form(secret=SECRET))[0] == 429, "nobody may guess on"
    assert "refused: a wrong administration secret" in log_of(folder)
    assert SECRET not in log_of(folder).split("agents:")[1].split("secret:")[1][40:]
