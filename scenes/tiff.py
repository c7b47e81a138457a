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

from .memory import refuse_beyond

BYTES = 24  # of memory for each number: as it is, in float64, and a copy of that
COLOURS = 3, 4


def picture(path: Path) -> NDArray[Any]:
    """The first picture or series of pictures in a file, colours last. Raises what the library raises.

    Raises InputError for one that memory does not hold.
    """
    with _opened(path) as file:
        found = np.asarray(file.asarray())
    planar = found.ndim > 2 and found.shape[-1] not in COLOURS and found.shape[-3] in COLOURS
    return np.moveaxis(found, -3, -1) if planar else found


def pages(path: Path) -> list[NDArray[Any]]:
    """The pages of a file. Raises as `picture` does."""
    with _opened(path) as file:
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
        needed = BYTES * sum(prod(page.shape) for page in file.pages)
        refuse_beyond(needed, f"{path}: to read it", "take a smaller picture, or free some memory")
        yield file
