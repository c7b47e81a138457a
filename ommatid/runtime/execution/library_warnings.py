"""Warnings of libraries and of this program's own log: one printable line each, and each once."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from ..printable import LONGEST_MESSAGE, printable_sentence

TRACEBACK = "OMMATID_TRACEBACK"  # in the environment: failures and warnings are printed as Python prints them
OWN_LOG = "ommatid"  # whose messages are whole sentences
MOST = 20  # warnings of one process


def warn_on_stderr(sentence: str) -> None:
    """Print a warning on stderr, unless its reader has gone."""
    with suppress(OSError, ValueError):
        print(f"warning: {sentence}", file=sys.stderr)


@contextmanager
def library_warnings(warn: Callable[[str], None]) -> Generator[None]:
    """Pass warnings and log messages of libraries to `warn`, each once and at most MOST of them.

    Nothing changes where OMMATID_TRACEBACK is set, or for warnings that are errors. A handler of its own that a library
    gives its log stays.
    """
    if os.environ.get(TRACEBACK):
        yield
        return
    said: set[str] = set()

    def say(text: str) -> None:
        sentence = printable_sentence(text, LONGEST_MESSAGE)
        if sentence not in said and len(said) < MOST:
            said.add(sentence)
            warn(sentence)

    class LastHandler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            origin, message = record.name.partition(".")[0], record.getMessage()
            say(message if origin == OWN_LOG else f"{origin}: {message}; {TRACEBACK}=1 shows where")

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        del lineno, file, line
        origin = _library(filename) or ("numpy" if issubclass(category, RuntimeWarning) else "ommatid")
        say(f"{origin}: {message}; {TRACEBACK}=1 shows where")

    before = warnings.showwarning, logging.lastResort
    warnings.showwarning, logging.lastResort = show, LastHandler(logging.WARNING)
    try:
        yield
    finally:
        warnings.showwarning, logging.lastResort = before


def _library(filename: str) -> str:
    """Return the package that a warning names; an empty text for this program, in which NumPy's overflows occur."""
    parts = Path(filename).parts
    return parts[parts.index("site-packages") + 1] if "site-packages" in parts[:-1] else ""
