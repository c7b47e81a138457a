"""Warnings of libraries, which become warnings of this program: one printable line each, and each once."""

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

    def say(origin: str, message: object) -> None:
        sentence = printable_sentence(f"{origin}: {message}; {TRACEBACK}=1 shows where", LONGEST_MESSAGE)
        if sentence not in said and len(said) < MOST:
            said.add(sentence)
            warn(sentence)

    class LastHandler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            say(record.name.partition(".")[0], record.getMessage())

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        del lineno, file, line
        say(_library(filename) or category.__name__, message)

    before = warnings.showwarning, logging.lastResort
    warnings.showwarning, logging.lastResort = show, LastHandler(logging.WARNING)
    try:
        yield
    finally:
        warnings.showwarning, logging.lastResort = before


def _library(filename: str) -> str:
    """Return the package that a warning comes from; an empty text for this program and for Python itself."""
    parts = Path(filename).parts
    return parts[parts.index("site-packages") + 1] if "site-packages" in parts[:-1] else ""
