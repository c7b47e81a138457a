"""Pictures that decoders disagree on: depths, palettes, transparency, frames, pages and orientations.

The pixels that were encoded are known, so that what is read can be compared with them.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ...scenes import picture_bytes as made
from ..damage import Engine, marked
from ..family import FileType
from ..file_types import PICTURE, read_picture

LUMINANCE = np.array((0.2125, 0.7154, 0.0721))  # docs/pictures.md
CLOSE = 2e-3  # of 255: half a step of 16 bits
GREY, RGB, PALETTE, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6  # types of colour of PNG
DEPTHS = {GREY: (1, 2, 4, 8, 16), RGB: (8, 16), PALETTE: (1, 2, 4, 8), GREY_ALPHA: (8, 16), RGBA: (8, 16)}
PNG_MARKS = (b"IHDR", b"PLTE", b"tRNS", b"acTL", b"fcTL", b"eXIf", b"IDAT")
ROWS, COLUMNS = 20, 24
BOMB = 6000  # pixels along a side of a picture that is a few kilobytes large


@dataclass(frozen=True, eq=False)
class Pixels:
    """Values of a picture, equal to an array within the rounding of 16 bits; without values equal to none."""

    values: Any

    def __eq__(self, other: object) -> bool:
        """Return True for an array of the same shape and values."""
        if not isinstance(other, np.ndarray) or self.values is None or self.values.shape != other.shape:
            return False
        return bool(np.abs(self.values - other).max() <= CLOSE)


NEVER = Pixels(None)  # of contents that must be refused
known: dict[bytes, Pixels] = {}  # what must be read from a content


def _luminance(values: Any, largest: int) -> Pixels:
    """Return the brightness, 0 to 255, of (rows, columns, channels) numbers."""
    colour = values[..., :3] @ LUMINANCE if values.shape[2] >= 3 else values[..., 0].astype(float)
    return Pixels(colour * (255 / largest))


def oriented(values: Any, orientation: int) -> Any:
    """Return a picture as EXIF's orientation asks: (rows, columns, channels)."""
    if orientation in (5, 6, 7, 8):
        values = values.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    return values[::-1] if orientation in (3, 4, 7, 8) else values


def png(rng: Random, _: bytes) -> bytes:
    """Return a PNG file of a random kind."""
    if rng.random() < 0.03:
        return _png_bomb(rng)
    colour = rng.choice(sorted(DEPTHS))
    depth = rng.choice(DEPTHS[colour])
    numbers = np.random.default_rng(rng.randrange(1 << 32))
    values = numbers.integers(0, 1 << depth, (ROWS, COLUMNS, made.SAMPLES[colour]))
    pixels, chunks = _luminance(values, (1 << depth) - 1), b""
    if colour in (GREY_ALPHA, RGBA):
        opaque = rng.random() < 0.5
        values[..., -1] = (1 << depth) - 1 if opaque else values[..., -1]
        pixels = _luminance(values[..., :-1], (1 << depth) - 1) if opaque else NEVER
    if colour == PALETTE:
        table = numbers.integers(0, 256, (1 << depth, 3), dtype=np.uint8)
        chunks += made.chunk(b"PLTE", table.tobytes())
        pixels = _luminance(table[values[..., 0]].astype(float), 255)
    if colour in (GREY, RGB, PALETTE) and rng.random() < 0.15:
        transparent = bytes([0, 255]) * (1 << depth - 1) if colour == PALETTE else values[0, 0].astype(">u2").tobytes()
        chunks, pixels = chunks + made.chunk(b"tRNS", transparent), NEVER
    turned = rng.choice((0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9))
    if turned:
        chunks += made.chunk(b"eXIf", made.exif(turned, rng.choice("<>")))
    if pixels is not NEVER:
        pixels = Pixels(oriented(pixels.values[..., np.newaxis], turned)[..., 0])
    frames, data, more = rng.choice((0, 0, 0, 0, 1, 2, 1000)), zlib.compress(made.filtered(values, depth)), b""
    control = [struct.pack(">IIIIIHHBB", number, COLUMNS, ROWS, 0, 0, 1, 10, 0, 0) for number in (0, 1)]
    if frames:
        chunks += made.chunk(b"acTL", struct.pack(">II", frames, 0)) + made.chunk(b"fcTL", control[0])
    if frames > 1:
        pixels = NEVER
        more = made.chunk(b"fcTL", control[1]) + made.chunk(b"fdAT", struct.pack(">I", 2) + data)
    header = made.header(ROWS, COLUMNS, colour, depth)
    content = made.png_of(header, chunks, made.chunk(b"IDAT", data), more)
    return _perhaps_damaged(rng, content, pixels, PNG_MARKS)


