"""PNG pictures with all of their bits, and JPEG pictures, grey or RGB, upright.

The chunks of a PNG are checked here, and only the pixel data reach Pillow, which inflates and filters them. Of a whole
file, Pillow reduces 16-bit colour to 8 bits, scales 1, 2 and 4 bits, and inflates texts without a limit.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

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

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB, PALETTE, GREY_ALPHA, RGB_ALPHA = 0, 2, 3, 4, 6  # types of colour
SAMPLES = {GREY: 1, RGB: 3, PALETTE: 1, GREY_ALPHA: 2, RGB_ALPHA: 4}
DEPTHS = {GREY: (1, 2, 4, 8, 16), PALETTE: (1, 2, 4, 8)}  # bits per sample; of all others 8 or 16
READ = (b"PLTE", b"tRNS", b"eXIf", b"gAMA", b"sRGB", b"cICP", b"iCCP", b"acTL")
MOST_CHUNKS, LONGEST_CHUNK = 100_000, 1_000_000  # chunks of a file, bytes of one that is no pixel data
LONGEST_PROFILE = 4_000_000  # bytes, inflated
MOST_DEFLATED = 1032  # largest ratio of inflated to deflated bytes


@dataclass(frozen=True)
class PngHeader:
    """The header of a file (IHDR)."""

    columns: int
    rows: int
    bits: int
    colour: int
    interlaced: int

    @property
    def samples(self) -> int:
        """Numbers of a pixel."""
        return SAMPLES[self.colour]


@dataclass(frozen=True)
class PngChunks:
    """The chunks of a file that are used: the content of the others by name, and where the pixel data are."""

    header: PngHeader
    others: dict[bytes, bytes]
    data: list[tuple[int, int]]
    frames: int


def read_png(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read a PNG file. Raises InputError for several frames and too large a picture, ValueError for a damaged file."""
    chunks = _chunks(stream)
    header = chunks.header
    check_single(path, chunks.frames, "frames")
    numbers = header.rows * header.columns * header.samples
    stored = sum(length for _, length in chunks.data)
    check_size(path, numbers * (2 if header.colour == PALETTE else 1), 2 * stored)
    if numbers * header.bits // 8 > MOST_DEFLATED * stored:
        raise ValueError("its pixel data are cut short")
    samples = _decoded(header, b"".join(_content(stream, *place, b"IDAT") for place in chunks.data))
    pixels, notes = _coloured(header, chunks.others, samples)
    bits = header.bits if header.bits < 8 and header.colour == GREY else None
    picture = StoredPicture(pixels, bits, (*notes, *_coding_notes(chunks.others)))
    return upright(picture, orientation_of(chunks.others.get(b"eXIf", b"")))


