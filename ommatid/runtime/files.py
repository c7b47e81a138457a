"""Atomic writing of files, and caching of results by the fingerprint of what they were made from."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
import re
import secrets
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import InputError, MachineError
from .input_files import open_input
from .outputs.kinds import check_folder, check_output, input_error
from .printable import printable

Content = TypeVar("Content")
Made = TypeVar("Made")

LONGEST_FIELD = 1000  # characters of a text in a CSV file
_SIGNED = re.compile(r"[-+](?:[\d.]+(?:[eE][-+]?\d+)?\s*[^\W\d_]*|inf|nan)")  # a number, also with a unit
PART = ".part."  # in the name of a file that is still being written
LONGEST_NAME = 100  # bytes of a name that is part of a temporary one, which file systems limit to 255 or 143
UNREADABLE = OSError, ValueError, KeyError, TypeError, AttributeError  # of files missing, damaged or of another kind
written: set[Path] = set()  # absolute paths of the files that this process wrote


def write_whole(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file in the same folder, then rename it to `path`: readers never see half a file.

    Raises MachineError if the disk is full or refuses, InputError if the folder does not exist.
    """
    check_output(path)
    clear_abandoned(path.parent, path.name)
    try:
        with temporary_file(path) as temporary:
            write(temporary)
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())
            temporary.replace(path)
            written.add(path.absolute())
    except OSError as error:
        raise not_written(path, error) from error


def not_written(path: Path, error: OSError) -> MachineError:
    """Return what to say where the machine refused to write a file."""
    reason = error.strerror or str(error)
    return MachineError(f"{path}: could not be written ({reason}); free some space or choose another folder")


def short_name(name: str) -> str:
    """Return a name as part of the names of files beside it: of at most LONGEST_NAME bytes, with the same ending."""
    content = os.fsencode(name)
    return name if len(content) <= LONGEST_NAME else f"{hashlib.sha256(content).hexdigest()[:16]}{name[-20:]}"


@contextmanager
def temporary_file(path: Path) -> Generator[Path]:
    """Create an empty file beside `path`, locked and removed at the end, unless it was renamed.

    `clear_abandoned` removes those of killed processes.
    """
    while True:
        temporary = path.with_name(f".{secrets.token_hex(4)}{PART}{short_name(path.name)}")
        with temporary.open("xb") as stream:
            with suppress(OSError):  # on file systems without locks, clear_abandoned removes nothing
                fcntl.flock(stream, fcntl.LOCK_EX)
            if not temporary.exists():  # another process cleared it before it was locked
                continue
            try:
                yield temporary
            finally:
                temporary.unlink(missing_ok=True)
            return


def clear_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove temporary files of dead processes (their locks are free), of the file `name` or of all files."""
    for temporary in folder.glob(f".{'[0-9a-f]' * 8}{PART}{'*' if name is None else escape(short_name(name))}"):
        with suppress(OSError, InputError), open_input(temporary) as stream:  # in use, removed meanwhile, or no file
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""

    def write(temporary: Path) -> None:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # of names that are not UTF-8

    write_whole(path, write)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV file atomically: a header, then one line per row; None becomes an empty field.

    Texts are written as they are printed; one that a spreadsheet would execute as a formula begins with an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_field, columns))
    writer.writerows(map(_field, row) for row in rows)
    write_text(path, text.getvalue())


def _field(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = printable(value, LONGEST_FIELD)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) and not _SIGNED.fullmatch(text) else text


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises MachineError, or InputError where it cannot be one of results."""
    check_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(
            f"{printable(path)}: expected a folder to write to, but a file of that name is in the way"
        ) from error
    except OSError as error:
        raise input_error(path, error) or MachineError(
            f"{printable(path)}: the folder could not be created ({error.strerror})"
        ) from error


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of the arrays' shapes, types and bytes, as hexadecimal text."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype.str}{array.shape}".encode())
        total.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return total.hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, as hexadecimal text. Raises InputError if it cannot be read."""
    try:
        with open_input(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error})") from error


def fingerprint(description: object) -> str:
    """SHA-256 of a JSON description; results with equal fingerprints were made from the same."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def cached(
    path: Path,
    wanted: str,
    read: Callable[[Path], tuple[Content, str | None]],
    make: Callable[[], Made],
    write: Callable[[Path, Made], None],
    force: bool = False,
) -> tuple[Content, bool]:
    """Return the result at `path` and False if it was made from what `wanted` names; else make it, and True.

    path : file, or folder of several files that belong together
    wanted : fingerprint of everything that the result depends on
    read : yields the result and its fingerprint; may raise UNREADABLE for a file that is missing, damaged
        or of another kind, which is then made again
    write : writes what `make` returns; the result is read back, so that it is the same in this run and the next
    force : True to make it in any case
    """
    if not force:
        with suppress(*UNREADABLE):
            content, made_from = read(path)
            if made_from == wanted:
                return content, False
    write(path, make())
    return read(path)[0], True
