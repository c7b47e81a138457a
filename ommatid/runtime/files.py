"""Writing files so that each appears whole or not at all, and naming what they were made from."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import secrets
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError, MachineError

PART = ".part."  # in the name of a file that is not whole


def write_whole(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a file beside `path`, then rename it: readers never see half of it.

    Raises DeniedError when the disk is full or refuses, InputError when the folder does not exist.
    """
    check_output(path)
    clear_abandoned(path.parent, path.name)
    try:
        with _beside(path) as beside:
            write(beside)
            with beside.open("rb+") as stream:
                os.fsync(stream.fileno())
            beside.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise MachineError(
            f"{path}: could not be written ({reason}); free some space or choose another folder"
        ) from error


@contextmanager
def _beside(path: Path) -> Generator[Path]:
    """An empty file beside `path` that is locked as long as somebody fills it, and is then gone, or renamed."""
    while True:
        beside = path.with_name(f".{secrets.token_hex(4)}{PART}{path.name}")
        with beside.open("xb") as held:
            with suppress(OSError):  # where files cannot be locked nobody clears up either
                fcntl.flock(held, fcntl.LOCK_EX)
            if not beside.exists():  # who clears up came between the two lines before
                continue
            try:
                yield beside
            finally:
                beside.unlink(missing_ok=True)
            return


def clear_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove what dead processes were writing, to the file called `name` or to any: nobody holds its lock."""
    for left in folder.glob(f".{'[0-9a-f]' * 8}{PART}{'*' if name is None else escape(name)}"):
        with suppress(OSError), left.open("rb") as stream:  # another's, or just gone
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


def check_output(path: Path, *inputs: Path) -> None:
    """Raise InputError where a result could not be written, or would replace what it is made from."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if path.is_dir():
        raise InputError(f"{path}: expected the name of a file, got a folder")
    for read in inputs:
        if path.resolve() == read.resolve():
            raise InputError(f"{path}: would replace the file that is read; choose another name with -o")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all."""
    write_whole(path, lambda beside: _write_text(beside, text))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises DeniedError or InputError in one sentence."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: expected a folder to write to, but a file of that name is in the way") from error
    except OSError as error:
        raise MachineError(f"{path}: the folder could not be created ({error.strerror})") from error


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of the arrays' shapes, types and bytes, as hexadecimal text."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype.str}{array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def fingerprint(description: object) -> str:
    """SHA-256 of a JSON description: two results with one fingerprint were made from the same."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()
