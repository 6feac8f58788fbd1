"""Sentences in which a partner states its style: one TOML file an environment.

A file holds a table for each style with two lists, `train` (fits the translator) and `test`
(wordings never fitted), as in the paper's App. F.
"""

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple


class Instructions(NamedTuple):
    """The sentences of one style."""

    train: tuple[str, ...]
    test: tuple[str, ...]

    def training_sample(self, most: int = 40) -> tuple[str, ...]:
        """At most so many of `train`, evenly spread, so that every author has a share."""
        last, count = len(self.train) - 1, min(most, len(self.train))
        return tuple(self.train[round(i * last / max(count - 1, 1))] for i in range(count))


def load_instructions(
    environment_name: str, style_names: Sequence[str] | None = None
) -> dict[str, Instructions]:
    """The packaged sentences of an environment, by style.

    Args:
        environment_name: as given to `envs.make`, such as "overcooked/center_pots"; the part
            before the last slash may be left out.
        style_names: the environment's styles; the result then follows their order.

    Raises:
        ValueError: if there are no sentences for the environment, or the file is inconsistent
            (see `read_instructions`).
    """
    stem = environment_name.rsplit("/", maxsplit=1)[-1]
    known = sorted(
        entry.name.removesuffix(".toml")
        for entry in resources.files(__name__).iterdir()
        if entry.name.endswith(".toml")
    )
    if stem not in known:
        raise ValueError(
            f"no instructions for environment {environment_name!r}; there are some for "
            f"{', '.join(known)}"
        )
    return read_instructions(resources.files(__name__) / f"{stem}.toml", style_names)


def read_instructions(
    path: Path | Traversable, style_names: Sequence[str] | None = None
) -> dict[str, Instructions]:
    """The sentences of a TOML file, by style.

    Args:
        path: a file with a table `[style]` holding `train` and `test`, lists of sentences.
        style_names: if given, exactly these styles must be there; the result follows their order.

    Raises:
        ValueError: if the file is no valid TOML, a style is missing or extra, a list is missing or
            empty, a sentence is blank, or one occurs twice (also across styles, or in both lists).
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name}: no valid TOML: {error}") from error
    expected = tuple(tables) if style_names is None else tuple(style_names)
    missing = [style for style in expected if style not in tables]
    extra = [style for style in tables if style not in expected]
    if missing or extra or not expected:
        raise ValueError(
            f"{path.name}: styles must be {', '.join(expected) or 'at least one'}; "
            f"missing: {', '.join(missing) or 'none'}; extra: {', '.join(extra) or 'none'}"
        )
    instructions = {
        style: _checked_style(f"{path.name} [{style}]", tables[style]) for style in expected
    }
    _check_distinct(path.name, instructions)
    return instructions


def training_sentences(instructions: Mapping[str, Instructions]) -> tuple[list[str], list[int]]:
    """All sentences of `train`, style by style, and the number of each one's style."""
    told = [
        (sentence, style)
        for style, sentences in enumerate(instructions.values())
        for sentence in sentences.train
    ]
    wordings, styles = zip(*told, strict=True)
    return list(wordings), list(styles)


def _checked_style(place: str, table: Any) -> Instructions:
    if not isinstance(table, dict) or set(table) != {"train", "test"}:
        found = ", ".join(table) if isinstance(table, dict) else repr(table)
        raise ValueError(f"{place}: expected the two lists train and test, found {found}")
    for part, sentences in table.items():
        if not isinstance(sentences, list) or not sentences:
            raise ValueError(f"{place}: {part} must be a list of at least one sentence")
        for sentence in sentences:
            if not isinstance(sentence, str) or not sentence.strip():
                raise ValueError(f"{place}: {part} holds {sentence!r}, expected a sentence")
    return Instructions(train=tuple(table["train"]), test=tuple(table["test"]))


def _check_distinct(file_name: str, instructions: Mapping[str, Instructions]) -> None:
    """A sentence may occur once in a file, whatever its case and spacing."""
    places: dict[str, str] = {}
    for style, parts in instructions.items():
        for part, sentences in parts._asdict().items():
            for sentence in sentences:
                plain = " ".join(sentence.lower().split())
                place = f"[{style}] {part}"
                if plain in places:
                    raise ValueError(
                        f"{file_name}: {sentence!r} occurs twice, in {places[plain]} and {place}"
                    )
                places[plain] = place
