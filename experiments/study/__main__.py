"""Lets people play with agents made from their own sentences, in a browser.

    python -m experiments.study
    python -m experiments.study --run runs/overcooked-crossway-overnight-0 --blocks 2
    python -m experiments.study --database postgresql://user:password@host/study --host 0.0.0.0

Participants read, consent, watch a demonstration, and play a round with each kind of agent, in an
order that is balanced and hidden from them; before each they say in their own words how they will
work. Anybody may also just play, which records nothing. The researcher's page is /admin, behind a
secret. Every step is stored within a second; an interrupted server goes on with its rounds when it
is started again.
"""

import dataclasses
import os
import secrets
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments import devices
from experiments.errors import UserError, as_user_error, main_guard
from experiments.models import PREFIX, open_model
from haland_jax import pretrained

DEFAULT = f"{PREFIX}overcooked/diverse_orders"
SECRET_VARIABLE = "HALAND_STUDY_SECRET"
_FRAME_BYTES = 1024


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Let people play with agents made from their own sentences, in a browser."""

    run: Annotated[str, tyro.conf.arg(metavar="FOLDER|pretrained:ENV")] = DEFAULT
    """The study's model: folder of a finished run, or one that comes with the package."""
    agents: tuple[str, ...] = ()
    """Kinds of agents that every participant meets: haland, oracle, universal; by default all
    that the model has."""
    blocks: int = 1
    """How often every participant meets each of them."""
    free: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="MODEL")] = None
    """Further models for those who just play; by default all that come with the package. They are
    prepared while the server runs already."""
    hertz: float = 6.0
    """Steps a second."""
    players: int = 64
    """How many can play at once in each game."""
    out: Path = Path("study")
    """Folder of the database, if no other is named."""
    database: str | None = None
    """URL of the database, such as postgresql://user:password@host/name (`uv sync --extra postgres`
    first); a SQLite file in the folder by default."""
    host: str = "127.0.0.1"
    """Address to serve on; 0.0.0.0 lets other machines in. Put a proxy with TLS before it then."""
    port: int = 8000
    """Port to serve on."""
    seed: int = 0
    """Of the orders in which participants meet agents."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.study")
    console = Console(highlight=False)
    devices.prepare(cores=1)
    # What compiles and serves takes seconds to import.
    import uvicorn
    from sqlalchemy.exc import SQLAlchemyError

    from experiments.study.agents import Agents
    from experiments.study.store import Store
    from experiments.study.study import Settings, Study
    from experiments.study.web import make_app

    secret = os.environ.get(SECRET_VARIABLE) or secrets.token_urlsafe(12)
    model = open_model(arguments.run)
    with as_user_error():
        settings = Settings(
            conditions=arguments.agents or Agents(model).conditions,
            blocks=arguments.blocks,
            hertz=arguments.hertz,
            players=arguments.players,
            seed=arguments.seed,
        )
    url = arguments.database
    if url is None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        url = f"sqlite:///{arguments.out / 'study.db'}"
    try:
        store = Store(url)
    except (SQLAlchemyError, ModuleNotFoundError) as error:
        raise UserError(f"the database cannot be opened: {str(error).splitlines()[0]}") from None
    with as_user_error():
        study = Study(settings, store)
        study.add(arguments.run, model)
        app = make_app(study, secret)
    more = arguments.free
    if more is None:
        more = tuple(f"{PREFIX}{name}" for name in pretrained.names())
    threading.Thread(target=_add_more, args=(study, more, console), daemon=True).start()

    address = f"http://{arguments.host}:{arguments.port}"
    console.print(f"study      {address}/   agents: {', '.join(settings.conditions)}")
    console.print(f"just play  {address}/free")
    console.print(f"researcher {address}/admin   secret: {secret}", soft_wrap=True)
    console.print(f"database   {store.shown_url}", soft_wrap=True)
    uvicorn.run(
        app,
        host=arguments.host,
        port=arguments.port,
        ws_max_size=_FRAME_BYTES,
        log_level="warning",
        timeout_graceful_shutdown=3,
    )


def _add_more(study: object, names: Sequence[str], console: Console) -> None:
    """Prepares further games while the study runs."""
    from experiments.study.study import Study

    assert isinstance(study, Study)
    for name in names:
        environment = name.removeprefix(PREFIX)
        if environment in study.kitchens or environment.startswith("assistive/"):
            continue  # an arm has no keys
        try:
            study.add(name, open_model(name))
        except (UserError, ValueError) as error:
            console.print(f"[yellow]{name} cannot be played: {error}[/]")


if __name__ == "__main__":
    main()