def _png_bomb(rng: Random) -> bytes:
    """Return a small file of many pixels, or of a long text."""
    zeros = zlib.compress(bytes(BOMB * (BOMB + 1)), 9)
    if rng.random() < 0.5:
        side = rng.choice((BOMB, 100000, 2**31 - 1))
        return made.png_of(made.header(side, side), made.chunk(b"IDAT", zeros))
    text = rng.choice((b"zTXt", b"iTXt", b"iCCP"))
    start = {b"zTXt": b"k\0\0", b"iTXt": b"k\0\1\0\0\0", b"iCCP": b"k\0\0"}[text]
    rows = zlib.compress(bytes(ROWS * (COLUMNS + 1)))
    return made.png_of(made.header(ROWS, COLUMNS), made.chunk(text, start + zeros), made.chunk(b"IDAT", rows))


def _perhaps_damaged(rng: Random, content: bytes, pixels: Pixels, marks: tuple[bytes, ...]) -> bytes:
    """Remember what must be read of a content, or damage it."""
    if rng.random() < 0.3:
        return marked(*marks)(rng, content)
    known[content] = pixels
    return content


def jpeg(rng: Random, _: bytes) -> bytes:
    """Return a JPEG file with or without an orientation, in grey, colour or inks, of one picture or several."""
    from PIL import Image

    mode = rng.choice(("L", "RGB", "RGB", "CMYK"))
    row, column = np.indices((ROWS, COLUMNS))
    channels = [(row * a + column * b) % 251 for a, b in ((9, 3), (2, 5), (1, 7), (4, 4))]
    image = Image.fromarray(np.stack(channels, axis=-1).astype(np.uint8), "RGBA")
    image = Image.merge("CMYK", image.split()) if mode == "CMYK" else image.convert("RGB").convert(mode)
    turned, several, stream = rng.randrange(10), rng.random() < 0.15, io.BytesIO()
    options: dict[str, Any] = {"save_all": True, "append_images": [image]} if several else {}
    options["exif"] = b"Exif\0\0" + made.exif(turned, rng.choice("<>")) if turned else b""
    options |= {"quality": rng.choice((30, 90)), "progressive": rng.random() < 0.3}
    image.save(stream, "MPO" if several else "JPEG", **options)
    content = stream.getvalue()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files of several pictures
        with Image.open(io.BytesIO(content), formats=("JPEG",)) as opened:
            values = np.atleast_3d(np.asarray(opened))
    pixels = NEVER if several or mode == "CMYK" else _luminance(oriented(values, turned), 255)
    return _perhaps_damaged(rng, content, pixels, (b"\xff\xd8", b"\xff\xe1", b"\xff\xc0", b"Exif\0\0"))


def tiff(rng: Random, _: bytes) -> bytes:
    """Return a TIFF file of a number type, an orientation and a number of pages."""
    import tifffile

    numbers = np.random.default_rng(rng.randrange(1 << 32))
    kind = rng.choice(("u1", "u2", "f4", "u1", "u2"))
    channels, pages = rng.choice((1, 1, 3)), rng.choice((1, 1, 1, 2, 50))
    values = numbers.integers(0, 256 if kind != "u2" else 65536, (ROWS, COLUMNS, channels)).astype(kind)
    inverted = channels == 1 and kind != "f4" and rng.random() < 0.2
    turned = rng.choice((0, 0, 1, 2, 3, 4, 5, 6, 7, 8))
    photometric = "rgb" if channels == 3 else "miniswhite" if inverted else "minisblack"
    stored = values if channels == 3 else values[..., 0]
    stream, order = io.BytesIO(), "<" if rng.random() < 0.5 else ">"
    extra = [(274, "H", 1, turned, True)] if turned else []
    with tifffile.TiffWriter(stream, bigtiff=rng.random() < 0.2, byteorder=order) as writer:
        for _page in range(pages):
            packed: Any = rng.choice((None, None, "lzw", "zlib", "packbits"))
            options: dict[str, Any] = {"compression": packed, "metadata": None, "extratags": extra}
            writer.write(stored, photometric=photometric, contiguous=False, **options)
    largest = 65535 if kind == "u2" else 255
    seen = largest - values if inverted else values
    pixels = NEVER if pages > 1 else _luminance(oriented(seen, turned), largest)
    return _perhaps_damaged(rng, stream.getvalue(), pixels, (b"II*\0", b"MM\0*", b"\x12\1", b"\1\x12"))


def of_kind(suffix: str, make: Engine) -> FileType:
    """Return a type of pictures, whose original is the first harmless content that is made."""

    def originals(_: Path) -> list[bytes]:
        contents = (make(Random(seed), b"") for seed in range(1000))
        return [next(content for content in contents if known.get(content, NEVER) is not NEVER)]

    name = {"png": "PNG", "jpg": "JPEG", "tif": "TIFF"}[suffix]
    kinds = f"picture, kinds of {name}", f"k.{suffix}"
    return FileType(*kinds, originals, make, read_picture, PICTURE, expected=known.get)


PICTURES = of_kind("png", png), of_kind("jpg", jpeg), of_kind("tif", tiff)
