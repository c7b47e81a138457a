"""TIFF files: grey or RGB pages, uncompressed or compressed with LZW, Deflate or PackBits.

Pages are asked for one by one, since tifffile follows a circular list of them without end, and the sizes of all strips
and tiles are checked before tifffile reads them, since it fills what is missing. What a file says of its pages in its
descriptions (OME, ImageJ) is not used: such texts may name other files.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input
from ommatid.runtime.machine import check_memory

from .stored_picture import BYTES, UPRIGHT, StoredPicture, check_single, profile_notes, upright

CHANNELS = {"MINISBLACK": 1, "RGB": 3}  # of light, by the kind of picture
BITS = (1, 8, 16, 32, 64)  # per number
UNCOMPRESSED = 1
DECODERS = {5: "lzw_decode", 8: "zlib_decode", 32946: "zlib_decode", 32773: "packbits_decode"}  # of imagecodecs
EXPANSION = 4096  # most bytes that one byte stands for, with any of them
PREDICTORS = (1, 2, 3)  # none, differences along a row, of the bytes of floating-point numbers
MOST_PAGES = 100_000
PLAIN = {"is_lsm": False, "is_scanimage": False, "is_ndpi": False}  # variants whose pages tifffile arranges itself


def picture(stream: BinaryIO, path: Path) -> StoredPicture:
    """Read the picture in a file, colours last.

    Raises InputError for several pages, one that does not fit into memory, has an unknown compression, or is neither
    grey nor RGB, and errors of tifffile, or ValueError, for a damaged file.
    """
    with _opened(stream, path) as found:
        check_single(path, len(found), "pages")
        return _read(stream, path, found)[0]


def pages(stream: BinaryIO, path: Path) -> list[StoredPicture]:
    """Read the pages of a file, of which each is a frame. Raises as `picture` does."""
    with _opened(stream, path) as found:
        return _read(stream, path, found)


def description(path: Path) -> str:
    """Return the description of the first page of a file. Raises ValueError or InputError if there is none."""
    try:
        with open_input(path) as stream, _opened(stream, path) as found:
            return str(found[0].description)
    except (InputError, OSError):
        raise
    except Exception as error:  # tifffile has many
        raise ValueError("it is damaged") from error


class _Raising(logging.Handler):
    """Raises what tifffile logs as an error, after which it goes on with what it could read."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            raise ValueError(record.getMessage())


@contextmanager
def _opened(stream: BinaryIO, path: Path) -> Generator[list[Any]]:
    """The pages of a file as tifffile describes them, except reduced copies of other pages."""
    import tifffile

    log, raising = logging.getLogger("tifffile"), _Raising()
    propagated, log.propagate = log.propagate, False
    log.addHandler(raising)
    stream.seek(0)
    try:
        with cast(Any, tifffile).TiffFile(stream, name="picture.tif", **PLAIN) as file:
            found = list(_pages(file))
            _check_listed(path, found)
            yield [page for page in found if not page.is_reduced] or found[:1]
    finally:
        log.removeHandler(raising)
        log.propagate = propagated


def _pages(file: Any) -> Iterator[Any]:
    """Yield the pages; a list that returns to an earlier page ends there. Raises ValueError for very many."""
    known = set[int]()
    for index in range(MOST_PAGES):
        try:
            page = file.pages[index]
        except IndexError:
            return
        if page.offset in known:
            return
        known.add(page.offset)
        yield page
    raise ValueError(f"it has more than {MOST_PAGES} pages")


def _read(stream: BinaryIO, path: Path, found: list[Any]) -> list[StoredPicture]:
    """Read pages after all of them are checked."""
    if not found:
        raise ValueError("it has no pages")
    for page in found:
        _check_kind(path, page)
    sizes = [(prod(page.shape), page.dtype.itemsize) for page in found]
    needed = sum(size * itemsize for size, itemsize in sizes) + BYTES * max(size for size, _ in sizes)
    needed += max(0 if page.compression == UNCOMPRESSED else 2 * _segment(page) for page in found)
    check_memory(needed, f"{path}: to read it", "take a smaller picture, or free some memory")
    for page in found:
        _check_segments(stream, page)
    return [_page(page) for page in found]


