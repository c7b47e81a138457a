"""Archives of arrays, read so that a damaged one is refused whatever is wrong with it, and before memory is taken."""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.memory import check_memory

MOST_DEFLATED = 1032  # bytes that one byte of a deflated file can become

# What numpy and zipfile raise for damaged files: RuntimeError for an encrypted one, TokenError for a header that is no
# Python, RecursionError and MemoryError for one that is too much of it, NotImplementedError for an unknown compression.
_UNREADABLE = (
    *(ValueError, KeyError, IndexError, TypeError, OSError, EOFError, RuntimeError, SyntaxError, MemoryError),
    *(OverflowError, AttributeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def read(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an archive by their names.

    Raises ValueError that says why it cannot be read, OSError where there is no such file among the reasons, and
    InputError for arrays that memory does not hold.
    """
    try:
        with path.open("rb") as stream:  # numpy leaves a damaged file open, so we open it
            needed = _promised(stream, path.stat().st_size)
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error
    check_memory(needed, f"{path}: to read it", "close other programs")
    try:
        with _quiet(), path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error


def _promised(stream: IO[bytes], size: int) -> int:
    """Bytes of all arrays as their headers tell. Raises ValueError where the file cannot hold as much."""
    total = 0
    with zipfile.ZipFile(stream) as archive:
        for member in archive.infolist():
            with archive.open(member) as inside:
                promised = array_size(inside)
            if promised > member.file_size or member.file_size > MOST_DEFLATED * size:
                raise ValueError(f"{member.filename} is cut short")
            total += promised
    return total


def array_size(stream: IO[bytes]) -> int:
    """Bytes of the array whose NPY header a stream begins with. Raises ValueError for one that is none."""
    shape, kind = header(stream)
    return prod(shape) * kind.itemsize


def header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the array whose NPY header a stream begins with. Raises ValueError for one that is none."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with _quiet():
        shape, _, kind = read_header(stream)
    if any(count < 0 for count in shape):
        raise ValueError(f"a shape of {shape}")
    if kind.hasobject:
        raise ValueError("it holds pickled objects")
    return shape, kind


def array(path: Path) -> NDArray[Any]:
    """The array of an NPY file. Raises ValueError that says why it cannot be read, InputError for too large a one."""
    try:
        with path.open("rb") as stream:
            promised = array_size(stream)
            if promised > path.stat().st_size:
                raise ValueError("it is cut short")
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error
    check_memory(3 * promised, f"{path}: to read it", "take a smaller one, or free some memory")
    try:
        with _quiet(), path.open("rb") as stream:
            return np.load(stream, allow_pickle=False)
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error


@contextmanager
def _quiet() -> Generator[None]:
    """Keep numpy's words about headers of other days off stderr."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _reason(error: BaseException) -> str:
    return "it holds pickled objects" if "pickle" in str(error) else str(error) or type(error).__name__
