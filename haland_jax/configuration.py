"""Configurations from JSON: frozen dataclasses, filled in with what was stored."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

Configuration = TypeVar("Configuration")


def filled(template: Configuration, stored: Mapping[str, Any]) -> Configuration:
    """A copy of a dataclass with the stored values; nested dataclasses likewise.

    Args:
        template: a dataclass instance, which says what fields there are and of what kind.
        stored: value of every field, as JSON gives it: lists where the dataclass has tuples.

    Raises:
        KeyError: a field is not stored.
        ValueError: a field is stored that the dataclass does not have, or the dataclass
            refuses a value.
    """
    fields = dataclasses.fields(template)  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(stored) - {field.name for field in fields})
    if unknown:
        raise ValueError(f"the setting '{unknown[0]}' is unknown")
    changes = {}
    for field in fields:
        value, kept = getattr(template, field.name), stored[field.name]
        if dataclasses.is_dataclass(value):
            changes[field.name] = filled(value, kept)
        elif isinstance(value, tuple):
            changes[field.name] = tuple(kept)
        else:
            changes[field.name] = kept
    return dataclasses.replace(template, **changes)  # pyright: ignore[reportArgumentType]
