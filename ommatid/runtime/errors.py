"""Exceptions for failures that are not errors of the program, and values shortened for their messages."""

from __future__ import annotations

import reprlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """Error in a scene, option or file that the user can correct; exit code 2 of the command line."""


class MachineError(OSError):
    """Failure of the machine, such as a full disk or a lost worker; exit code 1 of the command line."""


class NotStartedError(MachineError):
    """Failure of one of many scenes for a reason that was reported with the first; exit code 1, and no message."""


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80
_SHORT.maxlevel = 3


def shortened_repr(value: object) -> str:
    """Return the repr of a value, shortened to fit into a message."""
    return _SHORT.repr(value)


def shortened(text: str) -> str:
    """Return a text, shortened to fit into a message."""
    return shortened_repr(text)[1:-1] if len(text) > _SHORT.maxstring else text


@contextmanager
def naming_source(source: Path) -> Generator[None]:
    """Prefix the scene file to an InputError raised inside, unless its message names the file already."""
    try:
        yield
    except InputError as error:
        if str(source) in str(error):
            raise
        raise InputError(f"{source}: {error}") from error
