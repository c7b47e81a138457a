"""Pictures as their files store them, and the orientation that a camera notes in a file's EXIF data."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory

BYTES = 24  # of memory per number: as stored, in float64, and a copy of that
UPRIGHT = 1  # value of the orientation tag
ORIENTATION_TAG = 274
LINEAR, USUAL = 1.0, 1 / 2.2  # gammas: of values proportional to light, and of most pictures


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


def check_size(path: Path, numbers: int, more: int = 0) -> None:
    """Raise InputError if so many numbers, and `more` bytes, do not fit into memory; to be called before allocation."""
    check_memory(BYTES * numbers + more, f"{path}: to read it", "take a smaller picture, or free some memory")


def check_single(path: Path, count: int, what: str) -> None:
    """Raise InputError if a file holds several pictures, and not one."""
    if count > 1:
        raise InputError(f"{path}: expected one picture, got {count} {what}; save one of them as a file of its own")


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


def orientation_of(exif: bytes) -> int:
    """Return the orientation that EXIF data state; 1, upright, if they state none or are damaged."""
    from PIL import Image

    described = Image.Exif()
    try:
        described.load(exif)
        return int(described.get(ORIENTATION_TAG, UPRIGHT))
    except Exception:  # Pillow has many for damaged data
        return UPRIGHT


def profile_notes(profile: bytes) -> tuple[str, ...]:
    """Return what is said of a picture with an ICC profile: nothing for sRGB, which is what most pictures are."""
    usual = not profile or b"sRGB" in profile or "sRGB".encode("utf-16-be") in profile
    return () if usual else ("has a colour profile, which is not applied: its values are used as they are",)


def gamma_notes(gamma: float | None) -> tuple[str, ...]:
    """Return what is said of a picture with a gamma: nothing for the usual one and for values proportional to light."""
    if gamma is None or min(abs(gamma - usual) for usual in (LINEAR, USUAL)) < 0.01:
        return ()
    return (f"states a gamma of {gamma:.4g}, which is not applied: its values are used as they are",)


@contextmanager
def any_size() -> Generator[None]:
    """Lift Pillow's limit on the number of pixels: memory is the limit here."""
    from PIL import Image

    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit
