"""The study's pages (App. H): consent, instructions, a demonstration, rounds, ratings, thanks."""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import FastAPI, Form, HTTPException, Request, WebSocket
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from sqlalchemy.exc import IntegrityError
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.staticfiles import StaticFiles
from starlette.templating import Jinja2Templates

from experiments.study import administration, play, store, tables
from experiments.study.agents import HALAND, MOST_CHARACTERS, new_seed
from experiments.study.controls import controls_of
from experiments.study.guard import Bucket, Guard, client_of, refused
from experiments.study.live import Full
from experiments.study.study import Kitchen, Study, key_of

HERE = Path(__file__).parent
COOKIE = "participant"
RATINGS = ("very dissatisfied", "dissatisfied", "neither", "satisfied", "very satisfied")
ENROLMENTS_A_MINUTE = 120
MOST_COMMENT = 2000
LANGUAGE_BARS = 10
_log = logging.getLogger(__name__)
_pages = Jinja2Templates(HERE / "pages")


def make_app(study: Study, secret: str) -> FastAPI:
    """The web application of a study.

    Args:
        study: compiled already.
        secret: what opens the administration.
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        del app
        found = await study.resume()
        if any(found.values()):
            _log.warning("interrupted rounds: %(resumed)d go on, %(broken)d are broken", found)
        clock = asyncio.create_task(study.hall.run())
        yield
        clock.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await clock
        await study.hall.close()

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    app.mount("/static", StaticFiles(directory=HERE / "static"), "static")
    _add_participation(app, study)
    _add_free_play(app, study)
    administration.add(app, study, secret, _pages)

    @app.exception_handler(StarletteHTTPException)
    async def say(request: Request, error: StarletteHTTPException) -> Response:
        return _page(request, "message", status=error.status_code, message=str(error.detail))

    app.add_middleware(Guard)
    return app


def _page(request: Request, name: str, status: int = 200, **shown: Any) -> HTMLResponse:
    return _pages.TemplateResponse(request, f"{name}.html", shown, status)


def _to(path: str) -> RedirectResponse:
    return RedirectResponse(path, 303)


# --- Participation -------------------------------------------------------------------------------


def _add_participation(app: FastAPI, study: Study) -> None:
    kitchen, enrolments = study.kitchen, Bucket(ENROLMENTS_A_MINUTE / 60, ENROLMENTS_A_MINUTE)

    def who(request: Request | WebSocket) -> tables.Participant | None:
        token = request.cookies.get(COOKIE)
        return study.store.participant(token) if token else None

    def required(request: Request) -> tables.Participant:
        if (found := who(request)) is None:
            raise HTTPException(401, "Please begin at the first page; your browser holds no code.")
        return found

    @app.get("/")
    def front(request: Request) -> Response:
        return _page(request, "front", again=who(request) is not None)

    @app.get("/consent")
    def consent(request: Request) -> Response:
        if who(request) is not None:
            return _to("/study")
        rounds = len(study.settings.conditions) * study.settings.blocks
        return _page(request, "consent", rounds=rounds)

    @app.post("/consent")
    def enrol(request: Request, agree: Annotated[str, Form()] = "") -> Response:
        if agree != "yes":
            return _to("/consent")
        if who(request) is not None:
            return _to("/study")
        if not enrolments.take():
            refused("too many new participants a minute", client_of(dict(request.scope)))
            raise HTTPException(429, "Too many people begin just now; try again in a minute.")
        _, token = study.enrol()
        response = _to("/study")
        response.set_cookie(
            COOKIE, token, max_age=30 * 86_400, httponly=True, samesite="strict",
            secure=request.url.scheme == "https",
        )  # fmt: skip
        return response

    @app.get("/study")
    def here(request: Request) -> Response:
        if (participant := who(request)) is None:
            return _to("/")
        if participant.stage == tables.INSTRUCTIONS:
            return _page(
                request, "instructions", tasks=kitchen.tasks, act=controls_of(kitchen.env.name).act,
                steps=kitchen.env.max_steps, hertz=study.settings.hertz,
            )  # fmt: skip
        if participant.stage == tables.DEMONSTRATION:
            return _page(request, "demonstration", **_board(kitchen))
        if participant.stage == tables.END:
            return _page(request, "end", participant=participant, **_board(kitchen))
        one = store.going_on(participant)
        if one is not None and not study.has(one):
            study.store.end_round(one.id, tables.BROKEN)
            return _to("/study")
        if one is not None:
            return _play_page(request, kitchen, "/study/play", one.style, one.sentence)
        if (one := store.unrated(participant)) is not None:
            return _page(request, "rate", round=one, ratings=RATINGS, most=MOST_COMMENT)
        if (following := store.next_round(participant)) is None:
            study.end(participant)
            return _to("/study")
        return _describe_page(request, study, following, "")

    @app.post("/study/next")
    def go_on(request: Request) -> Response:
        study.go_on(required(request))
        return _to("/study")

    @app.post("/study/describe")
    async def describe(request: Request, sentence: Annotated[str, Form()] = "") -> Response:
        participant = await asyncio.to_thread(required, request)
        following = store.next_round(participant)
        busy = store.going_on(participant) or store.unrated(participant)
        if participant.stage != tables.ROUNDS or following is None or busy is not None:
            return _to("/study")
        try:
            made, begun = await asyncio.to_thread(study.make, participant, sentence)
            await study.begin(participant, made, begun)
        except ValueError as error:
            return _describe_page(request, study, following, str(error), sentence)
        except Full:
            raise HTTPException(503, "All places are taken; try again in a minute.") from None
        except IntegrityError:
            pass  # The form was sent twice; the first one counts.
        return _to("/study")

    @app.websocket("/study/play")
    async def play_round(socket: WebSocket) -> None:
        participant = await asyncio.to_thread(who, socket)
        one = store.going_on(participant) if participant else None
        live = study.hall.rounds.get(key_of(one.id)) if one else None
        if live is None:
            await _refuse(socket)
        else:
            await play.connect(socket, study.hall, live)

    @app.post("/study/rate")
    def rate(
        request: Request,
        rating: Annotated[int, Form(ge=1, le=5)],
        comment: Annotated[str, Form(max_length=MOST_COMMENT)] = "",
    ) -> Response:
        one = store.unrated(required(request))
        if one is not None:
            study.store.rate(one.id, rating, comment.strip())
        return _to("/study")

    @app.get("/study/replay/{number}")
    def replay(request: Request, number: int) -> Response:
        rounds = {one.number: one for one in required(request).rounds}
        if number not in rounds or rounds[number].status == tables.PLAYING:
            raise HTTPException(404, "You have no such round.")
        return JSONResponse(study.replay(rounds[number]))

    @app.get("/demonstration")
    def demonstration() -> Response:
        return JSONResponse(study.demonstration)


def _describe_page(
    request: Request, study: Study, following: Any, problem: str, sentence: str = ""
) -> Response:
    number, planned = following
    kitchen = study.kitchen
    style = kitchen.env.style_names[planned.style]
    return _page(
        request, "describe", status=422 if problem else 200, number=number + 1,
        rounds=len(study.settings.conditions) * study.settings.blocks,
        task=kitchen.tasks.styles[style], problem=problem, sentence=sentence[:MOST_CHARACTERS],
        most=MOST_CHARACTERS,
    )  # fmt: skip


def _play_page(
    request: Request, kitchen: Kitchen, socket: str, style: str, sentence: str, **shown: Any
) -> Response:
    return _page(
        request, "play", socket=socket, sentence=sentence, task=kitchen.tasks.styles[style],
        steps=kitchen.env.max_steps, act=controls_of(kitchen.env.name).act, **_board(kitchen),
        **shown,
    )  # fmt: skip


def _board(kitchen: Kitchen) -> dict[str, Any]:
    return {"board": kitchen.tiles, "most_steps": kitchen.env.max_steps}


async def _refuse(socket: WebSocket) -> None:
    """Tells the page that there is no such round; it learns the reason only once accepted."""
    await socket.accept()
    await socket.close(play.GONE)


# --- Free play -----------------------------------------------------------------------------------


def _add_free_play(app: FastAPI, study: Study) -> None:
    games: dict[str, dict[str, Any]] = {}

    @app.get("/free")
    def choose(request: Request) -> Response:
        return _free_page(request, study)

    @app.post("/free")
    async def begin(
        request: Request,
        environment: Annotated[str, Form()] = "",
        style: Annotated[str, Form()] = "",
        sentence: Annotated[str, Form()] = "",
    ) -> Response:
        kitchen = study.kitchens.get(environment)
        if kitchen is None or style not in kitchen.env.style_names:
            return _free_page(request, study, "Choose a game and what you want to be in it.")
        number = kitchen.env.style_names.index(style)
        try:
            made = await asyncio.to_thread(kitchen.agents.make, HALAND, sentence, new_seed())
            key = await study.begin_free(environment, number, made)
        except ValueError as error:
            return _free_page(request, study, str(error), environment, style, sentence)
        except Full:
            raise HTTPException(503, "All places are taken; try again in a minute.") from None
        for gone in [old for old in games if old not in study.hall.rounds]:
            del games[gone]
        games[key] = {
            "kitchen": kitchen, "style": style, "sentence": sentence.strip(),
            "sounds_like": made.sounds_like, "language": _bars(kitchen, made.v_hat),
        }  # fmt: skip
        return _to(f"/free/{key}")

    @app.get("/free/{key}")
    def play_page(request: Request, key: str) -> Response:
        if key not in games or key not in study.hall.rounds:
            raise HTTPException(404, "This game is over; begin another one.")
        game = dict(games[key])
        kitchen, style, sentence = (game.pop(name) for name in ("kitchen", "style", "sentence"))
        return _play_page(request, kitchen, f"/free/{key}/play", style, sentence, **game)

    @app.websocket("/free/{key}/play")
    async def play_free(socket: WebSocket, key: str) -> None:
        live = study.hall.rounds.get(key)
        if live is None or live.number is not None:
            await _refuse(socket)
        else:
            await play.connect(socket, study.hall, live)


def _free_page(
    request: Request,
    study: Study,
    problem: str = "",
    environment: str = "",
    style: str = "",
    sentence: str = "",
) -> Response:
    games = {
        name: {"about": kitchen.tasks.about, "styles": kitchen.tasks.styles}
        for name, kitchen in study.kitchens.items()
    }
    return _page(
        request, "free", status=422 if problem else 200, games=games, problem=problem,
        environment=environment or study.kitchen.env.name, style=style,
        sentence=sentence[:MOST_CHARACTERS], most=MOST_CHARACTERS,
    )  # fmt: skip


def _bars(kitchen: Kitchen, v_hat: np.ndarray) -> list[tuple[str, float]]:
    """The strongest entries of a task language, with their names."""
    names = kitchen.model.event_names
    order = np.argsort(-np.abs(v_hat))[:LANGUAGE_BARS]
    return [(names[index].replace("_", " "), float(v_hat[index])) for index in order]
