"""Files with pictures: PNG, JPEG, TIFF, EXR and NPY. Nothing is scaled, and nothing is lost without a note.

Libraries read them in this process. The memory of a picture is compared with what is free before it is decoded, from
the size in its header, so that a small file cannot fill it.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.input_files import check_regular, open_input
from ommatid.runtime.machine import check_memory

from . import exr, npz, tiff
from .stored_picture import (
    ORIENTATION_TAG,
    UPRIGHT,
    StoredPicture,
    check_size,
    profile_notes,
    several,
    silenced,
    upright,
)

MOST_COLOURS = len("RGBA")
LINEAR, USUAL = 1.0, 1 / 2.2  # gammas: of values proportional to light, and of most pictures
JPEG_SIGNATURE = b"\xff\xd8\xff"
SCAN, MOST_SCANS = b"\xff\xda", 500  # marker of a scan; a file with many of them is decoded as often
DENSEST = 1024  # pixels per byte of a JPEG, at most: of a block of 64 some bits are stored


def read_picture(path: Path, where: str) -> StoredPicture:
    """Read a picture as it is stored, upright. Raises InputError that begins with `where`."""
    first, *others = _read(path, where, PICTURES, most=2)
    if others:
        raise InputError(f"{where}: {several(path, 'pictures')}")
    return first


def read_frames_of(path: Path, where: str) -> list[StoredPicture]:
    """Read the frames of a camera in a file: a picture, the pages of a TIFF, or a (frames, rows, columns) array.

    Raises InputError as `read_picture` does, and for JPEG, whose numbers are not the sensor's.
    """
    return _read(path, where, FRAMES)


def _read(path: Path, where: str, readers: Mapping[str, Reader], most: int | None = None) -> list[StoredPicture]:
    """Read pictures, at most `most`, by the reader of a format, whose exceptions say that the file is damaged."""
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{where}: expected a PNG, TIFF, EXR or NPY file, got {path}")
    try:
        check_regular(path)
        with warnings.catch_warnings(action="ignore"), open_input(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            check_memory(2 * size, f"{path}: to read it", "take a smaller file, or free some memory")
            pictures = list(islice(reader(stream, path), most))
        if not pictures:
            raise ValueError("it holds none")
        return pictures
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except Exception as error:  # every decoder has exceptions of its own
        reason = shortened((isinstance(error, OSError) and error.strerror) or str(error)) or type(error).__name__
        raise InputError(
            f"{where}: {path} could not be read as a picture ({reason}); name a sound PNG, TIFF, EXR or NPY file"
        ) from error


def _png(stream: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    """Read what the file says by Pillow, and its pixels by libpng: Pillow yields the upper bytes of 16-bit colour.

    Pillow's class of PNG is used itself, as `Image.open` has a limit of its own for the number of pixels.
    """
    import imagecodecs
    from PIL.PngImagePlugin import PngImageFile

    data = stream.read()
    stream.seek(0)
    with PngImageFile(stream) as opened:
        described, info = cast(Any, opened), cast(dict[str, Any], opened.info)
        if described.n_frames - bool(described.default_image) > 1:
            raise several(path, "frames")
        is_palette = opened.mode == "P"
        channels = MOST_COLOURS if is_palette else len(opened.getbands()) + ("transparency" in info)
        check_size(path, prod(opened.size) * channels)
        opened.load()  # what stands behind the pixels, too
        if is_palette and described.getextrema()[1] >= len(described.palette.palette) // len("RGB"):
            raise ValueError("it has colours that its palette lacks")  # black, by libpng
        orientation = _orientation(opened)
    with silenced():
        pixels = np.asarray(cast(Any, imagecodecs).png_decode(data))
    bits = data[24]  # per number: of the header, which comes first
    is_scaled = bits < 8 and not is_palette
    if is_scaled:
        grey = pixels if pixels.ndim == 2 else pixels[..., 0]  # before its transparency
        grey //= np.uint8(255 // (2**bits - 1))  # libpng scales them to 8 bits
    profile = b"cICP" if b"cICP" in data[: data.find(b"IDAT")] else info.get("icc_profile") or b""
    notes = (("has a palette: its colours are looked up",) if is_palette else ()) + profile_notes(profile)
    gamma = None if "srgb" in info or profile else info.get("gamma")
    if gamma is not None and min(abs(gamma - usual) for usual in (LINEAR, USUAL)) >= 0.01:
        notes += (f"states a gamma of {gamma:.4g}, which is not applied: its values are used as they are",)
    yield upright(StoredPicture(pixels, bits if is_scaled else None, notes), orientation)


def _jpeg(stream: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    from PIL.JpegImagePlugin import jpeg_factory

    data = stream.read()
    stream.seek(0)
    with jpeg_factory(stream) as opened:
        if getattr(opened, "n_frames", 1) > 1:
            raise several(path, "pictures")
        if opened.mode not in ("L", "RGB"):
            inks = "inks (CMYK)" if opened.mode == "CMYK" else f"mode {opened.mode}"
            raise InputError(f"{path}: expected grey or RGB, got {inks}; save it as RGB")
        check_size(path, prod(opened.size) * len(opened.getbands()))
        if prod(opened.size) > DENSEST * len(data) or data.count(SCAN) > MOST_SCANS:
            raise ValueError("it is cut short, or has too many scans")
        notes = profile_notes(cast(dict[str, Any], opened.info).get("icc_profile") or b"")
        yield upright(StoredPicture(np.asarray(opened), notes=notes), _orientation(opened))


def _orientation(opened: Any) -> int:
    """Return the orientation that EXIF data state; 1, upright, if they state none or are damaged."""
    with suppress(Exception):  # Pillow has many for damaged data
        return int(opened.getexif().get(ORIENTATION_TAG, UPRIGHT))
    return UPRIGHT


def _png_or_jpeg(stream: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    """Read a PNG or JPEG file; their names are often exchanged."""
    is_jpeg = stream.read(3) == JPEG_SIGNATURE
    stream.seek(0)
    yield from _jpeg(stream, path) if is_jpeg else _png(stream, path)


def _exr(_: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    yield exr.read_picture(path)  # the library opens files by their names


def _npy(_: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    pixels = npz.array(path)
    check_size(path, pixels.size)
    # A last axis of up to four is colours; a sensor has more columns.
    several_frames = pixels.ndim == 3 and pixels.shape[2] > MOST_COLOURS
    yield from map(StoredPicture, pixels if several_frames else [pixels])


Reader = Callable[[BinaryIO, Path], Iterator[StoredPicture]]
FRAMES: dict[str, Reader] = {".png": _png, ".tif": tiff.pages, ".tiff": tiff.pages, ".exr": _exr, ".npy": _npy}
PICTURES: dict[str, Reader] = {**FRAMES, **dict.fromkeys((".png", ".jpg", ".jpeg"), _png_or_jpeg)}
