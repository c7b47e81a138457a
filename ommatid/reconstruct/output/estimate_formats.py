"""The estimate as a NumPy file or as TIFF, beside estimate.exr, for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from ommatid.runtime.arrays import Float32Array
from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.files import UNREADABLE, write_whole
from ommatid.scenes.constants import WHITE
from ommatid.scenes.formats import exr, npz, tiff

Format = Literal["npy", "tiff16", "tiff32"]
STEPS = 257  # of a 16-bit value per grey level: 65535 stands for 255, as in pictures that are read
MARK = "ommatid estimate: "
DESCRIPTIONS = {
    "tiff16": f"{MARK}value = pixel / {STEPS}, in grey levels from 0 to 255; others are clipped",
    "tiff32": f"{MARK}pixels are values in grey levels, 0 to 255, not clipped",
}


def formats_of(names: Sequence[str]) -> tuple[Format, ...]:
    """Check names of formats. Raises InputError for an unknown one, and for both kinds of TIFF, which are one file."""
    for name in names:
        if name not in get_args(Format):
            known = ", ".join(get_args(Format))
            raise InputError(
                f"--format: expected names of {known} (the estimate), svg, pdf (figures), got '{shortened(name)}'"
            )
    if {"tiff16", "tiff32"} <= set(names):
        raise InputError("--format: tiff16 and tiff32 are one file, estimate.tiff; name one of them")
    return cast(tuple[Format, ...], tuple(names))


def write_formats(estimate: Path, formats: Sequence[Format]) -> list[Path]:
    """Write the estimate of an OpenEXR file beside it, as .npy or .tiff, and return the files.

    Raises InputError if `estimate` cannot be read, MachineError for a full disk.
    """
    if not formats:
        return []
    image = exr.read(estimate)[0].channels["estimate"]
    return [_write(estimate, image, name) for name in formats]


def format_file(estimate: Path, name: Format) -> Path:
    """Return the file of a format beside an estimate."""
    return estimate.with_suffix(".npy" if name == "npy" else ".tiff")


def files_in_formats(estimate: Path) -> list[Path]:
    """Return the files that show the estimate in an OpenEXR file, which another estimate makes wrong."""
    return [path for name in ("npy", "tiff16") if shows_estimate(path := format_file(estimate, name), estimate)]


def check_formats(estimate: Path, formats: Sequence[Format]) -> None:
    """Raise InputError if a file that holds something else would be replaced by an estimate in other formats."""
    for name in formats:
        path = format_file(estimate, name)
        if path.exists() and not shows_estimate(path, estimate):
            raise _in_the_way(path)


def check_picture(estimate: Path) -> None:
    """Raise InputError if the PNG file beside an estimate would be replaced, but there is no estimate that it shows."""
    picture = estimate.with_suffix(".png")
    if picture.exists() and not _is_estimate(estimate):
        raise _in_the_way(picture)


def _in_the_way(path: Path) -> InputError:
    return InputError(f"{path}: would be replaced, but holds something else; remove it, or choose another name with -o")


def _is_estimate(path: Path) -> bool:
    with suppress(*UNREADABLE):
        return {"estimate", "variance"} <= exr.read(path)[0].channels.keys()
    return False


def shows_estimate(path: Path, estimate: Path) -> bool:
    """Whether a .npy file holds the estimate of an OpenEXR file, or a .tiff file was written for one."""
    if not path.is_file():
        return False
    with suppress(*UNREADABLE):
        if path.suffix == ".npy":
            image = exr.read(estimate)[0].channels["estimate"]
            return np.array_equal(npz.array(path), image, equal_nan=True)
        return tiff.description(path).startswith(MARK)
    return False


def _write(estimate: Path, image: Float32Array, name: Format) -> Path:
    path = format_file(estimate, name)
    if name == "npy":

        def save(beside: Path) -> None:
            with beside.open("wb") as stream:
                np.save(stream, image)

        write_whole(path, save)
        return path
    pixels = np.round(np.clip(image.astype(np.float64), 0, WHITE) * STEPS).astype(np.uint16)
    write_whole(path, lambda beside: _write_tiff(beside, image if name == "tiff32" else pixels, DESCRIPTIONS[name]))
    return path


def _write_tiff(path: Path, pixels: Any, description: str) -> None:
    import tifffile

    imwrite: Any = tifffile.imwrite  # pyright: ignore[reportUnknownMemberType]
    with path.open("wb") as stream:
        imwrite(stream, pixels, photometric="minisblack", description=description, metadata=None)
