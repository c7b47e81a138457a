"""Meshes, checked before Mitsuba maps them: known vertices, finite positions, and counts that the file can hold.

Mitsuba maps indices without a check, so that one beyond the vertices reads foreign memory.
"""

from __future__ import annotations

import warnings
import zlib
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from struct import unpack
from typing import Any, BinaryIO

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input
from ommatid.runtime.memory import check_memory
from ommatid.runtime.printable import printable

LONGEST_LINE = 10_000
MOST_MESHES = 100_000  # of a serialized file
DENSEST = 1100  # bytes that a byte of zlib becomes at most, rounded up
SERIALIZED, VERSIONS = 0x041C, (3, 4)
NORMALS, TEXTURED, COLOURED, DOUBLE = 0x1, 0x2, 0x8, 0x2000  # flags
LONGEST_HEADER, MOST_HEADERS = 1000, 1000  # of a header
INDICES = ("vertex_index", "vertex_indices")
FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "half": "f2", "long": "i8", "ulong": "u8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float16": "f2", "float32": "f4", "float64": "f8"},
}


def check_obj(path: Path) -> None:
    """Check an OBJ mesh. Raises InputError that names the file, OSError if it cannot be read."""
    shown, counts, faces, number = printable(path), {b"v": 0, b"vt": 0, b"vn": 0}, 0, 0
    with open_input(path) as stream:
        check_memory(8 * path.stat().st_size, f"{shown}: a mesh", "make it smaller")
        while line := stream.readline(LONGEST_LINE + 1):
            number += 1
            kind, *words = line.split() or [b""]
            reason = ""
            if len(line) > LONGEST_LINE or b"\0" in line:
                reason = f"expected text of at most {LONGEST_LINE} characters a line, got more"
            elif kind in counts:
                reason = _wrong_numbers(words[:3], 2 if kind == b"vt" else 3)
                counts[kind] += 1
            elif kind == b"f":
                reason = _wrong_face(words, counts)
                faces += 1
            if reason:
                raise InputError(f"{shown} (line {number}): {reason}")
    if not faces:
        raise InputError(f"{shown}: expected an OBJ mesh with vertices and faces, got no face")


def _wrong_numbers(words: list[bytes], least: int) -> str:
    """Return what is wrong about the numbers of a vertex, a place in a texture or a normal, "" if nothing is."""
    try:
        correct = len(words) >= least and isfinite(sum(map(float, words[:least])))
    except ValueError:
        correct = False
    return "" if correct else f"expected {least} finite numbers, got '{printable(b' '.join(words), 80)[2:-1]}'"


def _wrong_face(words: list[bytes], counts: dict[bytes, int]) -> str:
    """Return what is wrong about the indices of a face, "" if nothing is."""
    if len(words) < 3:
        return f"expected a face of three or more vertices, got {len(words)}"
    for word in words:
        for index, (kind, count) in zip(word.split(b"/"), counts.items(), strict=False):
            if index and not (index.isdigit() and len(index) < 12 and 1 <= int(index) <= count):
                return (
                    f"expected indices from 1 to {count} of the lines '{kind.decode()}' before it,"
                    f" got {printable(index.decode('latin-1'), 40)}; correct the mesh"
                )
    return ""


def check_serialized(path: Path) -> None:
    """Check all meshes of a serialized file. Raises InputError that names the file, OSError if it cannot be read."""
    shown, size = printable(path), path.stat().st_size
    with open_input(path) as stream:
        start = stream.read(4)
        if len(start) < 4 or unpack("<HH", start)[0] != SERIALIZED or unpack("<HH", start)[1] not in VERSIONS:
            raise InputError(f"{shown}: expected meshes serialized by Mitsuba, got something else")
        version = unpack("<HH", start)[1]
        stream.seek(max(size - 4, 0))
        (count,) = unpack("<I", stream.read(4))
        word = 8 if version == 4 else 4
        if not 1 <= count <= MOST_MESHES or count * word + 4 > size:
            raise InputError(f"{shown}: states {count} meshes, more than it holds")
        stream.seek(size - 4 - count * word)
        offsets = np.frombuffer(stream.read(count * word), f"<u{word}").tolist()
        for offset in dict.fromkeys([0, *offsets]):
            if offset + 4 > size:
                raise InputError(f"{shown}: expected meshes inside the file, got one at byte {offset}")
            stream.seek(offset)
            if unpack("<HH", stream.read(4))[0] != SERIALIZED:
                raise InputError(f"{shown}: expected a mesh at byte {offset}, got something else")
            _check_mesh(_Inflated(stream.read(size - offset - 4), shown), version, shown)


