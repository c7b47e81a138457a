"""Files that Mitsuba's plugins read, checked before Mitsuba maps them: meshes, and the size of spectra.

Mitsuba maps the indices of meshes without a check, so that one beyond the vertices reads foreign memory. All other
files are read first in a process with limits, which may die of them (`trial`).
"""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from struct import unpack
from typing import Any, BinaryIO

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import check_regular, open_input
from ommatid.runtime.memory import check_memory
from ommatid.runtime.printable import printable

SHOWN = 80  # characters of a name in messages
LARGEST = {"spectrum": 64_000_000, "regular": 64_000_000, "irregular": 64_000_000}
LONGEST_LINE = 10_000
MOST_LINES = 1000  # of a header of PLY
FARTHEST = 1e30  # of a vertex
INDICES = ("vertex_index", "vertex_indices")
FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "half": "f2", "long": "i8", "ulong": "u8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float16": "f2", "float32": "f4", "float64": "f8"},
}
MOST_MESHES = 100_000  # of a serialized file
DENSEST = 1100  # bytes that a byte of zlib becomes at most, rounded up
SERIALIZED, VERSIONS = 0x041C, (3, 4)
NORMALS, TEXTURED, COLOURED, DOUBLE = 0x1, 0x2, 0x8, 0x2000  # flags


def check_named_file(path: Path, plugin: str) -> None:
    """Check a file that a plugin reads. Raises InputError that names it, and OSError for one that cannot be read."""
    check_regular(path)
    shown, size = printable(path), path.stat().st_size
    if size > LARGEST.get(plugin, 2**40):
        raise InputError(f"{shown}: expected at most {LARGEST.get(plugin, 2**40) / 1e6:g} MB; shorten it")
    if plugin not in MESHES:
        return
    try:
        with open_input(path) as stream:
            MESHES[plugin](stream, size)
    except InputError:
        raise
    except (ValueError, zlib.error) as error:
        raise InputError(f"{shown}: is no sound mesh ({printable(error, 2 * SHOWN)}); correct it") from error


def _check_obj(stream: BinaryIO, size: int) -> None:
    """Check an OBJ mesh, line by line. Raises ValueError."""
    check_memory(8 * size, "a mesh", "make it smaller")
    counts, faces, number = {b"v": 0, b"vt": 0, b"vn": 0}, 0, 0
    while line := stream.readline(LONGEST_LINE + 1):
        number += 1
        kind, *words = line.split() or [b""]
        reason = ""
        if len(line) > LONGEST_LINE or b"\0" in line:
            reason = f"text of at most {LONGEST_LINE} characters a line, got more"
        elif kind in counts:
            reason = _wrong_numbers(words[:3], 2 if kind == b"vt" else 3)
            counts[kind] += 1
        elif kind == b"f":
            reason = _wrong_face(words, counts)
            faces += 1
        if reason:
            raise ValueError(f"line {number}: expected {reason}")
    if not faces:
        raise ValueError("expected vertices and faces, got no face")


def _wrong_numbers(words: list[bytes], least: int) -> str:
    """Return what was expected of the numbers of a vertex, a place in a texture or a normal, "" if they are so."""
    try:
        correct = len(words) >= least and isfinite(sum(map(float, words[:least])))
    except ValueError:
        correct = False
    return "" if correct else f"{least} finite numbers"


def _wrong_face(words: list[bytes], counts: dict[bytes, int]) -> str:
    """Return what was expected of the indices of a face, "" if they are so."""
    if len(words) < 3:
        return f"a face of three or more vertices, got {len(words)}"
    for word in words:
        for index, (kind, count) in zip(word.split(b"/"), counts.items(), strict=False):
            if index and not (index.isdigit() and len(index) < 12 and 1 <= int(index) <= count):
                return f"indices from 1 to {count} of the lines '{kind.decode()}' before it"
    return ""


