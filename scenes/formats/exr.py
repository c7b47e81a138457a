"""OpenEXR files with float32 channels and one JSON attribute; the only module that imports OpenEXR.

It works around defects of the library, which writes non-contiguous arrays wrongly, loses lists in headers, does not
report a full disk when little is written, and reads a truncated file as a shorter one.
"""

# pyright: basic
from __future__ import annotations

import errno
import io
import json
import os
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest, fingerprint, write_whole
from ommatid.runtime.memory import check_memory

ATTRIBUTE = "ommatid"


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
            with _silenced():
                OpenEXR.File(files).write(str(beside))
            if len(read(beside)) != len(parts):
                raise InputError("parts are missing")
        except (RuntimeError, InputError) as error:
            raise OSError(errno.ENOSPC, "not all of it could be stored") from error

    write_whole(path, fill)


def read(path: Path) -> list[Part]:
    """Read a file that `write` made. Raises InputError if it is missing, cut short, altered or another kind of EXR."""
    parts = [_checked(path, name, channels, attribute) for name, channels, attribute in _open(path)]
    expected = parts[0].record.get("parts") if parts else "1 or more"
    if len(parts) != expected:
        raise InputError(f"{path}: expected {expected} parts, got {len(parts)}; the file is cut short, make it again")
    return parts


def read_first_record(path: Path) -> dict[str, Any]:
    """Return the record of the first part, without its pixels. Raises InputError for a file that `write` did not make.

    Whether the pixels are whole is not checked.
    """
    parts = _open(path, header_only=True)
    if not parts:
        raise InputError(f"{path}: expected an OpenEXR file that ommatid wrote, got one without parts")
    return _checked_record(path, parts[0][0], parts[0][2])[0]


def read_channels(path: Path) -> dict[str, NDArray[np.float32]]:
    """The channels of the first part of any OpenEXR picture. Raises InputError if it cannot be read."""
    parts = _open(path)
    if not parts or not parts[0][1]:
        raise InputError(f"{path}: expected an OpenEXR picture, got a file without complete channels")
    return parts[0][1]


def _open(path: Path, header_only: bool = False) -> list[tuple[str, dict[str, NDArray[np.float32]], str | None]]:
    """Name, channels and JSON attribute of each part. Raises InputError if the file cannot be read."""
    import OpenEXR

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with _silenced():
            if not header_only:
                check_memory(_declared_size(path), f"{path}: to read it", "take a smaller one, or free some memory")
            file = OpenEXR.File(str(path), separate_channels=True, header_only=header_only)
        return [
            (
                str(part.header.get("name", "")),
                {}
                if header_only
                else {name: np.asarray(channel.pixels, np.float32) for name, channel in part.channels.items()},
                part.header.get(ATTRIBUTE),
            )
            for part in file.parts
        ]
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected an OpenEXR file, got one that cannot be read ({error})") from error


def _declared_size(path: Path) -> int:
    """Bytes of all channels by the headers, twice: for the library's copy and for the arrays here."""
    import OpenEXR

    total = 0
    for part in OpenEXR.File(str(path), separate_channels=True, header_only=True).parts:
        first, last = part.header["dataWindow"]
        columns, rows = (int(high) - int(low) + 1 for low, high in zip(first, last, strict=True))
        total += 2 * 4 * rows * columns * len(part.header["channels"])
    return total


def _checked(path: Path, name: str, channels: dict[str, NDArray[np.float32]], attribute: str | None) -> Part:
    record, pixels = _checked_record(path, name, attribute)
    if not channels or _seal(channels) != pixels:
        raise InputError(_altered(path, name))
    return Part(name, channels, record)


def _checked_record(path: Path, name: str, attribute: str | None) -> tuple[dict[str, Any], str]:
    """Return the record of a part and the SHA-256 of its pixels."""
    where = f"{path}: part '{name}'"
    if not isinstance(attribute, str):
        raise InputError(f"{where} has no attribute '{ATTRIBUTE}'; expected a file that ommatid wrote")
    try:
        record = json.loads(attribute)
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


@contextmanager
def _silenced() -> Generator[None]:
    """Discard the library's warnings on stdout and stderr; errors are reported by exceptions."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        os.dup2(null, 2)
        with redirect_stdout(io.StringIO()):  # some warnings pass through Python's sys.stdout
            yield
    finally:
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for descriptor in (*saved, null):
            os.close(descriptor)
