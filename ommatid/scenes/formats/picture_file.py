"""Files with pictures: PNG, JPEG, TIFF, EXR and NPY. Nothing is scaled, and nothing is lost without a note."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import check_regular, open_input

from . import exr, npz, tiff
from .png_and_jpeg import JPEG_SIGNATURE, read_jpeg, read_png
from .stored_picture import StoredPicture, check_size

TIFF, IMAGES = (".tif", ".tiff"), (".png", ".jpg", ".jpeg")
Reader = Callable[[BinaryIO, Path], Any]


def read_picture(path: Path, where: str) -> StoredPicture:
    """Read a picture as it is stored, upright. Raises InputError that begins with `where`."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return _read(path, where, _read_exr)
    if suffix == ".npy":
        return _read(path, where, _read_array)
    if suffix in TIFF:
        return _read(path, where, tiff.picture)
    if suffix in IMAGES:
        return _read(path, where, _read_image)
    raise InputError(f"{where}: expected a PNG, TIFF, EXR or NPY file, got {path}")


def read_frames_of(path: Path, where: str) -> list[StoredPicture]:
    """Read the frames of a camera in a file: a picture, the pages of a TIFF, or a (frames, rows, columns) array.

    Raises InputError as `read_picture` does, and for JPEG, whose numbers are not the sensor's.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF:
        return _read(path, where, tiff.pages)
    if suffix == ".png":
        return [_read(path, where, _read_lossless)]
    picture = read_picture(path, where)
    # A last axis of up to four is colours; a sensor has more columns.
    several = picture.pixels.ndim == 3 and picture.pixels.shape[2] > len("RGBA")
    return [StoredPicture(pixels) for pixels in picture.pixels] if several else [picture]


def decode(path: Path, where: str) -> NDArray[Any]:
    """Read the numbers of a picture as they are stored. Raises InputError that begins with `where`."""
    return read_picture(path, where).pixels


def _read(path: Path, where: str, reader: Reader) -> Any:
    """Call the reader of a format, whose own exceptions say that the file is damaged."""
    try:
        check_regular(path)
        with _silenced(), open_input(path) as stream:
            return reader(stream, path)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except FileNotFoundError as error:
        raise InputError(f"{where}: there is no file {path}") from error
    except PermissionError as error:
        raise InputError(f"{where}: {path} could not be opened; permit reading it") from error
    except Exception as error:  # every decoder has exceptions of its own
        raise InputError(
            f"{where}: {path} could not be read as a picture; it is damaged or another kind of file"
        ) from error


def _read_image(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read a PNG or JPEG file; their names are often exchanged."""
    return read_jpeg(stream, path) if stream.read(3) == JPEG_SIGNATURE else read_png(stream, path)


def _read_lossless(stream: BinaryIO, path: Path) -> StoredPicture:
    if stream.read(3) == JPEG_SIGNATURE:
        raise InputError(f"{path}: expected a PNG file, got a JPEG, which does not keep the sensor's numbers")
    return read_png(stream, path)


def _read_exr(_: BinaryIO, path: Path) -> StoredPicture:
    return exr.read_picture(path)  # the library opens files by their names


def _read_array(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read an NPY file whose header is that of a picture."""
    shape, dtype = npz.header(stream)
    if dtype.kind not in "buif":
        raise InputError(f"{path}: expected 8-bit, 16-bit or floating-point values, got {str(dtype)[:40]}")
    if len(shape) not in (2, 3):
        raise InputError(f"{path}: expected a picture of rows x columns, grey or colour, got shape {str(shape)[:40]}")
    numbers = prod(shape)
    if numbers * dtype.itemsize > path.stat().st_size:
        raise ValueError("it is cut short")
    check_size(path, numbers)
    return StoredPicture(npz.array(path))


@contextmanager
def _silenced() -> Generator[None]:
    """Suppress warnings and messages of the libraries, which do not name the file in our way."""
    log = logging.getLogger("PIL")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
    log.propagate = False
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        yield
