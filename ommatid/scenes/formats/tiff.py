"""TIFF files by tifffile: grey or RGB pages, uncompressed or compressed with LZW, Deflate or PackBits.

What a file says of its pages in its descriptions (OME, ImageJ) is not used: such texts may name other files.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from itertools import count
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input

from .stored_picture import ORIENTATION_TAG, UPRIGHT, StoredPicture, check_size, profile_notes, upright

CHANNELS = {"MINISBLACK": 1, "RGB": 3}  # of light, by the kind of picture
BITS = (1, 8, 16, 32, 64)  # per number
UNCOMPRESSED = 1
COMPRESSIONS = (UNCOMPRESSED, 5, 8, 32946, 32773)  # none, LZW, Deflate by two numbers, PackBits
PROFILE_TAG = 34675  # of ICC
MOST_PAGES = 100_000
PLAIN = {"is_lsm": False, "is_scanimage": False, "is_ndpi": False}  # variants whose pages tifffile arranges itself


def pages(stream: BinaryIO, path: Path) -> Iterator[StoredPicture]:
    """Yield the pages of a file, colours last and upright, without reduced copies of other pages.

    Raises InputError for a page that does not fit into memory, has an unknown compression, or is neither grey nor RGB,
    and errors of tifffile, or ValueError, for a damaged file.
    """
    with _opened(stream) as file:
        listed = list(_pages(file))
        text = listed[0].description
        images = re.match(r"ImageJ=[^\0]*?\nimages=(\d{1,9})\b", text)
        if (images and int(images[1]) > len(listed)) or (text.startswith("{") and '"truncated": true' in text):
            raise InputError(f"{path}: expected a page for every frame, got frames without pages; save each as a page")
        for page in [page for page in listed if not page.is_reduced] or listed[:1]:
            yield _read(path, page)


def description(path: Path) -> str:
    """Return the description of the first page of a file. Raises ValueError or InputError if there is none."""
    try:
        with open_input(path) as stream, _opened(stream) as file:
            return str(file.pages[0].description)
    except (InputError, OSError):
        raise
    except Exception as error:  # tifffile has many
        raise ValueError("it is damaged") from error


def _refuse_errors(record: logging.LogRecord) -> bool:
    """Raise what tifffile logs as an error, after which it goes on with what it could read; drop its warnings."""
    if record.levelno >= logging.ERROR:
        raise ValueError(record.getMessage())
    return False


@contextmanager
def _opened(stream: BinaryIO) -> Generator[Any]:
    import tifffile

    log = logging.getLogger("tifffile")
    log.addFilter(_refuse_errors)
    try:
        with cast(Any, tifffile).TiffFile(stream, name="picture.tif", **PLAIN) as file:
            yield file
    finally:
        log.removeFilter(_refuse_errors)


def _pages(file: Any) -> Iterator[Any]:
    """Yield the pages, of which tifffile follows a circular list without end. Raises ValueError for very many."""
    known = set[int]()
    for index in count():
        try:
            page = file.pages[index]
        except IndexError:
            return
        if page.offset in known or index == MOST_PAGES:
            raise ValueError(f"its list of pages is circular, or longer than {MOST_PAGES}")
        known.add(page.offset)
        yield page


def _read(path: Path, page: Any) -> StoredPicture:
    """Read a page. Raises InputError for one of an unknown kind, and ValueError where strips are missing."""
    tags, compression, bits = page.tags, page.compression, page.bitspersample
    kind = str(getattr(page.photometric, "name", page.photometric)) if "PhotometricInterpretation" in tags else ""
    colours = int(page.samplesperpixel) - len(page.extrasamples)
    if (kind and CHANNELS.get(kind) != colours) or compression not in COMPRESSIONS or bits not in BITS:
        raise InputError(
            f"{path}: expected grey or RGB, got {colours} numbers per pixel of the kind {kind}, {str(bits)[:20]} bits"
            f" each, compression {getattr(compression, 'name', compression)}; save it as one of these, with 8, 16 or 32"
            " bits per number, uncompressed or with LZW or Deflate"
        )
    check_size(path, max(prod(page.shape), prod(page.chunks)))
    offsets, sizes = list(page.dataoffsets), list(page.databytecounts)
    is_short = compression == UNCOMPRESSED and 8 * sum(sizes) < prod(page.shape) * bits
    if is_short or min(*offsets, *sizes) <= 0 or not len(offsets) == len(sizes) == prod(page.chunked):
        raise ValueError("some of its strips or tiles are missing")  # tifffile fills them with zeros
    pixels = np.asarray(page.asarray())
    if pixels.ndim == 3 and int(page.planarconfig) != 1:
        pixels = np.moveaxis(pixels, 0, -1)
    profile, orientation = tags.valueof(PROFILE_TAG), tags.valueof(ORIENTATION_TAG)
    notes = profile_notes(profile if isinstance(profile, bytes) else b"")
    picture = StoredPicture(pixels.astype(np.bool_) if bits == 1 else pixels, notes=notes)
    return upright(picture, orientation if isinstance(orientation, int) else UPRIGHT)
