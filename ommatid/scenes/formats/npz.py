"""NPZ and NPY files, read safely: damaged and too large ones are refused before memory is allocated."""

from __future__ import annotations

import io
import os
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input
from ommatid.runtime.machine import check_memory

MOST_DEFLATED = 1032  # largest ratio of inflated to deflated bytes
FASTEST = 1  # level of compression: entries of H take as many bytes as at level 6
LONGEST_HEADER = 10_000  # bytes of the description of an array, as numpy has it
LARGEST_DIRECTORY = 2**20  # bytes of the list of an archive's members
END, END_64 = b"PK\5\6", b"PK\6\6"  # of an archive; its comment takes 64 KiB at most
KINDS = "biufSU"  # of arrays in archives: truth values, numbers and texts
LARGEST_NUMBER = 8  # bytes

# Exceptions of numpy and zipfile for damaged files: RuntimeError for an encrypted one, TokenError for a header that is
# not Python, RecursionError and MemoryError for too long a header, NotImplementedError for an unknown compression.
_UNREADABLE = (
    *(ValueError, KeyError, IndexError, TypeError, OSError, EOFError, RuntimeError, SyntaxError, MemoryError),
    *(OverflowError, AttributeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


class Header(NamedTuple):
    """Shape and type of an array, known before the array is read."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return prod(self.shape) * self.dtype.itemsize


Headers = Mapping[str, Header]


def read(path: Path, check: Callable[[Headers], None] | None = None) -> dict[str, NDArray[Any]]:
    """Read all arrays of an archive by their names.

    check : called with the headers of all arrays before one of them is read; raises ValueError to refuse the file
    Raises ValueError that says why it cannot be read, and InputError for arrays that do not fit into memory.
    """
    with _readable(), open_input(path) as stream:
        headers = _headers(stream)
        if check is not None:
            check(headers)
        check_memory(sum(header.size for header in headers.values()), f"{path}: to read it", "close other programs")
        stream.seek(0)
        with warnings.catch_warnings(action="ignore"), np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by their names, as `numpy.savez_compressed` does, but six times faster."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=FASTEST) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def _headers(stream: IO[bytes]) -> dict[str, Header]:
    """Headers of all arrays by name. Raises ValueError if the file is too short to hold them, or is no archive."""
    size = stream.seek(0, os.SEEK_END)
    _check_directory(stream, size)
    found: dict[str, Header] = {}
    with zipfile.ZipFile(stream) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in found or name == member.filename:
                raise ValueError(f"expected arrays of different names, got {name!r} twice or without .npy")
            with archive.open(member) as inside:
                found[name] = _checked(name, header(inside))
            if found[name].size > member.file_size or member.file_size > MOST_DEFLATED * size:
                raise ValueError(f"{member.filename} is cut short")
    return found


def _check_directory(stream: IO[bytes], size: int) -> None:
    """Raise ValueError for an archive with too many members: each takes 1 KB of memory as soon as it is opened."""
    stream.seek(max(size - 2**16 - 200, 0))
    tail = stream.read()
    sizes = [0]
    for mark, first, last in ((END, 12, 16), (END_64, 40, 48)):
        at = tail.rfind(mark)
        if at >= 0 and last + at <= len(tail) and tail[at + first : at + last] != b"\xff" * (last - first):
            sizes.append(int.from_bytes(tail[at + first : at + last], "little"))
    if max(sizes) > LARGEST_DIRECTORY:
        raise ValueError("it has too many members")


def _checked(name: str, given: Header) -> Header:
    """The header of an array of an archive. Raises ValueError for a type that none of our files has."""
    dtype = given.dtype
    number = dtype.kind in "biuf"
    if dtype.kind not in KINDS or not dtype.isnative or (number and dtype.itemsize > LARGEST_NUMBER) or dtype.subdtype:
        raise ValueError(f"expected numbers or texts of this machine's kinds as {name!r}, got {dtype}")
    if dtype.itemsize == 0 and prod(given.shape) > 1:
        raise ValueError(f"expected numbers or texts as {name!r}, got {prod(given.shape)} empty texts")
    return given


def header(stream: IO[bytes]) -> Header:
    """Shape and dtype of the array whose NPY header begins a stream. Raises ValueError if there is no such header."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    length = stream.read(2 if version == (1, 0) else 4)
    if int.from_bytes(length, "little") > LONGEST_HEADER:  # numpy would read it whole before it refuses it
        raise ValueError("the description of an array is too long")
    described = io.BytesIO(length + stream.read(int.from_bytes(length, "little")))
    with warnings.catch_warnings(action="ignore"):
        shape, _, dtype = read_header(described)
    if any(count < 0 for count in shape):
        raise ValueError(f"a shape of {shape}")
    if dtype.hasobject:
        raise ValueError("it holds pickled objects")
    return Header(shape, dtype)


def array(path: Path) -> NDArray[Any]:
    """Read an NPY file. Raises ValueError that says why it cannot be read, InputError if memory is too small."""
    with _readable(), open_input(path) as stream:
        size = header(stream).size
        if size > stream.seek(0, os.SEEK_END):
            raise ValueError("it is cut short")
        check_memory(3 * size, f"{path}: to read it", "take a smaller one, or free some memory")
        stream.seek(0)
        with warnings.catch_warnings(action="ignore"):
            return np.load(stream, allow_pickle=False)


@contextmanager
def _readable() -> Generator[None]:
    """Convert what numpy and zipfile raise for a damaged file to a ValueError that says why it cannot be read."""
    try:
        yield
    except InputError:
        raise
    except _UNREADABLE as error:
        raise ValueError(
            "it holds pickled objects" if "pickle" in str(error) else str(error) or type(error).__name__
        ) from error
