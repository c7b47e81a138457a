"""OpenEXR files with float32 channels and one JSON attribute; the only module that imports OpenEXR.

It works around defects of the library, which writes non-contiguous arrays wrongly, loses lists in headers, does not
report a full disk when little is written, and reads a truncated file as a shorter one.
"""

# pyright: basic
from __future__ import annotations

import errno
import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest, fingerprint, write_whole
from ommatid.runtime.input_files import check_regular, parse_json
from ommatid.runtime.machine import check_memory
from ommatid.runtime.printable import printable

from .stored_picture import BYTES, StoredPicture, several, silenced

ATTRIBUTE = "ommatid"
TWICE = 2 * 4  # bytes of a number: the library's copy and the array here


@dataclass(frozen=True)
class Part:
    """One image of a file: (rows, columns) arrays by channel name, and a record in JSON's types."""

    name: str
    channels: dict[str, NDArray[np.float32]]
    record: dict[str, Any]


def write(path: Path, parts: Sequence[Part]) -> None:
    """Write the parts, each with a SHA-256 of its pixels and one of its record, and check that they can be read.

    Raises InputError for a folder that does not exist, MachineError for a full disk.
    """
    import OpenEXR

    height = max(next(iter(part.channels.values())).shape[0] for part in parts)
    width = max(next(iter(part.channels.values())).shape[1] for part in parts)
    window = (np.zeros(2, np.int32), np.array([width - 1, height - 1], np.int32))
    files: list[Any] = []
    for part in parts:
        channels = {name: np.ascontiguousarray(pixels, dtype=np.float32) for name, pixels in part.channels.items()}
        record = {**part.record, "parts": len(parts), "sha256": _seal(channels)}
        record["seal"] = fingerprint(record)
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "displayWindow": window,  # OpenEXR requires the same one for all parts
            ATTRIBUTE: json.dumps(record),
        }
        files.append(OpenEXR.Part(header, channels, name=part.name))

    def fill(beside: Path) -> None:
        try:
            with silenced():
                OpenEXR.File(files).write(str(beside))
            if len(read(beside)) != len(parts):
                raise InputError("parts are missing")
        except (RuntimeError, InputError) as error:
            raise OSError(errno.ENOSPC, "not all of it could be stored") from error

    write_whole(path, fill)


def read(path: Path) -> list[Part]:
    """Read a file that `write` made. Raises InputError if it is missing, cut short, altered or another kind of EXR."""
    parts = [_checked(path, part) for part in _parts(path, TWICE)]
    expected = parts[0].record.get("parts") if parts else "1 or more"
    if len(parts) != expected:
        raise InputError(f"{path}: expected {expected} parts, got {len(parts)}; the file is cut short, make it again")
    return parts


def read_first_record(path: Path) -> dict[str, Any]:
    """Return the record of the first part, without its pixels. Raises InputError for a file that `write` did not make.

    Whether the pixels are whole is not checked.
    """
    parts = _parts(path)
    if not parts:
        raise InputError(f"{path}: expected an OpenEXR file that ommatid wrote, got one without parts")
    return _checked_record(path, parts[0])[0]


def read_picture(path: Path) -> StoredPicture:
    """Read Y, or R, G and B, of an OpenEXR picture, and A if it has one.

    Raises InputError for several parts, for deep and subsampled pictures, and for pictures whose display window is not
    the stored one.
    """
    parts = _parts(path)
    if len(parts) > 1:
        raise several(path, "parts")
    stored = [channel.name for channel in parts[0].header["channels"]] if parts else []
    grey, colours = "Y" in stored, {"R", "G", "B"} <= set(stored)
    if grey == colours:
        names = printable(", ".join(stored), longest=100)
        raise InputError(f"{path} has channels {names}; expected Y, or R, G and B, not both")
    header = parts[0].header
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise InputError(
            f"{path}: expected a picture that is stored whole, got a display window and a data window that differ;"
            " save it with equal windows"
        )
    used = [*("Y" if grey else "RGB"), *("A" if "A" in stored else "")]
    channels = {name: channel for part in _parts(path, BYTES) for name, channel in part.channels.items()}
    pixels = [np.asarray(channels[name].pixels) for name in used if name in channels]
    rows, columns = _extent(header)
    if [values.shape for values in pixels] != [(rows, columns)] * len(used):
        raise InputError(f"{path}: expected {rows} x {columns} values of every channel, got fewer; make the file again")
    unused = printable(", ".join(name for name in stored if name not in used), longest=100)
    notes = (f"has channels that are not used: {unused}",) if unused else ()
    return StoredPicture(pixels[0] if len(pixels) == 1 else np.stack(pixels, axis=-1), notes=notes)


def _extent(header: Any) -> tuple[int, int]:
    """Rows and columns that a header states."""
    (left, top), (right, bottom) = ((int(corner[0]), int(corner[1])) for corner in header["dataWindow"])
    return bottom - top + 1, right - left + 1


def _parts(path: Path, bytes_each: int = 0) -> list[Any]:
    """Parts of a file as the library reads them; headers alone unless `bytes_each`, of memory per number, is given.

    Raises InputError for a file that the library cannot read, a deep one, and one that does not fit into memory.
    """
    import OpenEXR

    try:
        check_regular(path)
        with silenced():
            parts = list(OpenEXR.File(str(path), separate_channels=True, header_only=True).parts)
        if any("deep" in str(part.header.get("type")) for part in parts):
            raise InputError(f"{path}: expected one value per pixel and channel, got a deep picture; save it flat")
        if not bytes_each:
            return parts
        numbers = sum(prod(_extent(part.header)) * len(part.header["channels"]) for part in parts)
        check_memory(bytes_each * numbers, f"{path}: to read it", "take a smaller one, or free some memory")
        with silenced():
            return list(OpenEXR.File(str(path), separate_channels=True).parts)
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except Exception as error:  # the library has many for damaged files
        raise InputError(
            f"{path}: expected an OpenEXR file, got one that cannot be read ({printable(error, longest=100)})"
        ) from error


def _checked(path: Path, part: Any) -> Part:
    name = str(part.header.get("name", ""))
    record, seal = _checked_record(path, part)
    try:
        channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in part.channels.items()}
    except (ValueError, TypeError) as error:
        raise InputError(_altered(path, name)) from error
    if not channels or _seal(channels) != seal:
        raise InputError(_altered(path, name))
    return Part(name, channels, record)


def _checked_record(path: Path, part: Any) -> tuple[dict[str, Any], str]:
    """Return the record of a part and the SHA-256 of its pixels."""
    name, attribute = part.header.get("name", ""), part.header.get(ATTRIBUTE)
    where = f"{path}: part '{name}'"
    if not isinstance(attribute, str):
        raise InputError(f"{where} has no attribute '{ATTRIBUTE}'; expected a file that ommatid wrote")
    try:
        record = parse_json(attribute)
        seal = record.pop("seal")
        intact = fingerprint(record) == seal
        pixels = record.pop("sha256")
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise InputError(f"{where} has a damaged attribute '{ATTRIBUTE}'; make the file again") from error
    if not intact:
        raise InputError(_altered(path, name))
    return record, pixels


def _altered(path: Path, name: str) -> str:
    return f"{path}: part '{name}' does not match its checksum; the file is cut short or altered, make it again"


def _seal(channels: dict[str, NDArray[np.float32]]) -> str:
    """SHA-256 of all channels."""
    return digest(*(channels[name] for name in sorted(channels)))
