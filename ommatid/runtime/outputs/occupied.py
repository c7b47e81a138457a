"""Folders of results that one process writes at a time, and that a refusal leaves as it found them."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from stat import S_ISREG

from ..errors import InputError
from ..files import make_folder, written
from ..printable import printable, printable_sentence

LOCK = ".ommatid.lock"


def _say(sentence: str) -> None:
    print(printable_sentence(sentence), file=sys.stderr, flush=True)


@contextmanager
def occupied(
    folder: Path, finished: str = "", *, lock: str = LOCK, say: Callable[[str], None] = _say
) -> Generator[None]:
    """Make a folder and keep other processes out of it, until they have ended a process waits here for them.

    After an InputError raised inside, no file that this process wrote anew is left, and no folder that it made.

    finished : file that the first stage makes; once it is made, a later InputError leaves everything
    lock : name of the lock file inside, which is removed at the end; a killed process frees it
    Raises InputError or MachineError if there can be no such folder.
    """
    created: list[Path] = []
    try:
        with _locked(folder, lock, say, created):
            before, made = set(folder.iterdir()), _identity(folder / finished)
            try:
                yield
            except InputError:
                if not finished or _identity(folder / finished) == made:
                    _remove_files(folder, before)
                raise
    finally:
        remove_empty(created)


@contextmanager
def new_folder(folder: Path) -> Generator[None]:
    """Make a folder that several processes may write to; it is removed at the end if nothing is in it."""
    created = _missing(folder)
    make_folder(folder)
    try:
        yield
    finally:
        remove_empty(created)


def remove_empty(folders: list[Path]) -> None:
    """Remove those of some folders that are empty, the innermost first."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _missing(folder: Path) -> list[Path]:
    """Return those of a folder and its parents that do not exist, the innermost first."""
    missing: list[Path] = []
    for path in (folder, *folder.parents):
        try:
            path.stat()
            break
        except OSError:
            missing.append(path)
    return missing


@contextmanager
def _locked(folder: Path, name: str, say: Callable[[str], None], created: list[Path]) -> Generator[None]:
    """Hold the lock file of a folder, which is made; `created` takes the folders that were missing."""
    path, waits = folder / name, False
    while True:
        created[:0] = _missing(folder)
        make_folder(folder)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        except FileNotFoundError:  # the process that made the folder has removed it
            continue
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
                raise _in_the_way(path) from error
            yield  # nothing can be written here, so nothing needs a lock
            return
        with os.fdopen(descriptor, "rb+", buffering=0):
            status = os.fstat(descriptor)
            if not S_ISREG(status.st_mode) or status.st_size:  # it would be removed at the end
                raise _in_the_way(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not waits:
                    say(f"{printable(folder)}: another process is writing there; waiting for its end")
                waits = True
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            except OSError:
                say(
                    f"warning: {printable(folder)}: no locks on this file system; do not run two commands there at once"
                )
            if _identity(path) != _of(os.fstat(descriptor)):  # removed by the process that held it
                continue
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _in_the_way(path: Path) -> InputError:
    return InputError(f"{printable(path)}: expected a lock file, got something else; remove it")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from the one that replaces it; None if there is none."""
    with suppress(OSError):
        return _of(path.stat())
    return None


def _of(status: os.stat_result) -> tuple[int, int]:
    return status.st_ino, status.st_mtime_ns


def _remove_files(folder: Path, kept: set[Path]) -> None:
    """Remove what this process wrote, except `kept`; other programs may have saved files there meanwhile."""
    for path in set(folder.iterdir()) - kept:
        if path.absolute() in written:
            with suppress(OSError):
                path.unlink()
