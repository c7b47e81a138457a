"""NPZ and NPY files, read safely: without pickled objects, and within the memory that is free."""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input
from ommatid.runtime.machine import check_memory

FASTEST = 1  # level of compression: entries of H take as many bytes as at level 6
LARGEST_DIRECTORY = 2**20  # bytes of the list of an archive's members, each of which takes 1 KB once it is opened
DIRECTORY_SIZE = 5  # place of that number in the record at the end of an archive
KINDS = "biufSU"  # of arrays: truth values, numbers and texts
LARGEST_NUMBER = 8  # bytes

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
    with _readable(), open_input(path) as stream:
        end = cast(Any, zipfile)._EndRecData(stream)  # by which `ZipFile` itself finds the list, before it reads it
        if end is None or end[DIRECTORY_SIZE] > LARGEST_DIRECTORY:
            raise ValueError("it is no archive, or has too many members")
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as file:
            needed = sum(member.file_size for member in file.zip.infolist())  # of which no member yields more
            check_memory(needed, f"{path}: to read it", "close other programs")
            arrays = {name: file[name] for name in file.files}
    for name, values in arrays.items():
        dtype = getattr(values, "dtype", np.dtype(object))  # a member without .npy is bytes
        is_large = dtype.kind not in "SU" and dtype.itemsize > LARGEST_NUMBER
        if dtype.kind not in KINDS or is_large or not dtype.isnative:
            raise ValueError(f"expected numbers or texts of this machine's kinds as {name!r}, got {dtype}")
    return arrays


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by their names, as `numpy.savez_compressed` does, but six times faster."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=FASTEST) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def array(path: Path) -> NDArray[Any]:
    """Read an NPY file. Raises ValueError that says why it cannot be read, InputError if memory is too small."""
    with _readable():
        with open_input(path) as stream:
            if np.lib.format.read_magic(stream) != (1, 0):  # others may have headers of any length
                raise ValueError("expected version 1.0 of the format, as numpy writes numbers")
        check_memory(3 * path.stat().st_size, f"{path}: to read it", "take a smaller one, or free some memory")
        return np.array(np.lib.format.open_memmap(path, mode="r"))  # which is refused if the file is too short for it


@contextmanager
def _readable() -> Generator[None]:
    """Convert what numpy and zipfile raise for a damaged file to a ValueError that says why it cannot be read."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except _UNREADABLE as error:
        raise ValueError(
            "it holds pickled objects" if "pickle" in str(error) else str(error) or type(error).__name__
        ) from error
