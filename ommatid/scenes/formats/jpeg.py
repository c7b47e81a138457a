"""JPEG pictures, grey or RGB, upright."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ommatid.runtime.errors import InputError

from .stored_picture import StoredPicture, any_size, check_single, check_size, orientation_of, profile_notes, upright

SIGNATURE = b"\xff\xd8\xff"
SCAN = b"\xff\xda"  # marker of a scan; a file with many of them is decoded as often
MOST_SCANS = 500
DENSEST = 1024  # pixels per byte, at most: of a block of 64 some bits are stored


def read(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read a picture. Raises InputError for inks, several pictures and too large ones, Pillow's errors for damage."""
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
