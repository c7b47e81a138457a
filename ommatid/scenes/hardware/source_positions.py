"""Positions of recorded point sources: the pixels of f that were lit in each exposure."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ommatid.runtime.arrays import IntArray
from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.input_files import read_text

from ..camera import Camera

LONGEST = 20  # characters of a number
COLUMNS = ("image", "row", "column")


def positions_by_rows(camera: Camera, files: Sequence[Path]) -> list[IntArray]:
    """Return the positions, (1, 2) each, of a source that scans f row by row, once or several times."""
    count = len(files)
    if count == 0 or count % camera.unknowns:
        raise InputError(
            f"expected an image for each of the {camera.unknowns} pixels of f, once or several times, got {count}; give"
            " the positions of the points with --places"
        )
    rows, columns = np.divmod(np.arange(count) % camera.unknowns, camera.columns)
    return list(np.stack([rows, columns], axis=1)[:, None, :])


def read_positions(path: Path, camera: Camera, files: Sequence[Path]) -> list[IntArray]:
    """Row and column of f of every source of each exposure, (sources, 2) each, from a CSV file.

    Its columns are image, row and column; an image is given by its file name, or by its number from 0.
    Raises InputError, naming the line, for a position that is damaged, outside f, or given twice.
    """
    positions: list[dict[tuple[int, int], None]] = [{} for _ in files]  # in order, as a set is not
    for number, line in _lines(path):
        where = f"{path}: line {number}"
        image = _image(line["image"], files, where)
        row, column = (_integer(line[name], name, where) for name in ("row", "column"))
        if not (0 <= row < camera.rows and 0 <= column < camera.columns):
            raise InputError(
                f"{where}: row {row}, column {column} lies outside f of {camera.rows} x {camera.columns} pixels, which"
                " are counted from 0"
            )
        if (row, column) in positions[image]:
            raise InputError(f"{where}: row {row}, column {column} is given twice for one image; remove one of them")
        positions[image][row, column] = None
    for file, of_file in zip(files, positions, strict=True):
        if not of_file:
            raise InputError(f"{path}: has no point of {file}; add its position, or leave the image out")
    return [np.array([*of_file], dtype=np.int64) for of_file in positions]


def _lines(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the lines with their numbers, one by one: a file may have millions of them before a wrong one."""
    try:
        reader = csv.DictReader(io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        if not set(COLUMNS) <= set(header):
            given = shortened(",".join(header))
            raise InputError(f"{path}: expected the columns image,row,column in its first line, got '{given}'")
        for line in reader:
            if any(line[name] is None for name in COLUMNS):
                raise InputError(f"{path}: line {reader.line_num}: expected an image, a row and a column, got fewer")
            yield reader.line_num, line
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a CSV file in UTF-8, got other bytes at {error.start}") from error
    except (OSError, csv.Error) as error:
        reason = shortened(str(error))
        raise InputError(f"{path}: could not be read as a CSV file of positions ({reason})") from error


def _image(text: str, files: Sequence[Path], where: str) -> int:
    name = text.strip()
    if name.isdecimal() and len(name) <= LONGEST and int(name) < len(files):
        return int(name)
    matches = [index for index, file in enumerate(files) if name in (str(file), file.name)]
    if len(matches) == 1:
        return matches[0]
    reason = f"{len(matches)} images have that name" if matches else "no image has that name"
    raise InputError(
        f"{where}: expected an image by its file's name or by its number from 0 to {len(files) - 1}, got"
        f" '{shortened(name)}'; {reason}"
    )


def _integer(text: str, name: str, where: str) -> int:
    try:
        if len(text) > LONGEST:
            raise ValueError
        return int(text)
    except ValueError as error:
        raise InputError(f"{where}: expected a whole number as its {name}, got '{shortened(text)}'") from error
