"""Which sensor pixels a point source on a pixel of f may reach, by the ideal geometry and a margin around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..lens_type import LensType

Vector = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class FootprintInterval:
    """Along one axis, the middles in f of the footprints of a type's (sub-imagers x pixels): (S,), `half` as long."""

    middle: Vector
    half: float

    def near(self, place: int, margin: float) -> tuple[Whole, Vector]:
        """Which intervals overlap pixel `place` of f or come as near as `margin`, and how far their middles are."""
        away = np.abs(self.middle - (place + 0.5))
        found = np.flatnonzero(away < self.half + margin + 0.5 - 1e-9)
        return found, away[found]


@dataclass(frozen=True)
class FootprintAssignment:
    """Footprints of all sensor pixels, widened by a `margin` in pixels of f."""

    camera: Camera
    margin: float

    @cached_property
    def _axes(self) -> list[tuple[FootprintInterval, FootprintInterval]]:
        return [(_interval(kind, 0), _interval(kind, 1)) for kind in self.camera.types]

    def reached(self, row: int, column: int) -> tuple[Whole, Vector]:
        """Sensor pixels that a source may reach, and how far their footprints' middles are: (n,) each.

        The distance is the larger one of rows and columns, in pixels of f beyond half a footprint.
        """
        numbers: list[Whole] = []
        distances: list[Vector] = []
        for kind, place, (down, across) in zip(self.camera.types, self.camera.type_slices(), self._axes, strict=True):
            (rows, above), (columns, beside) = down.near(row, self.margin), across.near(column, self.margin)
            k, i = np.divmod(rows, kind.pixels[0])
            l, j = np.divmod(columns, kind.pixels[1])  # noqa: E741
            pixel = ((k[:, None] * kind.array[1] + l) * kind.pixels[0] + i[:, None]) * kind.pixels[1] + j
            numbers.append(place.start + pixel.ravel())
            distances.append(np.maximum(above[:, None], beside).ravel() - down.half)
        return np.concatenate(numbers), np.concatenate(distances)

    def shared_out(self, places: Whole, file: Path) -> tuple[Whole, Whole]:
        """Sensor pixels that some source of one exposure may reach, and the pixel of f of the nearest: (n,) each.

        places : (sources, 2) rows and columns of f
        Raises InputError where the very footprint of a sensor pixel holds two of them.
        """
        found = [self.reached(row, column) for row, column in places.tolist()]
        pixel = np.concatenate([numbers for numbers, _ in found])
        distance = np.concatenate([distances for _, distances in found])
        source = np.repeat(np.arange(len(found)), [numbers.size for numbers, _ in found])
        order = np.lexsort((distance, pixel))
        pixel, distance, source = pixel[order], distance[order], source[order]
        again = pixel[1:] == pixel[:-1]
        both = again & (distance[1:] < 0.5 - 1e-9)  # the nearer one lies in the footprint, then, too
        if both.any():
            first = int(np.flatnonzero(both)[0])
            one, other = (tuple(places[source[first + step]].tolist()) for step in (0, 1))
            raise InputError(
                f"{file}: the points at {one} and {other}, row and column of f, lie in the footprint of one sensor"
                " pixel; record them in two images"
            )
        nearest = np.concatenate([[True], ~again])
        unknown = places[:, 0] * self.camera.columns + places[:, 1]
        return pixel[nearest], unknown[source[nearest]]


def _interval(kind: LensType, axis: int) -> FootprintInterval:
    starts = np.array([float(kind.origin[axis] + number * kind.step) for number in range(kind.array[axis])])
    ratio = float(kind.ratio)
    middles = starts[:, None] + ratio * (np.arange(kind.pixels[axis], dtype=np.float64) + 0.5)
    return FootprintInterval(np.asarray(middles.ravel(), dtype=np.float64), ratio / 2)


def unseen(camera: Camera, places: Whole) -> Whole:
    """Pixels of f that lie in some footprint and not among `places`, (n, 2) rows and columns."""
    touched = np.zeros(camera.shape, dtype=bool)
    for kind in camera.types:
        down, across = _interval(kind, 0), _interval(kind, 1)
        rows = [bool(down.near(row, 0.0)[0].size) for row in range(camera.rows)]
        columns = [bool(across.near(column, 0.0)[0].size) for column in range(camera.columns)]
        touched |= np.outer(rows, columns)
    touched[places[:, 0], places[:, 1]] = False
    return np.flatnonzero(touched)
