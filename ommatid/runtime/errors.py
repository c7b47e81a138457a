"""Exceptions for failures that are not errors of the program, and values shortened for their messages."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

from .printable import printable, printable_sentence

LONGEST_VALUE = 80  # characters of a text within a message
MOST_NAMED = 10  # names in a message


class InputError(ValueError):
    """Error in a scene, option or file that the user can correct; exit code 2 of the command line."""

    def __str__(self) -> str:
        """Return the message as it may be printed, whatever names and values it quotes."""
        return printable_sentence(super().__str__())


class MachineError(OSError):
    """Failure of the machine, such as a full disk or a lost worker; exit code 1 of the command line."""

    def __str__(self) -> str:
        """Return the message as it may be printed, whatever names it quotes."""
        return printable_sentence(super().__str__())


class NotStartedError(MachineError):
    """Failure of one of many scenes for a reason that was reported with the first; exit code 1, and no message."""


class _ShortRepr(reprlib.Repr):
    """The repr of values, shortened; of numbers that Python does not print, the count of their bits."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = LONGEST_VALUE
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        """Return the repr of a number, which Python refuses for one of more than 4300 digits."""
        if x.bit_length() > 8 * LONGEST_VALUE:
            return f"a number of {x.bit_length()} bits"
        return super().repr_int(x, level)


_SHORT = _ShortRepr()


def shortened_repr(value: object) -> str:
    """Return the repr of a value, shortened to fit into a message."""
    return printable(_SHORT.repr(value))


def shortened(text: str) -> str:
    """Return a text, shortened to fit into a message."""
    return printable(text, LONGEST_VALUE)


def named(names: Iterable[object], quote: str = "") -> str:
    """Return the first names of a list, shortened, and the count of the others; "none" for an empty list."""
    known = [f"{quote}{shortened(str(name))}{quote}" for name in names]
    more = [f"{len(known) - MOST_NAMED} more"] if len(known) > MOST_NAMED else []
    return ", ".join([*known[:MOST_NAMED], *more]) or "none"


@contextmanager
def naming_source(source: Path, changes: Mapping[str, str] = MappingProxyType({})) -> Generator[None]:
    """Prefix the scene file to an InputError raised inside, unless its message names the file already.

    changes : of the file's keys, in words; those whose keys the message names are named beside the file
    """
    try:
        yield
    except InputError as error:
        whole = ValueError.__str__(error)  # as it was raised, before it is made printable
        message = whole.removeprefix(f"{source}: ")
        wrong = [words for key, words in changes.items() if _names_key(message, key)]
        if str(source) in message or (message != whole and not wrong):
            raise
        cause = error.__cause__ or error
        raise InputError(f"{source}{' with ' if wrong else ''}{', '.join(wrong)}: {message}") from cause


def _names_key(message: str, key: str) -> bool:
    """Return True if a message is about a key, in which `*` is the name of any lens type, or about one inside it."""
    pattern = re.escape(key).replace(r"\*", r"[^.\s]+")
    return re.search(rf"(?<![\w.]){pattern}(?!\w)", message) is not None
