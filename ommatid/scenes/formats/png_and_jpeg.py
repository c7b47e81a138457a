"""PNG pictures with all of their bits, and JPEG pictures, grey or RGB, upright.

Pillow reads both. Of a PNG of 16-bit colour it yields the upper bytes alone, and it scales 1, 2 and 4 bits to 8: such
pixel data are decoded in another of its raw modes.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

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
    """Read a PNG file. Raises InputError for several frames and too large a picture, Pillow's errors for damage."""
    from PIL import Image

    size = stream.seek(0, io.SEEK_END)
    with any_size(), Image.open(stream, formats=("PNG",)) as opened:
        described = cast(Any, opened)
        check_single(path, described.n_frames - bool(described.default_image), "frames")
        (_, _, place, raw) = described.tile[0]
        kind, _, depth = raw.partition(";")
        bits = 1 if kind == "1" else BITS[depth]
        numbers = opened.size[0] * opened.size[1] * CHANNELS[kind]
        check_size(path, numbers * (2 if kind == "P" else 1), 2 * size)
        if numbers * bits // 8 > MOST_DEFLATED * size:
            raise ValueError("its pixel data are cut short")
        opened.verify()  # the checksums; those of pixel data are skipped otherwise
    stream.seek(0)
    codes_colours = b"cICP" in stream.read(min(place, LONGEST_HEADER))
    decoded = _decoded(stream, kind, depth)
    pixels, notes = _coloured(kind, decoded)
    info = decoded.info
    profile = b"cICP" if codes_colours else info.get("icc_profile", b"") or b""
    gamma = None if "srgb" in info or profile else info.get("gamma")
    picture = StoredPicture(
        pixels,
        bits if bits < 8 and kind != "P" else None,
        (*notes, *profile_notes(profile), *gamma_notes(gamma)),
    )
    return upright(picture, orientation_of(info.get("exif", b"")))


class _Decoded(NamedTuple):
    """Pixels, (rows, columns[, samples]), what the file says of them, and its palette."""

    pixels: NDArray[Any]
    info: dict[str, Any]
    palette: bytes


def _decoded(stream: BinaryIO, kind: str, depth: str) -> _Decoded:
    """Inflate and filter pixel data to uint8 or uint16, without scaling."""
    if depth == "16B" and kind in ("RGB", "RGBA"):
        found, lower = _loaded(stream, f"{kind};16B"), _loaded(stream, f"{kind};16L").pixels
        return found._replace(pixels=(found.pixels.astype(np.uint16) << 8) | lower)
    if depth == "16B" and kind == "LA":
        found = _loaded(stream, "RGBA")  # as many bytes, as they are
        return found._replace(pixels=np.ascontiguousarray(found.pixels).view(">u2").astype(np.uint16))
    found = _loaded(stream)
    if kind == "1":
        return found._replace(pixels=found.pixels.astype(np.uint8))
    if kind == "L" and depth:
        return found._replace(pixels=found.pixels // np.uint8(255 // (2 ** BITS[depth] - 1)))
    return found


def _loaded(stream: BinaryIO, raw: str | None = None) -> _Decoded:
    """Let Pillow decode a file, in a raw mode other than its own if one is given."""
    from PIL import Image

    stream.seek(0)
    with any_size(), Image.open(stream, formats=("PNG",)) as opened:
        described = cast(Any, opened)
        palette = bytes(described.palette.palette) if described.palette else b""
        if raw is not None:
            described.tile = [(*described.tile[0][:3], raw)]
        return _Decoded(np.asarray(opened), described.info, palette)


def _coloured(kind: str, decoded: _Decoded) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Look up the palette, and add the transparency that a file states for single colours or entries."""
    samples, palette, transparent = decoded.pixels, decoded.palette, decoded.info.get("transparency")
    if kind == "P":
        table = np.frombuffer(palette, np.uint8)[: len(palette) // 3 * 3].reshape(-1, 3)
        if int(samples.max()) >= len(table):
            raise ValueError("its palette is too short")
        opaque = np.full(len(table), 255, np.uint8)
        if isinstance(transparent, bytes):
            opaque[: len(transparent)] = np.frombuffer(transparent, np.uint8)[: len(table)]
        elif transparent is not None and transparent < len(table):
            opaque[transparent] = 0
        is_grey = bool((table == table[:, :1]).all())
        pixels, alpha = (table[:, 0] if is_grey else table)[samples], opaque[samples]
        notes = ("has a palette: its colours are looked up",)
    elif transparent is not None:
        key = transparent > 0 if kind == "1" else transparent
        hidden = samples == key if samples.ndim == 2 else (samples == np.array(key)).all(axis=-1)
        pixels, alpha, notes = samples, np.where(hidden, 0, 255).astype(samples.dtype), ()
    else:
        return samples, ()
    return (pixels if bool((alpha == 255).all()) else np.dstack([pixels, alpha])), notes


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
