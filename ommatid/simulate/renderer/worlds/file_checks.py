"""Files that Mitsuba's plugins read, checked before Mitsuba maps them: sizes, indices and finite positions.

The size of a picture follows from its header alone. Messages of these errors name the file; the caller names the place
in the world.
"""

from __future__ import annotations

import re
from math import prod
from pathlib import Path
from struct import unpack
from typing import BinaryIO

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import check_regular, open_input
from ommatid.runtime.memory import check_memory
from ommatid.runtime.printable import printable

from .mesh_files import check_obj, check_ply, check_serialized

SHOWN = 80  # characters of a name in messages
PIXEL = 3 * 16  # bytes that Mitsuba takes per pixel of a picture: colours as floats, and copies
LARGEST = {"spectrum": 64_000_000, "regular": 64_000_000, "irregular": 64_000_000}
VOLUMES = ("gridvolume", "sdfgrid")
PICTURES = ("bitmap", "envmap", "projector")
START = 65_536  # bytes of a header; longer ones are not needed
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of JPEG that state a size
TGA = (1, 2, 3, 9, 10, 11)  # kinds of picture
_TEXT = re.compile(rb"\A(?:P[56FfPZ]|P)\w?\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s")
_RADIANCE = re.compile(rb"\n[-+]Y (\d{1,9}) \+X (\d{1,9})\n")
_WINDOW = b"dataWindow\0box2i\0\x10\0\0\0"


def check_named_file(path: Path, plugin: str) -> None:
    """Check a file that a plugin reads. Raises InputError, ValueError, and OSError for one that cannot be read."""
    check_regular(path)
    if plugin == "ply":
        check_ply(path)
    elif plugin == "obj":
        check_obj(path)
    elif plugin == "serialized":
        check_serialized(path)
    elif plugin in PICTURES:
        _check_picture(path)
    elif plugin in VOLUMES:
        _check_volume(path)
    elif path.stat().st_size > LARGEST.get(plugin, 2**40):
        raise InputError(f"{printable(path)}: expected at most {LARGEST[plugin] / 1e6:g} MB; shorten it")


def _check_picture(path: Path) -> None:
    shown = printable(path)
    with open_input(path) as stream:
        size = picture_size(stream, path.stat().st_size)
    if size is None:
        raise InputError(f"{shown}: expected a PNG, JPEG, EXR, HDR, PFM, PPM, BMP or TGA picture, got something else")
    width, height = size
    if width < 1 or height < 1:
        raise InputError(f"{shown}: expected a picture of at least 1 x 1 pixel, got {width} x {height}")
    check_memory(width * height * PIXEL, f"{shown}: a picture of {width} x {height} pixels", "make it smaller")


def _check_volume(path: Path) -> None:
    shown, header = printable(path), 48
    with open_input(path) as stream:
        start = stream.read(header)
    if len(start) < header or start[:3] != b"VOL":
        raise InputError(f"{shown}: expected a volume in Mitsuba's format (VOL), got something else")
    version, data_type, *sizes = start[3], *unpack("<5i", start[4:24])
    if version != 3 or data_type != 1:
        raise InputError(f"{shown}: expected a volume of version 3 with float32, got version {version}")
    needed = header + 4 * prod(sizes)
    if min(sizes) < 1 or max(sizes) > 2**24 or needed > path.stat().st_size:
        words = printable(" x ".join(map(str, sizes)), SHOWN)
        raise InputError(f"{shown}: states {words} values, expected as many as the file holds")
    check_memory(4 * needed, f"{shown}: a volume of {printable(sizes, SHOWN)} values", "make it smaller")


def picture_size(stream: BinaryIO, size: int) -> tuple[int, int] | None:
    """Return width and height of a picture; None if it is none that Mitsuba reads.

    size : of the file, bytes
    """
    start = stream.read(START)
    if start[:8] == b"\x89PNG\r\n\x1a\n" and len(start) >= 24:
        width, height = unpack(">II", start[16:24])
        return width, height
    if start[:2] == b"\xff\xd8":
        return _jpeg(stream, size)
    if start[:4] == b"\x76\x2f\x31\x01":
        at = start.find(_WINDOW)
        if at < 0 or len(start) < at + len(_WINDOW) + 16:
            return None
        left, top, right, bottom = unpack("<4i", start[at + len(_WINDOW) : at + len(_WINDOW) + 16])
        return right - left + 1, bottom - top + 1
    if start[:2] == b"#?":
        found = _RADIANCE.search(start)
        return None if found is None else (int(found[2]), int(found[1]))
    if start[:2] == b"BM" and len(start) >= 26:
        width, height = unpack("<ii", start[18:26])
        return width, abs(height)
    found = _TEXT.match(start) if start[:2] in (b"P5", b"P6", b"PF", b"Pf") else None
    if found is not None:
        return int(found[1]), int(found[2])
    if len(start) >= 18 and start[2] in TGA and start[1] < 2 and start[16] in (8, 15, 16, 24, 32):
        width, height = unpack("<HH", start[12:16])
        return width, height
    return None


def _jpeg(stream: BinaryIO, size: int) -> tuple[int, int] | None:
    at = 2
    while at + 9 < size:
        stream.seek(at)
        head = stream.read(9)
        if len(head) < 9 or head[0] != 0xFF:
            return None
        if head[1] in FRAMES:
            height, width = unpack(">HH", head[5:9])
            return width, height
        at += 1 if head[1] == 0xFF else 2 + max(unpack(">H", head[2:4])[0], 2)
    return None
