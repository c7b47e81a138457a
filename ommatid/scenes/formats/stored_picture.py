"""Pictures as their files store them, and what is said of them."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory

BYTES = 24  # of memory per number: as stored, in float64, and a copy of that
UPRIGHT = 1  # value of the orientation tag
ORIENTATION_TAG = 274  # of EXIF and TIFF


@dataclass(frozen=True)
class StoredPicture:
    """Numbers of a file without scaling, and what differs between them and what a viewer shows.

    pixels : (rows, columns[, channels]), upright
    bits : bits per number of a file that stores fewer than its type holds (PNG: 1, 2 or 4); None: all of them
    notes : predicates of the picture, such as "is stored turned (...): it is turned upright"
    """

    pixels: NDArray[Any]
    bits: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def bits_each(self) -> int:
        """Bits per number: 1 of a truth value."""
        return self.bits or (1 if self.pixels.dtype.kind == "b" else 8 * self.pixels.dtype.itemsize)


def check_size(path: Path, numbers: int) -> None:
    """Raise InputError if so many numbers do not fit into memory; to be called before they are decoded."""
    check_memory(BYTES * numbers, f"{path}: to read it", "take a smaller picture, or free some memory")


def several(path: Path, what: str) -> InputError:
    """Return the error of a file that holds several pictures, and not one."""
    return InputError(f"{path}: expected one picture, got several {what}; save one of them as a file of its own")


def upright(picture: StoredPicture, orientation: int) -> StoredPicture:
    """Turn a picture as the orientation tag of EXIF and TIFF says, 1 to 8; other values mean upright."""
    pixels = picture.pixels
    if orientation in range(5, 9):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation not in range(2, 9):
        return picture
    note = f"is stored turned or mirrored (orientation {orientation} of EXIF): it is turned upright"
    return replace(picture, pixels=np.ascontiguousarray(pixels), notes=(*picture.notes, note))


def profile_notes(profile: bytes) -> tuple[str, ...]:
    """Return what is said of a picture with an ICC profile: nothing for sRGB, which is what most pictures are."""
    usual = not profile or b"sRGB" in profile or "sRGB".encode("utf-16-be") in profile
    return () if usual else ("has a colour profile, which is not applied: its values are used as they are",)


@contextmanager
def silenced() -> Generator[None]:
    """Discard warnings that C libraries print on stdout and stderr; errors are reported by exceptions."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        os.dup2(null, 2)
        with redirect_stdout(io.StringIO()):  # some warnings pass through Python's sys.stdout
            yield
    finally:
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for descriptor in (*saved, null):
            os.close(descriptor)
