"""TIFF files, whose library is to say nothing by itself, and to follow no chain of pages that bites its own tail."""

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

BYTES = 24  # of memory for each number: as it is, in float64, and a copy of that
COLOURS = 3, 4
STRANGE = {"PALETTE": "a palette's colours", "SEPARATED": "inks (CMYK)", "MINISWHITE": "a picture in which 0 is white"}


def picture(path: Path) -> NDArray[Any]:
    """The first picture or series of pictures in a file, colours last. Raises what the library raises.

    Raises InputError for one that memory does not hold, whose compression is not known here, or that is not of light.
    """
    with _opened(path) as file:
        _refuse_beyond(path, BYTES * prod(file.series[0].shape))
        found = np.asarray(file.asarray())
    planar = found.ndim > 2 and found.shape[-1] not in COLOURS and found.shape[-3] in COLOURS
    return np.moveaxis(found, -3, -1) if planar else found


def pages(path: Path) -> list[NDArray[Any]]:
    """The pages of a file. Raises as `picture` does."""
    with _opened(path) as file:
        sizes = [(prod(page.shape), page.dtype.itemsize) for page in file.pages]
        _refuse_beyond(path, sum(size * each for size, each in sizes) + BYTES * max(size for size, _ in sizes))
        return [page.asarray() for page in file.pages]


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    import tifffile

    log = logging.getLogger("tifffile")
    if not log.handlers:  # else what it finds wrong appears on stderr
        log.addHandler(logging.NullHandler())
    log.propagate = False
    with cast(Any, tifffile).TiffFile(path) as file:
        len(file.pages)  # goes to the end of the chain, and only so is it noticed where there is none
        stored = STRANGE.get(getattr(file.pages[0].photometric, "name", ""))
        if stored is not None:
            raise InputError(f"{path}: expected grey or RGB, got {stored}; save it as one of these")
        try:
            yield file
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            kind = file.pages[0].compression.name
            raise InputError(f"{path}: its compression {kind} is not read; save it without, or with Deflate") from error


def _refuse_beyond(path: Path, needed: int) -> None:
    check_memory(needed, f"{path}: to read it", "take a smaller picture, or free some memory")
