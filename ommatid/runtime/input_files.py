"""Files that are read: opened without waiting, only if they are regular, and never larger than a reader expects.

Opening a FIFO waits for a writer, and a device may have no end.
"""

from __future__ import annotations

import codecs
import json
import os
import stat
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

from .errors import InputError, shortened, shortened_repr

LARGEST_TEXT = 64_000_000  # bytes of a description: a scene, a lens, a table or a report

_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


@contextmanager
def open_input(path: Path) -> Generator[BufferedReader]:
    """Open a regular file for reading. Raises InputError for anything else, OSError if it cannot be opened."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        opened = os.fdopen(descriptor, "rb")
    except OSError:  # a folder
        os.close(descriptor)
        raise
    with opened as stream:
        _check_kind(path, os.fstat(descriptor).st_mode)
        yield stream


def check_regular(path: Path) -> None:
    """Raise InputError if a path names something other than a regular file; for libraries that open files themselves.

    Raises OSError if there is nothing of that name.
    """
    _check_kind(path, path.stat().st_mode)


def read_bytes(path: Path, largest: int = LARGEST_TEXT) -> bytes:
    """Read a regular file of at most `largest` bytes. Raises InputError, and OSError if it cannot be opened."""
    with open_input(path) as stream:
        declared = os.fstat(stream.fileno()).st_size
        content = b"" if declared > largest else stream.read(largest + 1)
    if max(declared, len(content)) > largest:
        raise InputError(f"{path}: expected a file of at most {largest / 1e6:.3g} MB, got a larger one")
    return content


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """Read a regular UTF-8 file. Raises as `read_bytes` does, and UnicodeDecodeError."""
    return read_bytes(path, largest).decode("utf-8")


def read_any_text(path: Path, kind: str, largest: int = LARGEST_TEXT) -> str:
    """Return the text of a file of other programs, such as a "lens file", in UTF-16, UTF-8 or Latin-1.

    Raises InputError.
    """
    try:
        data = read_bytes(path, largest)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such {kind}; expected one beside the scene file") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read as a {kind} ({error.strerror or error})") from error
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "latin-1"):
        with suppress(UnicodeDecodeError):
            return data.decode(encoding)
    raise InputError(f"{path}: could not be read as a {kind}; its UTF-16 is damaged")


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON document. Raises ValueError if it is none, or has a key twice in one table.

    Readers differ in which of two equal keys they take, so that such a document has no certain meaning.
    """
    return json.loads(text, object_pairs_hook=_table)


def read_record(path: Path, kind: Any, what: str, cure: str, *, strict: bool = False) -> Any:
    """Read a JSON file of records that this program wrote. Raises InputError with what was expected, and the cure.

    kind : type that pydantic checks;  strict : True if numbers may not be texts
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        content = read_bytes(path)
        record = TypeAdapter(kind).validate_json(content, strict=strict)
        parse_json(content)
        return record
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: expected {what}, got no file that can be read ({error.strerror}); {cure}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key, reason = shortened(".".join(map(str, first["loc"]))) or "content", shortened(first["msg"])
        raise InputError(f"{path}: expected {what}, got a file whose {key} is wrong: {reason}; {cure}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {error}; {cure}") from error


def real_path(path: Path) -> Path:
    """Return the absolute path without symbolic links; one with links in a circle as far as it can be followed."""
    return Path(os.path.realpath(path))


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"expected each key of a table once, got {shortened_repr(twice)} twice")
    return table


def _check_kind(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: expected a regular file, got {kind(mode)}")


def kind(mode: int) -> str:
    """Return in words what a file of this mode is."""
    return _KINDS.get(stat.S_IFMT(mode), "something else")
