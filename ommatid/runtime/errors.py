"""The two ways in which a command can fail that are not the program's fault."""

from __future__ import annotations

import reprlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A scene, option or file that the user can mend; the command line answers with exit code 2."""


class MachineError(OSError):
    """What the machine refuses, such as space on the disk; the command line answers with exit code 1."""


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80
_SHORT.maxlevel = 3


def shortened_repr(value: object) -> str:
    """What came, as Python writes it, shortened to what a sentence can hold."""
    return _SHORT.repr(value)


def shortened(text: str) -> str:
    """A text, shortened to what a sentence can hold."""
    return shortened_repr(text)[1:-1] if len(text) > _SHORT.maxstring else text


@contextmanager
def naming_source(source: Path) -> Generator[None]:
    """Let what is wrong with a scene name its file, where whoever noticed did not know that."""
    try:
        yield
    except InputError as error:
        if str(source) in str(error):
            raise
        raise InputError(f"{source}: {error}") from error