def _chunks(stream: BinaryIO) -> PngChunks:
    """Walk the chunks, without reading pixel data. Raises ValueError for a damaged file."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    if stream.read(len(PNG_SIGNATURE)) != PNG_SIGNATURE:
        raise ValueError("it is no PNG file")
    header: PngHeader | None = None
    others: dict[bytes, bytes] = {}
    data: list[tuple[int, int]] = []
    frames = 0
    for _ in range(MOST_CHUNKS):
        length, name = struct.unpack(">I4s", _exactly(stream, 8))
        start = stream.tell()
        if start + length + 4 > size:
            raise ValueError("it is cut short")
        if name == b"IHDR":
            header = _header(_content(stream, start, length, name))
        elif header is None:
            raise ValueError("its header is missing")
        elif name == b"IEND":
            declared = int.from_bytes(others.get(b"acTL", b"")[:4], "big")
            return PngChunks(header, others, data, max(declared, frames))
        elif name == b"IDAT":
            data.append((start, length))
        elif name in READ and length <= LONGEST_CHUNK:
            others.setdefault(name, _content(stream, start, length, name))
        elif name == b"fcTL":
            frames += 1
        elif name[:1].isupper() and name not in READ:
            raise ValueError("it has an unknown critical chunk")
        stream.seek(start + length + 4)
    raise ValueError(f"it has more than {MOST_CHUNKS} chunks")


def _exactly(stream: BinaryIO, length: int) -> bytes:
    content = stream.read(length)
    if len(content) < length:
        raise ValueError("it is cut short")
    return content


def _content(stream: BinaryIO, start: int, length: int, name: bytes) -> bytes:
    """Return the content of a chunk. Raises ValueError if it does not match its checksum."""
    stream.seek(start)
    content = _exactly(stream, length)
    (checksum,) = struct.unpack(">I", _exactly(stream, 4))
    if zlib.crc32(content, zlib.crc32(name)) != checksum:
        raise ValueError("a chunk does not match its checksum")
    return content


def _header(content: bytes) -> PngHeader:
    columns, rows, bits, colour, compression, filtering, interlaced = struct.unpack(">IIBBBBB", content)
    known = colour in SAMPLES and bits in DEPTHS.get(colour, (8, 16))
    if not known or not columns or not rows or compression or filtering or interlaced > 1:
        raise ValueError("its header is damaged")
    return PngHeader(columns, rows, bits, colour, interlaced)


def _decoded(header: PngHeader, data: bytes) -> NDArray[Any]:
    """Inflate and filter pixel data: (rows, columns[, samples]) of uint8 or uint16, without scaling.

    A file of another type with as many bytes per pixel has the same filters, so that Pillow returns the bytes as they
    are. It has no such type for colour of 16 bits, whose upper and lower bytes are decoded one after the other.
    """
    if header.bits == 16 and header.colour in (RGB, RGB_ALPHA):
        mode = "RGB" if header.colour == RGB else "RGBA"
        upper = _bytes(header, 16, header.colour, data, f"{mode};16B").astype(np.uint16)
        upper <<= 8
        upper |= _bytes(header, 16, header.colour, data, f"{mode};16L")
        return upper
    if header.bits == 16:
        as_bytes = _bytes(header, 8, GREY_ALPHA if header.colour == GREY else RGB_ALPHA, data)
        values = np.ascontiguousarray(as_bytes).view(">u2").astype(np.uint16)
        return values[..., 0] if header.colour == GREY else values
    decoded = _bytes(header, header.bits, GREY if header.colour == PALETTE else header.colour, data)
    if header.bits == 1:
        return decoded.astype(np.uint8)
    return decoded // np.uint8(255 // (2**header.bits - 1))  # Pillow scales 2 and 4 bits to 8


def _bytes(header: PngHeader, bits: int, colour: int, data: bytes, order: str | None = None) -> NDArray[Any]:
    """Let Pillow decode pixel data as a file of so many bits and of this type of colour."""
    from PIL import Image

    described = struct.pack(">IIBBBBB", header.columns, header.rows, bits, colour, 0, 0, header.interlaced)
    content = b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(name)))
        for name, content in ((b"IHDR", described), (b"IDAT", data), (b"IEND", b""))
    )
    with any_size(), Image.open(io.BytesIO(PNG_SIGNATURE + content), formats=("PNG",)) as opened:
        if order is not None:
            opening = cast(Any, opened)
            decoder, extent, offset, _ = opening.tile[0]
            opening.tile = [(decoder, extent, offset, order)]
        return np.asarray(opened)


def _coloured(
    header: PngHeader, others: dict[bytes, bytes], samples: NDArray[Any]
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Look up the palette, and add the transparency that a file states for single colours or entries."""
    transparent = others.get(b"tRNS", b"")
    if header.colour == PALETTE:
        table = np.frombuffer(others.get(b"PLTE", b""), np.uint8)
        table = table[: table.size // 3 * 3].reshape(-1, 3)
        if int(samples.max()) >= len(table):
            raise ValueError("its palette is too short")
        opaque = np.full(len(table), 255, np.uint8)
        opaque[: len(transparent)] = np.frombuffer(transparent, np.uint8)[: len(table)]
        is_grey = bool((table == table[:, :1]).all())
        pixels, alpha = (table[:, 0] if is_grey else table)[samples], opaque[samples]
        notes = ("has a palette: its colours are looked up",)
    elif header.colour in (GREY, RGB) and transparent:
        key = np.frombuffer(transparent, ">u2")
        if key.size != header.samples:
            raise ValueError("its transparent colour is damaged")
        hidden = samples == key if header.colour == GREY else (samples == key).all(axis=-1)
        pixels, alpha, notes = samples, np.where(hidden, 0, 255).astype(samples.dtype), ()
    else:
        return samples, ()
    return (pixels if bool((alpha == 255).all()) else np.dstack([pixels, alpha])), notes


def _coding_notes(others: dict[bytes, bytes]) -> tuple[str, ...]:
    """Return what is said of the relation between values and light that a file states."""
    if b"iCCP" in others:
        name, _, deflated = others[b"iCCP"].partition(b"\0")
        try:
            profile = zlib.decompressobj().decompress(deflated[1:], LONGEST_PROFILE)
        except zlib.error:
            profile = b""
        return profile_notes(name + b" " + profile)
    if b"cICP" in others:
        return profile_notes(b"cICP")
    gamma = others.get(b"gAMA", b"")
    return gamma_notes(None if b"sRGB" in others or len(gamma) != 4 else int.from_bytes(gamma, "big") / 100_000)


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
