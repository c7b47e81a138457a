"""Curves over wavelength: text files of two columns, wavelength in nm and value."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import cast

from ommatid.runtime.errors import InputError, shortened, shortened_repr
from ommatid.runtime.input_files import read_any_text

from ..tables.table import LARGEST

SHORTEST, LONGEST = 100.0, 20000.0  # nm
MOST_POINTS, MOST_BYTES = 10000, 10**6

Curve = tuple[tuple[float, float], ...]


def checked(points: object, largest: float = LARGEST) -> Curve:
    """Return points (wavelength in nm, value), between which values are linear. Raises ValueError unless they are that.

    largest : value that is accepted; the smallest is 0
    """
    rows = [_point(point) for point in cast(Iterable[object], points)] if isinstance(points, list | tuple) else []
    if not 2 <= len(rows) <= MOST_POINTS:
        raise ValueError(f"expected 2 to {MOST_POINTS} points of a wavelength in nm and a value, got {len(rows)}")
    for (first, _), (second, _) in pairwise(rows):
        if second <= first:
            raise ValueError(f"expected wavelengths in ascending order, got {second:g} after {first:g} nm")
    for wavelength, value in rows:
        if not SHORTEST <= wavelength <= LONGEST:
            raise ValueError(f"expected wavelengths from {SHORTEST:g} to {LONGEST:g} nm, got {wavelength:g}")
        if not 0 <= value <= largest:
            raise ValueError(f"expected values from 0 to {largest:g}, got {value:g} at {wavelength:g} nm")
    if not any(value for _, value in rows):
        raise ValueError("expected at least one value above 0, got none")
    return tuple(rows)


def _point(point: object) -> tuple[float, float]:
    given = shortened_repr(point)
    numbers = list(cast(Iterable[object], point)) if isinstance(point, list | tuple) else []
    values = [float(number) for number in numbers if isinstance(number, int | float) and not isinstance(number, bool)]
    if len(numbers) != 2 or len(values) != 2 or not all(isfinite(value) for value in values):
        raise ValueError(f"expected pairs of a wavelength in nm and a value, got {given}")
    return values[0], values[1]


def read_curve(path: Path, largest: float = LARGEST) -> Curve:
    """Read rows of a wavelength in nm and a value, separated by commas or blanks; a # begins a comment.

    The first row may be a heading. Raises InputError that names the file, the row, what was expected and what came.
    """
    lines = read_any_text(path, "curve of wavelength in nm and value", MOST_BYTES).splitlines()
    rows = [
        (number, words)
        for number, line in enumerate(lines, start=1)
        if (words := line.partition("#")[0].replace(",", " ").split())
    ]
    if rows and not any(_is_number(word) for word in rows[0][1]):
        del rows[0]
    points: list[tuple[float, ...]] = []
    for number, words in rows:
        if len(words) != 2 or not all(_is_number(word) for word in words):
            raise InputError(
                f"{path}, line {number}: expected a wavelength in nm and a value, got '{shortened(' '.join(words))}'"
            )
        points.append(tuple(float(word) for word in words))
    try:
        return checked(points, largest)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _is_number(word: str) -> bool:
    try:
        return isfinite(float(word))
    except ValueError:
        return False
