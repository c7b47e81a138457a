"""Names of folders and files that results get from scenes, stacks and swept values."""

from __future__ import annotations

import hashlib

from ..errors import InputError
from ..printable import printable

LONGEST = 200  # bytes: 255, less what is added to the names of temporary files


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
