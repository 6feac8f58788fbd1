"""What players are asked to be, in words."""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

FILE = Path(__file__).parent / "tasks.toml"


class Tasks(NamedTuple):
    """An environment for a player: what it is about, and what each style asks for."""

    about: str
    styles: dict[str, str]


def tasks_of(environment: str, style_names: tuple[str, ...]) -> Tasks:
    """The words of an environment.

    Raises:
        ValueError: it has none, or not those of all styles.
    """
    found: dict[str, Any] = tomllib.loads(FILE.read_text(encoding="utf-8"))
    if environment not in found:
        raise ValueError(
            f"{FILE.name} has no words for {environment}; expected one of {', '.join(found)}"
        )
    words = dict(found[environment])
    about = words.pop("about")
    if set(words) != set(style_names):
        raise ValueError(
            f"{FILE.name} describes the styles {', '.join(words)} of {environment}, which has "
            f"{', '.join(style_names)}"
        )
    return Tasks(about, {style: words[style] for style in style_names})