@dataclass
class _PlyElement:
    """An element of a PLY file: so many rows of these fields."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=lambda: list[tuple[str, str]]())
    lists: list[str] = field(default_factory=lambda: list[str]())

    def dtype(self, order: str) -> np.dtype[Any]:
        """Return the type of a row in a binary file."""
        return np.dtype([(name, order + kind) for name, kind in self.fields])


def _check_ply(stream: BinaryIO, size: int) -> None:
    """Check a PLY mesh of triangles: the counts of its header against its size, and its indices. Raises ValueError."""
    order, elements = _header(stream)
    for row in elements:
        if row.count * (2 * len(row.fields) if order == "=" else row.dtype(order).itemsize) > size - stream.tell() + 1:
            raise ValueError(f"states {row.count} rows of '{row.name}', more than it holds")
    needed = 2 * (size if order == "=" else max(row.count * row.dtype(order).itemsize for row in elements))
    check_memory(needed, "a mesh", "make it smaller")
    numbers = _numbers(stream) if order == "=" else None
    start, vertices = 0, 0
    for row in elements:
        columns, start = _columns(row, order, stream, numbers, start)
        if row.name == "vertex":
            vertices = row.count
            for name, values in columns.items():
                if name.partition(" ")[2] in ("x", "y", "z"):
                    _check_positions(values.astype(np.float64))
        _check_triangles(row, columns, vertices)


def _header(stream: BinaryIO) -> tuple[str, list[_PlyElement]]:
    order, elements = "", list[_PlyElement]()
    for number in range(MOST_LINES):
        line = stream.readline(MOST_LINES)
        words = line.decode("latin-1").split()
        if not line.endswith(b"\n") or (number == 0 and words != ["ply"]):
            raise ValueError("expected a header of PLY up to 'end_header'")
        if words == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) == 3 and words[1] in FORMATS and not order:
            order = FORMATS[words[1]]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(_PlyElement(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            _add_property(elements[-1], words)
        elif number and words and words[0] not in ("comment", "obj_info"):
            raise ValueError("expected a header of PLY")
    else:
        raise ValueError(f"expected a header of at most {MOST_LINES} lines")
    names = [row.name for row in elements if row.name in ("vertex", "face")]
    if not order or names != ["vertex", "face"]:
        raise ValueError("expected a format, and the elements vertex and face in a header of PLY")
    return order, elements


def _add_property(row: _PlyElement, words: list[str]) -> None:
    if len(words) == 3 and words[1] in TYPES:
        row.fields.append((f"{len(row.fields)} {words[2]}", TYPES[words[1]]))
    elif len(words) == 5 and words[1] == "list" and words[2] in TYPES and words[3] in TYPES:
        row.lists.append(words[4])
        row.fields.append((f"{len(row.fields)} count {words[4]}", TYPES[words[2]]))
        row.fields.extend((f"{len(row.fields) + i} {words[4]} {i}", TYPES[words[3]]) for i in range(3))
    else:
        raise ValueError("expected a header of PLY")


def _numbers(stream: BinaryIO) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(stream.read().decode("latin-1"), sep=" ")
        except DeprecationWarning as error:
            raise ValueError("expected numbers after the header") from error


def _columns(row: _PlyElement, order: str, stream: BinaryIO, numbers: Any, start: int) -> tuple[dict[str, Any], int]:
    """Return the columns of an element, and where the next one starts among the numbers of a text."""
    names = [name for name, _ in row.fields]
    if numbers is None:
        content = stream.read(row.count * row.dtype(order).itemsize)
        if not names or not row.count:
            return {name: np.empty(0) for name in names}, 0
        table = np.frombuffer(content, row.dtype(order), count=row.count)
        return {name: table[name] for name in names}, 0
    end = start + row.count * len(names)
    table = numbers[start:end].reshape(row.count, len(names))
    return {name: table[:, index] for index, name in enumerate(names)}, end


def _check_positions(values: Any) -> None:
    if not (np.abs(values) < FARTHEST).all():
        raise ValueError("expected finite positions of vertices")


def _check_triangles(row: _PlyElement, columns: dict[str, Any], vertices: int) -> None:
    for name, values in columns.items():
        _, _, rest = name.partition(" ")
        if rest.startswith("count ") and (values != 3).any():
            raise ValueError("expected triangles, got other faces")
        if row.name == "face" and rest.rpartition(" ")[0] in INDICES and not rest.startswith("count "):
            _check_indices(values, vertices)
    if row.name == "face" and not set(row.lists) & set(INDICES):
        raise ValueError("expected the indices of faces as a list vertex_index")


def _check_indices(values: Any, vertices: int) -> None:
    if not ((values >= 0) & (values < vertices)).all():
        raise ValueError(f"expected indices of its {vertices} vertices")


def _check_serialized(stream: BinaryIO, size: int) -> None:
    """Check all meshes of a serialized file. Raises ValueError."""
    start = stream.read(4)
    if len(start) < 4 or unpack("<HH", start)[0] != SERIALIZED or unpack("<HH", start)[1] not in VERSIONS:
        raise ValueError("expected meshes serialized by Mitsuba")
    version = unpack("<HH", start)[1]
    stream.seek(max(size - 4, 0))
    (count,) = unpack("<I", stream.read(4))
    word = 8 if version == 4 else 4
    if not 1 <= count <= MOST_MESHES or count * word + 4 > size:
        raise ValueError(f"states {count} meshes, more than it holds")
    stream.seek(size - 4 - count * word)
    offsets = np.frombuffer(stream.read(count * word), f"<u{word}").tolist()
    for offset in dict.fromkeys([0, *offsets]):
        stream.seek(min(offset, size))
        if stream.read(4)[:2] != start[:2]:
            raise ValueError(f"expected a mesh at byte {offset}")
        _check_mesh(_Inflated(stream.read(size - offset - 4)), version)


class _Inflated:
    """A compressed mesh, read from its start."""

    def __init__(self, content: bytes) -> None:
        self._left, self._inflater = content, zlib.decompressobj()
        self.most = len(content) * DENSEST

    def read(self, size: int) -> bytes:
        content = b""
        while len(content) < size and self._left and not self._inflater.eof:
            content += self._inflater.decompress(self._left, size - len(content))
            self._left = self._inflater.unconsumed_tail
        if len(content) < size:
            raise ValueError("ends within a mesh")
        return content


def _check_mesh(content: _Inflated, version: int) -> None:
    (flags,) = unpack("<I", content.read(4))
    if version == 4 and all(content.read(1) != b"\0" for _ in range(LONGEST_LINE)):
        raise ValueError("expected a shorter name of a mesh")
    vertices, faces = unpack("<QQ", content.read(16))
    wide = 8 if flags & DOUBLE else 4
    rest = wide * vertices * sum(n for flag, n in ((NORMALS, 3), (TEXTURED, 2), (COLOURED, 3)) if flags & flag)
    size = 3 * wide * vertices + rest + 12 * faces
    if vertices >= 2**32 or size > content.most:
        raise ValueError(f"states {vertices} vertices and {faces} faces, more than it holds")
    check_memory(3 * size, "a mesh", "make it smaller")
    _check_positions(np.frombuffer(content.read(3 * wide * vertices), f"<f{wide}"))
    content.read(rest)
    _check_indices(np.frombuffer(content.read(12 * faces), "<u4"), vertices)


MESHES: dict[str, Callable[[BinaryIO, int], None]] = {
    "ply": _check_ply,
    "obj": _check_obj,
    "serialized": _check_serialized,
}
