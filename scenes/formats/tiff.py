"""TIFF files. Silences tifffile's logging and stops at circular lists of pages."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import check_memory

BYTES = 24  # of memory per number: as stored, in float64, and a copy of that
COLOURS = 3, 4  # channels of a colour picture
UNSUPPORTED = {
    "PALETTE": "a palette's colours",
    "SEPARATED": "inks (CMYK)",
    "MINISWHITE": "a picture in which 0 is white",
}


def picture(path: Path) -> NDArray[Any]:
    """Read the first picture or series of pictures in a file, colours last.

    Raises InputError for one that does not fit into memory, has an unknown compression, or is neither grey nor RGB, and
    tifffile's own exceptions for a damaged file.
    """
    with _opened(path) as file:
        _check_memory(path, BYTES * prod(file.series[0].shape))
        pixels = np.asarray(file.asarray())
    planar = pixels.ndim > 2 and pixels.shape[-1] not in COLOURS and pixels.shape[-3] in COLOURS
    return np.moveaxis(pixels, -3, -1) if planar else pixels


def pages(path: Path) -> list[NDArray[Any]]:
    """Read the pages of a file. Raises as `picture` does."""
    with _opened(path) as file:
        sizes = [(prod(page.shape), page.dtype.itemsize) for page in file.pages]
        _check_memory(path, sum(size * itemsize for size, itemsize in sizes) + BYTES * max(size for size, _ in sizes))
        return [page.asarray() for page in file.pages]


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    """A tifffile.TiffFile. Raises InputError for unsupported colours and compressions."""
    import tifffile

    log = logging.getLogger("tifffile")
    if not log.handlers:  # otherwise its messages appear on stderr
        log.addHandler(logging.NullHandler())
    log.propagate = False
    with cast(Any, tifffile).TiffFile(path) as file:
        len(file.pages)  # walks the whole list, which raises if the list is circular
        stored = UNSUPPORTED.get(getattr(file.pages[0].photometric, "name", ""))
        if stored is not None:
            raise InputError(f"{path}: expected grey or RGB, got {stored}; save it as one of these")
        try:
            yield file
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            name = file.pages[0].compression.name
            raise InputError(f"{path}: its compression {name} is not read; save it without, or with Deflate") from error


def _check_memory(path: Path, needed: int) -> None:
    check_memory(needed, f"{path}: to read it", "take a smaller picture, or free some memory")
