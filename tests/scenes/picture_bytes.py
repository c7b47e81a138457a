"""Files of pictures made byte by byte, of kinds that the libraries do not write."""

from __future__ import annotations

import importlib
import io
import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # numbers of a pixel, by the type of colour of a PNG
KINDS = [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16), (4, 8), (4, 16), (6, 8), (6, 16)]
ADAM7 = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]


def chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(
    samples: NDArray[Any], colour: int, bits: int, before: bytes = b"", after: bytes = b"", *, interlaced: bool = False
) -> bytes:
    """A PNG of (rows, columns, numbers of a pixel), whose rows are filtered in all five ways in turn."""
    pixels = samples.reshape(*samples.shape[:2], SAMPLES[colour])
    passes = [pixels[row::down, column::across] for row, column, down, across in ADAM7] if interlaced else [pixels]
    data = b"".join(filtered(part, bits) for part in passes if part.size)
    start = header(pixels.shape[0], pixels.shape[1], colour, bits, interlaced=interlaced)
    deflated = zlib.compress(data)
    halves = deflated[: len(deflated) // 2], deflated[len(deflated) // 2 :]
    return png_of(start, before, *(chunk(b"IDAT", half) for half in halves), after)


def header(rows: int, columns: int, colour: int = 0, bits: int = 8, *, interlaced: bool = False) -> bytes:
    """The first chunk of a PNG."""
    return chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, bits, colour, 0, 0, int(interlaced)))


def png_of(*chunks: bytes) -> bytes:
    """A PNG with these chunks."""
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks) + chunk(b"IEND", b"")


def filtered(pixels: NDArray[Any], bits: int) -> bytes:
    """The rows of (rows, columns, numbers of a pixel), filtered in all five ways in turn."""
    rows, columns, count = pixels.shape
    if bits == 16:
        raw = pixels.astype(">u2").view(np.uint8).reshape(rows, -1)
    elif bits == 8:
        raw = pixels.astype(np.uint8).reshape(rows, -1)
    else:
        single = np.unpackbits(pixels.astype(np.uint8).reshape(rows, columns, 1), axis=2)[:, :, 8 - bits :]
        raw = np.packbits(single.reshape(rows, -1), axis=1)
    step, above, lines = max(1, bits * count // 8), np.zeros(raw.shape[1], np.int64), b""
    for number, line in enumerate(raw.astype(np.int64)):
        left, corner = (np.concatenate([np.zeros(step, np.int64), part])[: line.size] for part in (line, above))
        estimate = left + above - corner
        distance = [np.abs(estimate - other) for other in (left, above, corner)]
        paeth = np.choose(np.argmin(distance, axis=0), [left, above, corner])
        predicted = [np.zeros_like(line), left, above, (left + above) // 2, paeth][number % 5]
        lines += bytes([number % 5]) + ((line - predicted) % 256).astype(np.uint8).tobytes()
        above = line
    return lines


def exif(orientation: int, order: str = "<") -> bytes:
    """EXIF data with an orientation and a tag before it."""
    entries = struct.pack(f"{order}HHII", 256, 4, 1, 9) + struct.pack(f"{order}HHIHH", 274, 3, 1, orientation, 0)
    return (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, 2) + entries + bytes(4)


def jpeg(pixels: NDArray[Any], **options: Any) -> bytes:
    """A JPEG of the best quality."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=100, subsampling=0, **options)
    return stream.getvalue()


def exr(channels: dict[str, tuple[str, int, int]], stored: tuple[int, int, int, int]) -> bytes:
    """An uncompressed OpenEXR file with 0, 1, 2 ... along the rows of every channel.

    channels : type of number (<u4, <f2, <f4), and sampling across and down, by name;  stored : data and display
        window as left, top, right, bottom
    """
    library: Any = importlib.import_module("OpenEXR")
    left, top, right, bottom = stored
    window = np.array([left, top], np.int32), np.array([right, bottom], np.int32)
    header = {
        **{"dataWindow": window, "displayWindow": window, "type": library.scanlineimage},
        "compression": library.NO_COMPRESSION,
    }
    made = {
        name: library.Channel(
            name, np.tile(np.arange(right - left + 1, dtype=number), (bottom - top + 1, 1)), across, down
        )
        for name, (number, across, down) in channels.items()
    }
    with TemporaryDirectory() as folder:
        library.File(header, made).write(f"{folder}/a.exr")
        return Path(f"{folder}/a.exr").read_bytes()