class _Inflated:
    """A compressed mesh, read from its start."""

    def __init__(self, content: bytes, shown: str) -> None:
        self._left, self._inflater, self._shown = content, zlib.decompressobj(), shown
        self.most = len(content) * DENSEST

    def read(self, size: int) -> bytes:
        content = b""
        try:
            while len(content) < size and self._left and not self._inflater.eof:
                content += self._inflater.decompress(self._left, size - len(content))
                self._left = self._inflater.unconsumed_tail
        except zlib.error as error:
            raise InputError(f"{self._shown}: its compressed content is damaged; export the mesh again") from error
        if len(content) < size:
            raise InputError(f"{self._shown}: ends within a mesh; export it again")
        return content


def _check_mesh(content: _Inflated, version: int, shown: str) -> None:
    (flags,) = unpack("<I", content.read(4))
    if version == 4:
        for _ in range(LONGEST_LINE):
            if content.read(1) == b"\0":
                break
        else:
            raise InputError(f"{shown}: expected a shorter name of a mesh")
    vertices, faces = unpack("<QQ", content.read(16))
    wide = 8 if flags & DOUBLE else 4
    rest = wide * vertices * sum(n for flag, n in ((NORMALS, 3), (TEXTURED, 2), (COLOURED, 3)) if flags & flag)
    if vertices >= 2**32 or 3 * wide * vertices + rest + 12 * faces > content.most:
        raise InputError(f"{shown}: states {vertices} vertices and {faces} faces, more than it holds")
    check_memory(3 * (3 * wide * vertices + rest + 12 * faces), f"{shown}: a mesh", "make it smaller")
    positions = np.frombuffer(content.read(3 * wide * vertices), f"<f{wide}")
    if not (np.abs(positions) < 1e30).all():
        raise InputError(f"{shown}: expected finite positions of vertices, got others; correct the mesh")
    content.read(rest)
    indices = np.frombuffer(content.read(12 * faces), "<u4")
    if indices.size and indices.max() >= vertices:
        raise InputError(f"{shown}: expected indices of its {vertices} vertices, got {indices.max()}; correct the mesh")


