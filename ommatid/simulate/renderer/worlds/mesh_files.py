"""OBJ and serialized meshes, checked: faces of known vertices, finite positions, and counts that the file can hold."""

from __future__ import annotations

import re
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
BLOCK = 2**18  # bytes of an OBJ mesh that are checked at once
_END = rb"[ \t]*+\r?+\n"
_NUMBER = rb"[ \t]{1,8}+[-+]?+[0-9]{1,40}+(?:\.[0-9]{0,40}+)?+(?:[eE][-+]?+[0-9]{1,2}+)?+"
_NUMBERS = {  # lines of one kind in their usual form, one after another
    kind: re.compile(rb"(?:%b(?:%b){%d,8}+%b)++" % (kind, _NUMBER, least, _END))
    for kind, least in ((b"v", 3), (b"vt", 2), (b"vn", 3))
}
_FACES = {
    kinds: re.compile(rb"(?:f(?:[ \t]{1,8}+%b){3,100}+%b)++" % (indices, _END))
    for kinds, indices in (
        ((b"v",), rb"[0-9]{1,11}+(?!/)"),
        ((b"v", b"vt"), rb"[0-9]{1,11}+/[0-9]{1,11}+(?!/)"),
        ((b"v", b"vn"), rb"[0-9]{1,11}+//[0-9]{1,11}+(?!/)"),
        ((b"v", b"vt", b"vn"), rb"[0-9]{1,11}+/[0-9]{1,11}+/[0-9]{1,11}+(?!/)"),
    )
}
NORMALS, TEXTURED, COLOURED, DOUBLE = 0x1, 0x2, 0x8, 0x2000  # flags


def check_obj(path: Path) -> None:
    """Check an OBJ mesh. Raises InputError that names the file, OSError if it cannot be read."""
    shown, counts = printable(path), {b"v": 0, b"vt": 0, b"vn": 0}
    number = faces = 0
    with open_input(path) as stream:
        check_memory(8 * path.stat().st_size, f"{shown}: a mesh", "make it smaller")
        while block := stream.read(BLOCK):
            block += stream.readline(LONGEST_LINE + 1)
            start = by_line = 0
            while start < len(block):
                kind, end, lines = b"", start, 0
                if start >= by_line:
                    kind, end, lines = _checked_run(block, start, counts)
                if not lines:
                    by_line = max(by_line, end)
                    kind, lines = _checked_line(block, start, counts, f"{shown} (line {number + 1})"), 1
                    end = block.find(b"\n", start) + 1 or len(block)
                number, start, faces = number + lines, end, faces + lines * (kind == b"f")
                if kind in counts:
                    counts[kind] += lines
    if not faces:
        raise InputError(f"{shown}: expected an OBJ mesh with vertices and faces, got no face")


def _checked_run(block: bytes, start: int, counts: dict[bytes, int]) -> tuple[bytes, int, int]:
    """Return the kind, the end and the number of lines of one kind in their usual form, if all are correct.

    The number is 0 if there are none, or if one of those up to the end is wrong.
    """
    for kind, pattern in _NUMBERS.items():
        if run := pattern.match(block, start):
            return kind, run.end(), run.group().count(b"\n")
    for kinds, pattern in _FACES.items():
        if run := pattern.match(block, start):
            text = run.group()
            indices = np.array(text.replace(b"f", b" ").replace(b"/", b" ").split(), dtype=np.int64)
            columns = indices.reshape(-1, len(kinds))
            if columns.min() >= 1 and (columns.max(axis=0) <= [counts[kind] for kind in kinds]).all():
                return b"f", run.end(), text.count(b"\n")
            return b"f", run.end(), 0
    return b"", start, 0


def _checked_line(block: bytes, start: int, counts: dict[bytes, int], place: str) -> bytes:
    """Return the first word of a line. Raises InputError that begins with `place`."""
    line = block[start : block.find(b"\n", start) + 1 or len(block)]
    if len(line) > LONGEST_LINE or b"\0" in line:
        raise InputError(f"{place}: expected text of at most {LONGEST_LINE} characters a line, got more")
    words = line.split()
    if not words:
        return b""
    if words[0] in counts:
        _check_numbers(words[1:4], 2 if words[0] == b"vt" else 3, place)
    elif words[0] == b"f":
        _check_face(words[1:], counts, place)
    return words[0]


def _check_numbers(words: list[bytes], least: int, place: str) -> None:
    try:
        correct = len(words) >= least and all(isfinite(float(word)) for word in words[:least])
    except ValueError:
        correct = False
    if not correct:
        raise InputError(f"{place}: expected {least} finite numbers, got '{printable(b' '.join(words), 80)[2:-1]}'")


def _check_face(words: list[bytes], counts: dict[bytes, int], place: str) -> None:
    if len(words) < 3:
        raise InputError(f"{place}: expected a face of three or more vertices, got {len(words)}")
    for word in words:
        for index, kind in zip(word.split(b"/"), counts, strict=False):
            if index and not (index.isdigit() and len(index) < 12 and 1 <= int(index) <= counts[kind]):
                got = printable(index.decode("latin-1"), 40)
                raise InputError(
                    f"{place}: expected indices from 1 to {counts[kind]} of the lines '{kind.decode()}' before it,"
                    f" got {got}; correct the mesh"
                )


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
