"""PNG pictures with all of their bits, and JPEG pictures, grey or RGB, upright.

Pillow reads what the files say of their pixels, and the pixels of JPEG. Those of PNG come from libpng (imagecodecs), as
Pillow yields of 16-bit colour the upper bytes alone.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ommatid.runtime.errors import InputError

from .stored_picture import (
    StoredPicture,
    any_size,
    check_single,
    check_size,
    gamma_notes,
    orientation_of,
    profile_notes,
    upright,
)

CHANNELS = {"1": 1, "L": 1, "I": 1, "P": 1, "LA": 2, "RGB": 3, "RGBA": 4}  # by the first part of a raw mode
BITS = {"": 8, "1": 1, "2": 2, "4": 4, "16B": 16}  # by the second part
MOST_DEFLATED = 1032  # largest ratio of inflated to deflated bytes
LONGEST_HEADER = 1 << 20  # bytes before the pixels in which a coding of colours is looked for


def read_png(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read a PNG file. Raises InputError for several frames and too large a picture, others for damage."""
    import imagecodecs
    from PIL import Image

    size = stream.seek(0, io.SEEK_END)
    with any_size(), Image.open(stream, formats=("PNG",)) as opened:
        described = cast(Any, opened)
        check_single(path, described.n_frames - bool(described.default_image), "frames")
        (_, _, place, raw) = described.tile[0]
        kind, _, depth = raw.partition(";")
        bits = 1 if kind == "1" else BITS[depth]
        numbers = opened.size[0] * opened.size[1] * CHANNELS[kind]
        check_size(path, numbers * (4 if kind == "P" else 1), 2 * size)
        if numbers * bits // 8 > MOST_DEFLATED * size:
            raise ValueError("its pixel data are cut short")
        opened.load()  # what stands behind the pixels, too
        info = cast(dict[str, Any], described.info)
    stream.seek(0)
    data = stream.read()
    pixels = np.asarray(cast(Any, imagecodecs).png_decode(data))
    few, is_palette = bits < 8, kind == "P"
    if few and not is_palette:
        grey = pixels if pixels.ndim == 2 else pixels[..., 0]  # before its transparency
        grey //= np.uint8(255 // (2**bits - 1))  # libpng scales them to 8 bits
    notes = ("has a palette: its colours are looked up",) if is_palette else ()
    profile = b"cICP" if b"cICP" in data[: min(place, LONGEST_HEADER)] else info.get("icc_profile", b"") or b""
    gamma = None if "srgb" in info or profile else info.get("gamma")
    notes = (*notes, *profile_notes(profile), *gamma_notes(gamma))
    picture = StoredPicture(pixels, bits if few and not is_palette else None, notes)
    return upright(picture, orientation_of(info.get("exif", b"")))


JPEG_SIGNATURE = b"\xff\xd8\xff"
SCAN = b"\xff\xda"  # marker of a scan; a file with many of them is decoded as often
MOST_SCANS = 500
DENSEST = 1024  # pixels per byte, at most: of a block of 64 some bits are stored


def read_jpeg(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read a JPEG file. Raises InputError for inks, several pictures and too large ones, Pillow's errors for damage."""
    from PIL import Image

    size = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    with any_size(), Image.open(stream, formats=("JPEG",)) as opened:
        check_single(path, int(getattr(opened, "n_frames", 1)), "pictures")
        if opened.mode not in ("L", "RGB"):
            inks = "inks (CMYK)" if opened.mode == "CMYK" else f"mode {opened.mode}"
            raise InputError(f"{path}: expected grey or RGB, got {inks}; save it as RGB")
        numbers = opened.size[0] * opened.size[1]
        check_size(path, numbers * len(opened.getbands()), size)
        if numbers > DENSEST * size:
            raise ValueError("it is cut short")
        _check_scans(stream)
        pixels = np.asarray(opened)
        info = cast(dict[str, Any], opened.info)
    profile, exif = info.get("icc_profile") or b"", info.get("exif") or b""
    return upright(StoredPicture(pixels, notes=profile_notes(profile)), orientation_of(exif))


def _check_scans(stream: BinaryIO) -> None:
    """Raise ValueError if a file has more scans than any encoder writes. The position in the stream is kept."""
    position = stream.tell()
    stream.seek(0)
    scans = 0
    while block := stream.read(1 << 20):
        scans += block.count(SCAN)
    stream.seek(position)
    if scans > MOST_SCANS:
        raise ValueError(f"it has {scans} scans")
