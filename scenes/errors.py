"""The two ways in which a command can fail that are not the program's fault."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A scene, option or file that the user can mend; the command line answers with exit code 2."""


class DeniedError(OSError):
    """What the machine refuses, such as space on the disk; the command line answers with exit code 1."""


@contextmanager
def naming(source: Path) -> Generator[None]:
    """Let what is wrong with a scene name its file, where whoever noticed did not know that."""
    try:
        yield
    except InputError as error:
        if str(source) in str(error):
            raise
        raise InputError(f"{source}: {error}") from error
