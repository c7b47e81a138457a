"""Places of results: regular files in folders, never devices, FIFOs or sockets, and names that every system allows.

A symbolic link in place of a result is replaced by the result, and what it points to stays as it is.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from pathlib import Path

from ..errors import InputError
from ..input_files import kind, real_path
from ..printable import printable

# Suffixes of all files that are written; a folder may hold anything else.
_SUFFIXES = ".exr .npz .npy .png .gif .svg .pdf .tiff .json .csv .html .toml"
SUFFIXES = frozenset(_SUFFIXES.split())
LONGEST = 200  # bytes of a name: 255, less what is added to the names of temporary files
SHORT = 110  # characters of each of two paths in one sentence
_SYSTEM = Path("/dev"), Path("/proc"), Path("/sys")


def check_output(path: Path, *inputs: Path) -> None:
    """Raise InputError if a result could not be written to `path`, or would replace one of its `inputs`."""
    named, parent, mode = printable(path, SHORT), _mode(path.parent), _mode(path)
    if parent is None:
        raise InputError(f"{named}: the folder {printable(path.parent, SHORT)} does not exist; create it first")
    if not stat.S_ISDIR(parent):
        folder = printable(path.parent, SHORT)
        raise InputError(f"{named}: expected a file in a folder, but {folder} is {kind(parent)}")
    if mode is not None and stat.S_ISDIR(mode):
        raise InputError(f"{named}: expected the name of a file, got a folder")
    if mode is not None and not stat.S_ISREG(mode):
        raise InputError(f"{named}: expected the name of a file, got {kind(mode)}; choose another name")
    _check_place(path, path.parent)
    for source in inputs:
        if real_path(path) == real_path(source):
            raise InputError(f"{named}: would replace the file that is read; choose another name with -o")


def check_suffix(path: Path, suffix: str, what: str) -> None:
    """Raise InputError unless a file's name ends as those of its kind do, so that other programs know it."""
    if path.suffix.lower() != suffix:
        example = printable(path.with_suffix(suffix).name, SHORT) if path.name else f"x{suffix}"
        raise InputError(
            f"{printable(path, SHORT)}: expected the name of {what}, ending in {suffix}, such as {example}"
        )


def check_folder(path: Path) -> None:
    """Raise InputError if results could not be written into the folder `path`, or read there; it may be missing.

    A FIFO or a device with the name of a result would be waited for when the result is looked for.
    """
    mode = _mode(path)
    if mode is None:
        return
    if not stat.S_ISDIR(mode):
        raise InputError(
            f"{printable(path)}: expected a folder to write to, but {kind(mode)} of that name is in the way"
        )
    _check_place(path, path)
    with os.scandir(path) as entries:
        for entry in entries:
            inside = _mode(path / entry.name) if Path(entry.name).suffix in SUFFIXES else None
            if inside is not None and not (stat.S_ISREG(inside) or stat.S_ISDIR(inside)):
                found = f"{printable(path / entry.name)}: expected a regular file, got {kind(inside)}"
                raise InputError(f"{found}; remove it or choose another folder")


def check_inside(folder: Path) -> None:
    """Raise InputError if a folder is a link that leads out of the folder where it stands, as in a folder received."""
    if folder.is_symlink() and not real_path(folder).is_relative_to(real_path(folder.parent)):
        raise InputError(
            f"{printable(folder, SHORT)}: expected a folder, got a link to {printable(real_path(folder), SHORT)};"
            " remove it, or choose another folder with -o"
        )


def input_error(path: Path, error: OSError) -> InputError | None:
    """Return what is wrong with a path as the user gave it; None for a failure of the machine."""
    if error.errno == errno.ENAMETOOLONG:
        return InputError(f"{printable(path)}: expected names of at most 255 bytes, got a longer one; shorten it")
    if error.errno == errno.ELOOP:
        return InputError(f"{printable(path)}: expected a file or a folder, got links in a circle; remove them")
    return None


def check_name(name: str, source: object) -> None:
    """Raise InputError unless a name serves for a folder or a file of results.

    Dots alone name the folder above, and names that begin with a dot are those of hidden files.

    source : what has the name, for the message
    """
    wrong = _wrong(name)
    if wrong:
        raise InputError(
            f"{printable(source)}: its results are named after it, and its name {wrong}; rename it, such as to scene1"
        )


def shortened_name(name: str) -> str:
    """Return a name of at most LONGEST bytes: that of a longer one is cut, and ends with its hash."""
    encoded = name.encode(errors="surrogateescape")
    if len(encoded) <= LONGEST:
        return name
    ending = f"~{hashlib.sha256(encoded).hexdigest()[:12]}"
    return encoded[: LONGEST - len(ending)].decode(errors="ignore") + ending


def _mode(path: Path) -> int | None:
    """Return the mode of what a path names, links followed; None if there is nothing. Raises InputError or OSError."""
    if any("\udc80" <= letter <= "\udcff" for letter in str(path)):  # libraries cannot open such names
        raise InputError(f"{printable(path)}: expected names in UTF-8, got other bytes; rename the file or folder")
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise (input_error(path, error) or error) from error


def _check_place(path: Path, folder: Path) -> None:
    resolved = real_path(folder)
    if resolved == _SYSTEM[0] or any(resolved.is_relative_to(system) for system in _SYSTEM[1:]):
        raise InputError(f"{printable(path)}: expected a place for files, got one of the system's, {resolved}")


def _wrong(name: str) -> str:
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return "is not UTF-8"
    if not name or name.startswith("."):
        return "is empty or begins with a dot"
    if size > LONGEST:
        return f"has {size} bytes, more than {LONGEST}"
    if any(letter in "/\\" or not letter.isprintable() for letter in name):
        return "holds characters that do not print, or separators of folders"
    return ""
