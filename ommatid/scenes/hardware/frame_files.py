"""The files of recorded frames, and what is lost when they are read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import check_regular

from ..formats.picture import notes_of
from ..formats.picture_file import read_frames_of
from ..formats.stored_picture import StoredPicture

SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy")
FLOATING = "floating-point"


@dataclass
class FrameNotes:
    """What is lost or changed when frames are read, and the types of their numbers.

    sentences : of the first file of images, of dark and of flat frames;  types : kinds of frames by type
    """

    sentences: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    types: dict[str, str] = field(default_factory=dict[str, str])

    def add(self, path: Path, stored: StoredPicture, what: str) -> None:
        """Note one picture."""
        self.sentences.setdefault(what, notes_of(str(path), stored))
        dtype = stored.pixels.dtype
        bits = 8 * dtype.itemsize if stored.bits is None else stored.bits
        self.types.setdefault(FLOATING if dtype.kind == "f" else f"{bits}-bit", what)

    def describe(self) -> list[str]:
        """Return a sentence each."""
        sentences = [sentence for of_kind in self.sentences.values() for sentence in of_kind]
        whole = [f"{words} numbers ({what})" for words, what in self.types.items() if words != FLOATING]
        if len(whole) > 1:
            sentences.append(
                f"frames have {' and '.join(whole)}, which are taken as they are: record all of them with the same bits"
            )
        return sentences


def files_in(path: Path) -> list[Path]:
    """The file itself, or the pictures in a folder sorted by name. Raises InputError if there is none."""
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    if not files:
        raise InputError(f"{path}: expected a folder of PNG, TIFF, EXR or NPY files, got none of them in it")
    return files


def pictures_of(path: Path, what: str) -> list[NDArray[Any]]:
    """The numbers of the pictures in a file: a single one, or all of a (count, rows, columns) array or of all pages.

    Raises InputError if there is none.
    """
    return [stored.pixels for stored in stored_pictures(path, what)]


def stored_pictures(path: Path, what: str) -> list[StoredPicture]:
    """The pictures in a file, with what is lost when they are read. Raises InputError if there is none."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected {what} as PNG, TIFF, EXR or NPY files, whose numbers are the sensor's")
    try:
        check_regular(path)
    except OSError as error:
        raise InputError(f"{path}: there is no such file among the {what}") from error
    pictures = read_frames_of(path, what)
    for stored in pictures:
        if stored.pixels.dtype.kind not in "uif":
            raise InputError(
                f"{path}: expected whole or floating-point numbers, got {stored.pixels.dtype}, {stored.pixels.shape}"
            )
    if not pictures:
        raise InputError(f"{path}: expected {what}, got a file without pictures")
    return pictures