@dataclass
class _PlyElement:
    """An element of a PLY file: so many rows of these fields."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=lambda: list[tuple[str, str]]())
    lists: list[str] = field(default_factory=lambda: list[str]())


def check_ply(path: Path) -> None:
    """Check a PLY mesh of triangles. Raises InputError that names the file, OSError if it cannot be read."""
    shown, size = printable(path), path.stat().st_size
    with open_input(path) as stream:
        order, elements = _header(stream, shown)
        _check_counts(elements, shown, size - stream.tell(), order)
        needed = size if order == "=" else max(row.count * _dtype(row, order).itemsize for row in elements)
        check_memory(2 * needed, f"{shown}: a mesh of {size / 1e6:.3g} MB", "make it smaller")
        numbers = _numbers(stream, shown) if order == "=" else None
        start, vertices = 0, 0
        for row in elements:
            columns, start = _columns(row, order, stream, numbers, start, shown)
            if row.name == "vertex":
                vertices = row.count
                _check_positions(columns, shown)
            _check_triangles(row, columns, vertices, shown)


def _header(stream: BinaryIO, shown: str) -> tuple[str, list[_PlyElement]]:
    order, elements = "", list[_PlyElement]()
    for number in range(MOST_HEADERS):
        words = _line(stream, shown)
        if number == 0 and words != ["ply"]:
            raise InputError(f"{shown}: expected a PLY mesh, which starts with 'ply', got something else")
        if words == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) == 3 and words[1] in FORMATS and not order:
            order = FORMATS[words[1]]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(_PlyElement(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            _add_property(elements[-1], words, shown)
        elif number and words and words[0] not in ("comment", "obj_info"):
            raise InputError(f"{shown}: expected a header of PLY, got the line '{printable(' '.join(words), 80)}'")
    else:
        raise InputError(f"{shown}: expected a header of at most {MOST_HEADERS} lines")
    names = [row.name for row in elements]
    if (
        not order
        or names.count("vertex") != 1
        or names.count("face") != 1
        or names.index("face") < names.index("vertex")
    ):
        raise InputError(f"{shown}: expected a format, and the elements vertex and face of PLY in its header")
    return order, elements


def _line(stream: BinaryIO, shown: str) -> list[str]:
    line = stream.readline(LONGEST_HEADER)
    if not line.endswith(b"\n"):
        raise InputError(f"{shown}: expected a header of PLY up to 'end_header', got a longer line or none")
    return line.decode("latin-1").split()


def _add_property(row: _PlyElement, words: list[str], shown: str) -> None:
    if len(words) == 3 and words[1] in TYPES:
        row.fields.append((f"{len(row.fields)} {words[2]}", TYPES[words[1]]))
    elif len(words) == 5 and words[1] == "list" and words[2] in TYPES and words[3] in TYPES:
        row.lists.append(words[4])
        row.fields.append((f"{len(row.fields)} count {words[4]}", TYPES[words[2]]))
        row.fields.extend((f"{len(row.fields) + i} {words[4]} {i}", TYPES[words[3]]) for i in range(3))
    else:
        raise InputError(f"{shown}: expected a property of PLY, got the line '{printable(' '.join(words), 80)}'")


def _dtype(row: _PlyElement, order: str) -> np.dtype[Any]:
    return np.dtype([(name, order + kind) for name, kind in row.fields])


def _check_counts(elements: list[_PlyElement], shown: str, left: int, order: str) -> None:
    for row in elements:
        least = 2 * len(row.fields) if order == "=" else _dtype(row, order).itemsize
        if row.count * least > left + 1:
            raise InputError(f"{shown}: states {row.count} rows of '{printable(row.name, 40)}', more than it holds")


def _numbers(stream: BinaryIO, shown: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(stream.read().decode("latin-1"), sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise InputError(f"{shown}: expected numbers after the header, got something else") from error


def _columns(
    row: _PlyElement, order: str, stream: BinaryIO, numbers: Any, start: int, shown: str
) -> tuple[dict[str, Any], int]:
    """Return the columns of an element, and where the next one starts among the numbers of a text."""
    names, missing = [name for name, _ in row.fields], f"{shown}: ends within its '{printable(row.name, 40)}'"
    if numbers is None:
        content = stream.read(row.count * _dtype(row, order).itemsize)
        table = np.frombuffer(content, _dtype(row, order)) if names and row.count else None
        if table is not None and table.size != row.count:
            raise InputError(missing)
        return {name: np.empty(0) if table is None else table[name] for name in names}, 0
    end = start + row.count * len(names)
    if end > numbers.size:
        raise InputError(missing)
    table = numbers[start:end].reshape(row.count, len(names))
    return {name: table[:, index] for index, name in enumerate(names)}, end


def _check_positions(columns: dict[str, Any], shown: str) -> None:
    for name, values in columns.items():
        if name.partition(" ")[2] in ("x", "y", "z") and not (np.abs(values.astype(np.float64)) < 1e30).all():
            raise InputError(f"{shown}: expected finite positions of vertices, got others; correct the mesh")


def _check_triangles(row: _PlyElement, columns: dict[str, Any], vertices: int, shown: str) -> None:
    for name, values in columns.items():
        _, _, rest = name.partition(" ")
        if rest.startswith("count ") and values.size and (values != 3).any():
            raise InputError(f"{shown}: expected triangles, got faces of {printable(values[values != 3][0])} vertices")
        indexes = row.name == "face" and rest.rpartition(" ")[0] in INDICES and rest[:6] != "count "
        if indexes and values.size:
            wrong = values[~((values >= 0) & (values < vertices))]
            if wrong.size:
                index = printable(f"{float(wrong[0]):.10g}")
                raise InputError(f"{shown}: expected indices of its {vertices} vertices, got {index}; correct the mesh")
    if row.name == "face" and not set(row.lists) & set(INDICES):
        raise InputError(f"{shown}: expected the indices of faces as a list vertex_index, got none")
