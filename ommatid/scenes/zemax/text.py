"""Text of files in UTF-16, UTF-8 or Latin-1, as programs of several decades wrote them."""

from __future__ import annotations

import codecs
from pathlib import Path

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.input_files import read_bytes

LARGEST = 2**24  # bytes; the largest catalogues of glass makers have one million
EXTREME = 1e9  # largest number


def read_text(path: Path, kind: str) -> str:
    """Return the text of a file, such as a "lens file". Raises InputError."""
    try:
        data = read_bytes(path, LARGEST)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such {kind}; expected one beside the scene file") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read as a {kind} ({error.strerror or error})") from error
    try:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return data.decode("utf-16")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise InputError(f"{path}: could not be read as a {kind} ({error})") from error
        return data.decode("latin-1")


def number(word: str, where: str, what: str) -> float:
    """Convert a word of a file to a number. Raises InputError that begins with `where`."""
    try:
        value = float(word.replace(",", "."))  # some programs write the comma of their language
    except ValueError:
        value = float("nan")
    if not abs(value) <= EXTREME:
        raise InputError(f"{where}: expected {what}, a number of at most {EXTREME:g}, got '{shortened(word)}'")
    return value
