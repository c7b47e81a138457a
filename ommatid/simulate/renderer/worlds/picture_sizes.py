"""Width and height of the pictures that Mitsuba reads, from their headers alone."""

from __future__ import annotations

import re
from struct import unpack
from typing import BinaryIO

START = 65_536  # bytes of a header; longer ones are not needed
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of JPEG that state a size
TGA = (1, 2, 3, 9, 10, 11)  # kinds of picture
_TEXT = re.compile(rb"\A(?:P[56FfPZ]|P)\w?\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s")
_RADIANCE = re.compile(rb"\n[-+]Y (\d{1,9}) \+X (\d{1,9})\n")
_WINDOW = b"dataWindow\0box2i\0\x10\0\0\0"


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
