"""Errors that a user can act on are one line on the terminal; bugs keep their tracebacks."""

import contextlib
import difflib
import errno
import functools
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn

from haland_jax.checkpoint import CheckpointError

_USER_ERROR_EXIT, _INTERRUPTED_EXIT = 2, 130
# Of the operating system's errors, those that say something about the user's machine or path.
_USER_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)


class UserError(Exception):
    """Something that the user can put right; the message says what, in one line."""


def choose(kind: str, value: str, options: Iterable[str]) -> str:
    """The value, if it is one of the options.

    Raises:
        UserError: it is not; the message lists the options and the nearest one.
    """
    names = list(options)
    if value in names:
        return value
    near = difflib.get_close_matches(value.lower(), names, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    raise UserError(f"unknown {kind} '{value}'; expected one of {', '.join(names)}{hint}")


@contextlib.contextmanager
def as_user_error(*types: type[Exception]) -> Iterator[None]:
    """Turns the given errors (ValueError by default) of a block into UserErrors.

    For the code that checks what the user typed, and for no other: a ValueError from elsewhere
    is a bug, whose traceback is wanted.
    """
    types = types or (ValueError,)
    try:
        yield
    except types as error:
        raise UserError(str(error)) from error


def main_guard(main: Callable[..., Any]) -> Callable[..., NoReturn]:
    """Makes `main` a command: it always ends in SystemExit, or in the traceback of a bug.

    Exit status 2 after a UserError, a CheckpointError or a full or forbidden disk, with one line
    on standard error; 130 when interrupted; else what `main` returns (None and 0 are success).
    """

    @functools.wraps(main)
    def command(*arguments: Any, **options: Any) -> NoReturn:
        try:
            status = main(*arguments, **options)
        except (UserError, CheckpointError) as error:
            status = _report(str(error))
        except OSError as error:
            if error.errno not in _USER_ERRNOS:
                raise
            place = f": {error.filename}" if error.filename else ""
            status = _report(f"{error.strerror}{place}")
        except KeyboardInterrupt:
            print("\ninterrupted; run the same command again to continue", file=sys.stderr)
            status = _INTERRUPTED_EXIT
        raise SystemExit(status)

    return command


def _report(message: str) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return _USER_ERROR_EXIT
