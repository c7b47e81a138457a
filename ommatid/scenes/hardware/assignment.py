"""Assignment of recorded point sources to sensor pixels, by the ideal footprints and a margin around them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..lens_type import LensType

TIE = 1e-9  # pixels of f, below which a distance to the edge of a footprint counts as 0


@dataclass(frozen=True)
class FootprintInterval:
    """Footprints of a type's (sub-imagers x pixels) along one axis: `middle`, (S,), and `half` their length, in f."""

    middle: FloatArray
    half: float

    def near(self, position: int, margin: float) -> tuple[IntArray, FloatArray]:
        """Indices of the intervals within `margin` of pixel `position` of f, and the distances of their middles."""
        distance = np.abs(self.middle - (position + 0.5))
        near = np.flatnonzero(distance < self.half + margin + 0.5 - TIE)
        return near, distance[near]


@dataclass(frozen=True)
class FootprintAssignment:
    """Footprints of all sensor pixels, widened by a `margin` in pixels of f."""

    camera: Camera
    margin: float

    @cached_property
    def _axes(self) -> list[tuple[FootprintInterval, FootprintInterval]]:
        return [(_interval(lens_type, 0), _interval(lens_type, 1)) for lens_type in self.camera.on_grids.types]

    def reached(self, row: int, column: int) -> tuple[IntArray, FloatArray]:
        """Sensor pixels that a source may reach, and the distances of their footprints: (n,) each.

        The distance is the larger one along rows and columns, in pixels of f, minus half a footprint.
        """
        pixels: list[IntArray] = []
        distances: list[FloatArray] = []
        for lens_type, first, (down, across) in zip(
            self.camera.on_grids.types, self.camera.on_grids.type_slices(), self._axes, strict=True
        ):
            (rows, row_distance), (columns, column_distance) = (
                down.near(row, self.margin),
                across.near(column, self.margin),
            )
            k, i = np.divmod(rows, lens_type.pixels[0])
            l, j = np.divmod(columns, lens_type.pixels[1])  # noqa: E741
            pixel = ((k[:, None] * lens_type.array[1] + l) * lens_type.pixels[0] + i[:, None]) * lens_type.pixels[1] + j
            pixels.append(first.start + pixel.ravel())
            distances.append(np.maximum(row_distance[:, None], column_distance).ravel() - down.half)
        return np.concatenate(pixels), np.concatenate(distances)

    def nearest_sources(self, positions: IntArray, file: Path) -> tuple[IntArray, IntArray]:
        """Sensor pixels that any source of one exposure may reach, and the pixel of f of the nearest: (n,) each.

        positions : (sources, 2) rows and columns of f
        Raises InputError if two sources lie in the footprint of one sensor pixel.
        """
        reached = [self.reached(row, column) for row, column in positions.tolist()]
        pixel = np.concatenate([pixels for pixels, _ in reached])
        distance = np.concatenate([distances for _, distances in reached])
        source = np.repeat(np.arange(len(reached)), [pixels.size for pixels, _ in reached])
        order = np.lexsort((distance, pixel))
        pixel, distance, source = pixel[order], distance[order], source[order]
        repeated = pixel[1:] == pixel[:-1]
        both_inside = repeated & (distance[1:] < 0.5 - TIE)  # the source before is nearer, so it is inside too
        if both_inside.any():
            first = int(np.flatnonzero(both_inside)[0])
            nearer, farther = (tuple(positions[source[first + step]].tolist()) for step in (0, 1))
            raise InputError(
                f"{file}: the points at {nearer} and {farther}, row and column of f, lie in the footprint of one sensor"
                " pixel; record them in two images"
            )
        nearest = np.concatenate([[True], ~repeated])
        unknown = positions[:, 0] * self.camera.columns + positions[:, 1]
        return pixel[nearest], unknown[source[nearest]]


def _interval(lens_type: LensType, axis: int) -> FootprintInterval:
    """The footprints of a lens type along rows (axis 0) or columns (1) of f."""
    starts = [float(start) for start in lens_type.starts(axis)]
    ratio = float(lens_type.ratio)
    middles = np.array(starts)[:, None] + ratio * (np.arange(lens_type.pixels[axis], dtype=np.float64) + 0.5)
    return FootprintInterval(np.asarray(middles.ravel(), dtype=np.float64), ratio / 2)


def unrecorded(camera: Camera, positions: IntArray) -> IntArray:
    """Indices of the pixels of f that lie in some footprint but are not in `positions`, (n, 2) rows and columns."""
    seen = np.zeros(camera.shape, dtype=bool)
    for lens_type in camera.on_grids.types:
        down, across = _interval(lens_type, 0), _interval(lens_type, 1)
        rows = [bool(down.near(row, 0.0)[0].size) for row in range(camera.rows)]
        columns = [bool(across.near(column, 0.0)[0].size) for column in range(camera.columns)]
        seen |= np.outer(rows, columns)
    seen[positions[:, 0], positions[:, 1]] = False
    return np.flatnonzero(seen)
