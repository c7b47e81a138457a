"""OBJ and serialized meshes, checked: faces of known vertices, finite positions, and counts that the file can hold."""

from __future__ import annotations

import zlib
from math import isfinite
from pathlib import Path
from struct import unpack

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
