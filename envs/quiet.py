"""Imports without words that help nobody."""

import contextlib
import io
from collections.abc import Iterator


@contextlib.contextmanager
def no_word_of_warp() -> Iterator[None]:
    """Keeps MJX from printing, on import, that its other backend (Warp) is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
