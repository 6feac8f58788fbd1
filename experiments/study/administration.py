"""The researcher's page, behind a secret: progress, live rounds, timing, downloads."""

import hmac
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import FastAPI, Form, HTTPException, Request
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from starlette.templating import Jinja2Templates

from experiments.study import export
from experiments.study.guard import Attempts, client_of, refused
from experiments.study.study import Study, key_of

COOKIE = "administration"
LEAST_SECRET = 12
"""Characters."""


def add(app: FastAPI, study: Study, secret: str, pages: Jinja2Templates) -> None:
    """Adds the pages to the application.

    Raises:
        ValueError: the secret is too short.
    """
    if len(secret) < LEAST_SECRET:
        raise ValueError(
            f"the administration's secret has {len(secret)} characters; expected at least "
            f"{LEAST_SECRET}"
        )
    # What the browser holds is made from the secret, and worth nothing after a change of it.
    pass_ = hmac.new(secret.encode(), b"administration", sha256).hexdigest()
    attempts = Attempts()

    def let_in(request: Request) -> bool:
        held = request.cookies.get(COOKIE, "")
        return hmac.compare_digest(held.encode(), pass_.encode())

    def required(request: Request) -> None:
        if not let_in(request):
            refused("administration without the secret", client_of(dict(request.scope)))
            raise HTTPException(403, "Only the researcher sees this.")

    @app.get("/admin")
    def overview(request: Request) -> Response:
        if not let_in(request):
            return pages.TemplateResponse(request, "admin_login.html", {})
        return pages.TemplateResponse(request, "admin.html", _overview(study))

    @app.post("/admin")
    def log_in(request: Request, given: Annotated[str, Form(alias="secret")] = "") -> Response:
        who = client_of(dict(request.scope))
        if attempts.too_many:
            refused("administration after too many wrong secrets", who)
            raise HTTPException(429, "Too many wrong secrets; wait a minute.")
        if not hmac.compare_digest(given.encode(), secret.encode()):
            attempts.failed()
            refused("a wrong administration secret", who)
            raise HTTPException(403, "This is not the secret.")
        response = RedirectResponse("/admin", 303)
        response.set_cookie(
            COOKIE, pass_, httponly=True, samesite="strict", secure=request.url.scheme == "https"
        )
        return response

    @app.get("/admin/rounds.jsonl")
    def rounds_jsonl(request: Request) -> Response:
        required(request)
        return StreamingResponse(
            export.rounds_jsonl(study.store), media_type="application/jsonl",
            headers=_attached("rounds.jsonl"),
        )  # fmt: skip

    @app.get("/admin/rounds.parquet")
    def rounds_parquet(request: Request) -> Response:
        required(request)
        return _file(export.rounds_parquet(study.store), "rounds.parquet")

    @app.get("/admin/steps.parquet")
    def steps_parquet(request: Request) -> Response:
        required(request)
        return _file(export.steps_parquet(study.store), "steps.parquet")

    @app.get("/admin/replay/{number}.gif")
    def replay(request: Request, number: int) -> Response:
        required(request)
        found = {one.id: one for one in study.store.rounds()}
        if number not in found or found[number].environment not in study.kitchens:
            raise HTTPException(404, "There is no such round.")
        one = found[number]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "replay.gif")
            try:
                export.save_replay(path, study.store, study.kitchens[one.environment], one)
            except ValueError as error:
                raise HTTPException(404, str(error)) from None
            return Response(path.read_bytes(), media_type="image/gif")


def _overview(study: Study) -> dict[str, Any]:
    late = np.array(study.hall.late or [0.0])
    hall = study.hall
    rounds = [
        {
            **export.described(one),
            "live": hall.rounds.get(key_of(one.id)),
            "present": (live := hall.rounds.get(key_of(one.id))) is not None
            and live.listener is not None,
        }
        for one in reversed(study.store.rounds())
    ]
    return {
        "progress": study.store.progress(),
        "rounds": rounds,
        "free": sum(live.number is None for live in hall.rounds.values()),
        "late": {share: float(np.percentile(late, share)) for share in (50, 99)},
        "hertz": hall.hertz,
    }


def _file(content: bytes, name: str) -> Response:
    return Response(content, media_type="application/octet-stream", headers=_attached(name))


def _attached(name: str) -> dict[str, str]:
    return {"content-disposition": f'attachment; filename="{name}"'}
