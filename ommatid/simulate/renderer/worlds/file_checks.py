"""Files that Mitsuba's plugins read, checked before Mitsuba maps them: sizes, indices and finite positions.

Messages of these errors name the file; the caller names the place in the world.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from struct import unpack

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import check_regular, open_input
from ommatid.runtime.memory import check_memory
from ommatid.runtime.printable import printable

from .mesh_files import check_obj, check_serialized
from .picture_sizes import picture_size
from .ply_file import check_ply
from .world_xml import SHOWN

PIXEL = 3 * 16  # bytes that Mitsuba takes per pixel of a picture: colours as floats, and copies
LARGEST = {"spectrum": 64_000_000, "regular": 64_000_000, "irregular": 64_000_000}
VOLUMES = ("gridvolume", "sdfgrid")
PICTURES = ("bitmap", "envmap", "projector")


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