def _check_kind(path: Path, page: Any) -> None:
    """Raise InputError if a page is of a kind that is not read."""
    name = str(getattr(page.photometric, "name", page.photometric)) if 262 in page.tags else ""
    colours, bits = int(page.samplesperpixel) - len(page.extrasamples), page.bitspersample
    compression = getattr(page.compression, "name", page.compression)
    is_known = not name or CHANNELS.get(name) == colours
    is_packed = page.compression in (UNCOMPRESSED, *DECODERS) and page.predictor in PREDICTORS
    if not is_known or not is_packed or bits not in BITS or page.dtype is None:
        raise InputError(
            f"{path}: expected grey or RGB, got {colours} numbers per pixel of the kind {name}, {str(bits)[:20]} bits"
            f" each, compression {compression}, predictor {int(page.predictor)}; save it as one of"
            " these, with 8, 16 or 32 bits per number, uncompressed or with LZW or Deflate"
        )
    if page.ndim > 3 or not prod(page.shape):
        raise ValueError(f"its shape is {page.shape}")


def _check_listed(path: Path, found: list[Any]) -> None:
    """Raise InputError if a file has frames without pages, as ImageJ and tifffile write very many."""
    text = str(found[0].description) if found else ""
    images = re.match(r"ImageJ=[^\0]*?\nimages=(\d{1,9})\b", text)
    if (images and int(images[1]) > len(found)) or (text.startswith("{") and '"truncated": true' in text):
        raise InputError(f"{path}: expected a page for every frame, got frames without pages; save each as a page")


def _segment(page: Any) -> int:
    """Bytes of a strip or tile of a page."""
    return prod(page.chunks) * int(page.dtype.itemsize)


def _check_segments(stream: BinaryIO, page: Any) -> None:
    """Raise ValueError if a strip or tile is missing, outside the file, or not as long as its pixels."""
    size = stream.seek(0, io.SEEK_END)
    offsets, counts = list(page.dataoffsets), list(page.databytecounts)
    expected = list(_lengths(page))
    if not len(offsets) == len(counts) == len(expected):
        raise ValueError("some of its strips are missing")
    decode: Any = None
    if page.compression != UNCOMPRESSED:
        import imagecodecs

        decode = getattr(imagecodecs, DECODERS[page.compression])
    for offset, count, needed in zip(offsets, counts, expected, strict=True):
        if offset + count > size:
            raise ValueError("it is cut short")
        stream.seek(offset)
        most = _segment(page)
        length = count if decode is None else len(decode(stream.read(count), out=min(most, EXPANSION * count) + 1))
        if length < needed:
            raise ValueError("it is cut short")
        if decode is not None and length > most:
            raise ValueError("a strip has more than its pixels")


def _lengths(page: Any) -> Iterator[int]:
    """Yield the bytes of every strip or tile: tiles are whole, the last strip of a plane may have fewer rows."""
    planes = int(page.samplesperpixel) if int(page.planarconfig) != 1 else 1
    of_pixel = int(page.bitspersample) * (int(page.samplesperpixel) // planes)
    if page.is_tiled:
        width, rows = int(page.tilewidth), int(page.tilelength)
        yield from [-(-width * of_pixel // 8) * rows] * prod(page.chunked)
        return
    width, rows, left = int(page.imagewidth), int(page.rowsperstrip), int(page.imagelength)
    lines = [min(rows, left - first) for first in range(0, left, rows)]
    yield from [-(-width * of_pixel // 8) * each for each in lines] * planes


def _page(page: Any) -> StoredPicture:
    """Read a checked page, colours last and upright."""
    pixels = np.asarray(page.asarray())
    if pixels.ndim == 3 and int(page.planarconfig) != 1:
        pixels = np.moveaxis(pixels, 0, -1)
    if page.bitspersample == 1:
        pixels = pixels.astype(np.bool_)
    tags = page.tags
    profile, orientation = tags.valueof(34675), tags.valueof(274)
    picture = StoredPicture(pixels, notes=profile_notes(profile if isinstance(profile, bytes) else b""))
    return upright(picture, orientation if isinstance(orientation, int) else UPRIGHT)
