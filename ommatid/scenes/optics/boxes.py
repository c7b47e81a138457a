"""The ideal H without a matrix: every sensor pixel averages f over a box (Wood et al., section 2).

A box is a product of an interval of rows and one of columns, so that a lens type is two short tables. Overlaps of
intervals with pixels are computed in integers and are exact for any ratio.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import lcm

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.processors import processors

from ..camera import Camera
from ..lens_type import LensType, adjacent_slices

MOST_STORED = 2**24  # entries of H; more are computed from the geometry each time
ROWS_AT_ONCE = 64  # per task; fixed, so that results do not depend on the number of threads


def overlap(ratio: Fraction, pixels: int, start: Fraction, size: int) -> sparse.csr_array:
    """Shares of `size` unit cells in `pixels` adjacent intervals of length `ratio` from `start` on: (pixels, size)."""
    unit = lcm(ratio.denominator, start.denominator)
    length = int(ratio * unit)
    lower = int(start * unit) + length * np.arange(pixels, dtype=np.int64)
    width = -(-length // unit) + 1  # most cells that an interval touches
    cells = (lower // unit)[:, None] + np.arange(width)
    shared = np.minimum(lower[:, None] + length, (cells + 1) * unit) - np.maximum(lower[:, None], cells * unit)
    touched = (shared > 0) & (cells >= 0) & (cells < size)
    rows = np.broadcast_to(np.arange(pixels)[:, None], cells.shape)[touched]
    return sparse.csr_array((shared[touched] / length, (rows, cells[touched])), shape=(pixels, size))


@dataclass(frozen=True)
class BoxAxis:
    """Shares of pixels of f in each of the S = (sub-imagers) x (pixels) intervals along one axis of a lens type.

    shares : (S, size) CSR, in the order of measurements
    """

    shares: sparse.csr_array

    @cached_property
    def start(self) -> IntArray:
        """The first pixel of f in each row of the table `share`, such that all of the row lies on the axis: (S,)."""
        first = self.shares.indices[self.shares.indptr[:-1]].astype(np.int64)
        return np.minimum(first, self.shares.shape[1] - self._width)

    @cached_property
    def share(self) -> FloatArray:
        """Shares of the pixels of f from `start` on: (S, largest number of pixels in an interval)."""
        table = np.zeros((self.start.size, self._width))
        rows = np.repeat(np.arange(self.start.size), np.diff(self.shares.indptr))
        table[rows, self.shares.indices - self.start[rows]] = self.shares.data
        return table

    @property
    def _width(self) -> int:
        return int(np.diff(self.shares.indptr).max())

    @cached_property
    def order(self) -> IntArray:
        """Intervals sorted by their first pixel, so that memory is accessed in order: (S,)."""
        return np.argsort(self.start, kind="stable")


@dataclass(frozen=True)
class Box:
    """H of one lens type: the Kronecker product of `down` and `across`, with its rows in the order of measurements."""

    lens_type: LensType
    down: BoxAxis
    across: BoxAxis

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Rows and columns of sub-imagers, rows and columns of their pixels."""
        return (*self.lens_type.array, *self.lens_type.pixels)

    def forward(self, image: FloatArray, out: FloatArray) -> None:
        """H f: (rows, columns) to `out`, (measurements of the type,)."""
        from .box_kernels import average  # pyright: ignore[reportUnknownVariableType]

        down, across, target = self.down, self.across, out.reshape(self.shape)
        down_share, across_share = down.share, across.share  # computed here, not in threads

        def work(first: int, last: int) -> None:
            average(image, down.order, down.start, down_share, across.start, across_share, target, first, last)

        by_rows(down.start.size, work)

    def adjoint(self, readings: FloatArray, out: FloatArray) -> None:
        """Add H^T g to `out`: (measurements of the type,) to (rows, columns)."""
        from .box_kernels import spread  # pyright: ignore[reportUnknownVariableType]

        down, across, source = self.down, self.across, readings.reshape(self.shape)
        down_share, across_share = down.share, across.share  # computed here, not in threads

        def work(first: int, last: int) -> None:
            spread(source, down.order, down.start, down_share, across.start, across_share, out, first, last)

        by_rows(out.shape[0], work)

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Indices of the type's measurements inside a window of f, by their first pixel: (m,)."""
        k, i = np.divmod(_inside(self.down, rows), self.lens_type.pixels[0])
        l, j = np.divmod(_inside(self.across, columns), self.lens_type.pixels[1])  # noqa: E741
        _, sub_columns, rows_each, columns_each = self.shape
        return (((k[:, None] * sub_columns + l) * rows_each + i[:, None]) * columns_each + j).ravel()

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H from the window to the measurements inside it: (m, pixels of the window)."""
        down = self.down.shares[_inside(self.down, rows)][:, rows]
        across = self.across.shares[_inside(self.across, columns)][:, columns]
        return sparse.csr_array(sparse.kron(down, across, format="csr"))


@dataclass(frozen=True)
class BoxFootprints:
    """The ideal H of all lens types, applied without being stored."""

    camera: Camera

    @cached_property
    def boxes(self) -> tuple[Box, ...]:
        """H of each lens type, or of each sub-imager of a type with steered ones."""
        return tuple(designed_box(self.camera.shape, lens_type) for lens_type in self.camera.on_grids.types)

    @cached_property
    def slices(self) -> list[slice]:
        """The measurements of each of the boxes."""
        return adjacent_slices(box.lens_type.measurements for box in self.boxes)

    @property
    def entries(self) -> int:
        """Number of entries of H, if it were stored."""
        return sum(int(box.down.shares.nnz) * int(box.across.shares.nnz) for box in self.boxes)

    def forward(self, image: FloatArray) -> FloatArray:
        """H f: (N,) or (rows, columns) to (M,)."""
        grid = np.ascontiguousarray(image, dtype=np.float64).reshape(self.camera.shape)
        out = np.empty(self.camera.measurements)
        for box, pixels in zip(self.boxes, self.slices, strict=True):
            box.forward(grid, out[pixels])
        return out

    def adjoint(self, measurements: FloatArray) -> FloatArray:
        """H^T g: (M,) to (N,)."""
        out = np.zeros(self.camera.shape)
        readings = np.ascontiguousarray(measurements, dtype=np.float64)
        for box, pixels in zip(self.boxes, self.slices, strict=True):
            box.adjoint(readings[pixels], out)
        return out.ravel()

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """A key that is equal for two windows only if their submatrices are equal."""
        return tuple((_pattern(box.down, rows), _pattern(box.across, columns)) for box in self.boxes)

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Indices of the measurements that see nothing outside a window of f: (m,)."""
        pairs = zip(self.slices, self.boxes, strict=True)
        return np.concatenate([pixels.start + box.measurements_inside(rows, columns) for pixels, box in pairs])

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H from the window to the measurements inside it: (m, pixels of the window)."""
        return sparse.csr_array(sparse.vstack([box.submatrix(rows, columns) for box in self.boxes], format="csr"))


def designed_box(shape: tuple[int, int], lens_type: LensType) -> Box:
    """H of a lens type as designed, on a target of this shape."""
    return Box(lens_type, _axis(shape[0], lens_type, 0), _axis(shape[1], lens_type, 1))


def _axis(size: int, lens_type: LensType, axis: int) -> BoxAxis:
    ratio, pixels = lens_type.ratio, lens_type.pixels[axis]
    parts = [overlap(ratio, pixels, start, size) for start in lens_type.starts(axis)]
    return BoxAxis(sparse.csr_array(sparse.vstack(parts, format="csr")))


def _inside(axis: BoxAxis, window: slice) -> IntArray:
    """Indices of the intervals that lie in a window as a whole, sorted by their first pixel."""
    first = axis.shares.indices[axis.shares.indptr[:-1]]
    last = axis.shares.indices[axis.shares.indptr[1:] - 1]
    inside = np.flatnonzero((first >= window.start) & (last < window.stop))
    return inside[np.argsort(first[inside], kind="stable")]


def _pattern(axis: BoxAxis, window: slice) -> bytes:
    shares = axis.shares[_inside(axis, window)]
    return shares.indptr.tobytes() + (shares.indices - window.start).tobytes() + shares.data.tobytes()


def by_rows(rows: int, work: Callable[[int, int], None]) -> None:
    """Run `work` on ranges of rows, which do not depend on the number of threads, on all processors."""
    tasks = [(first, min(first + ROWS_AT_ONCE, rows)) for first in range(0, rows, ROWS_AT_ONCE)]
    if len(tasks) == 1:
        work(*tasks[0])
        return
    with ThreadPoolExecutor(processors()) as threads:
        for _ in threads.map(work, *zip(*tasks, strict=True)):
            pass
