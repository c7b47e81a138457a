"""NPZ and NPY files, read safely: damaged and too large ones are refused before memory is allocated."""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.memory import check_memory

MOST_DEFLATED = 1032  # largest ratio of inflated to deflated bytes
FASTEST = 1  # level of compression: entries of H take as many bytes as at level 6

# Exceptions of numpy and zipfile for damaged files: RuntimeError for an encrypted one, TokenError for a header that is
# not Python, RecursionError and MemoryError for too long a header, NotImplementedError for an unknown compression.
_UNREADABLE = (
    *(ValueError, KeyError, IndexError, TypeError, OSError, EOFError, RuntimeError, SyntaxError, MemoryError),
    *(OverflowError, AttributeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def read(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an archive by their names.

    Raises ValueError that says why it cannot be read, and InputError for arrays that do not fit into memory.
    """
    try:
        with path.open("rb") as stream:  # opened here, as numpy leaves a damaged file open
            needed = _declared_size(stream, path.stat().st_size)
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error
    check_memory(needed, f"{path}: to read it", "close other programs")
    try:
        with _silenced(), path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by their names, as `numpy.savez_compressed` does, but six times faster."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=FASTEST) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def _declared_size(stream: IO[bytes], size: int) -> int:
    """Bytes of all arrays by their headers. Raises ValueError if the file is too short to hold them."""
    total = 0
    with zipfile.ZipFile(stream) as archive:
        for member in archive.infolist():
            with archive.open(member) as inside:
                size_of_array = array_size(inside)
            if size_of_array > member.file_size or member.file_size > MOST_DEFLATED * size:
                raise ValueError(f"{member.filename} is cut short")
            total += size_of_array
    return total


def array_size(stream: IO[bytes]) -> int:
    """Bytes of the array whose NPY header begins a stream. Raises ValueError if there is no such header."""
    shape, dtype = header(stream)
    return prod(shape) * dtype.itemsize


def header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of the array whose NPY header begins a stream. Raises ValueError if there is no such header."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with _silenced():
        shape, _, dtype = read_header(stream)
    if any(count < 0 for count in shape):
        raise ValueError(f"a shape of {shape}")
    if dtype.hasobject:
        raise ValueError("it holds pickled objects")
    return shape, dtype


def array(path: Path) -> NDArray[Any]:
    """Read an NPY file. Raises ValueError that says why it cannot be read, InputError if memory is too small."""
    try:
        with path.open("rb") as stream:
            size = array_size(stream)
            if size > path.stat().st_size:
                raise ValueError("it is cut short")
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error
    check_memory(3 * size, f"{path}: to read it", "take a smaller one, or free some memory")
    try:
        with _silenced(), path.open("rb") as stream:
            return np.load(stream, allow_pickle=False)
    except _UNREADABLE as error:
        raise ValueError(_reason(error)) from error


@contextmanager
def _silenced() -> Generator[None]:
    """Suppress numpy's warnings about headers of old formats."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _reason(error: BaseException) -> str:
    return "it holds pickled objects" if "pickle" in str(error) else str(error) or type(error).__name__
