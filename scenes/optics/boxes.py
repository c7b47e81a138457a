"""H of a perfect camera without a matrix: every sensor pixel averages f over a box (Wood et al., section 2).

A box is a product of an interval of rows and one of columns, so each lens type is two short tables. Overlaps of
intervals with pixels are computed in whole numbers and are exact for any ratio.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import lcm

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.processors import processors

from ..camera import Camera
from ..lens_type import LensType

Image = NDArray[np.float64]

ROWS_AT_ONCE = 64  # a piece of work for one thread; fixed, so that results do not depend on how many there are


def overlap(ratio: Fraction, pixels: int, start: Fraction, size: int) -> sparse.csr_array:
    """Shares, (pixels, size), of `size` unit cells in `pixels` intervals of length `ratio` that begin at `start`."""
    unit = lcm(ratio.denominator, start.denominator)
    length = int(ratio * unit)
    lower = int(start * unit) + length * np.arange(pixels, dtype=np.int64)
    width = -(-length // unit) + 1  # cells that an interval can touch
    cells = (lower // unit)[:, None] + np.arange(width)
    shared = np.minimum(lower[:, None] + length, (cells + 1) * unit) - np.maximum(lower[:, None], cells * unit)
    touched = (shared > 0) & (cells >= 0) & (cells < size)
    rows = np.broadcast_to(np.arange(pixels)[:, None], cells.shape)[touched]
    return sparse.csr_array((shared[touched] / length, (rows, cells[touched])), shape=(pixels, size))


@dataclass(frozen=True)
class BoxAxis:
    """One axis of a lens type: for each of its S = (sub-imagers) x (pixels) intervals the shares of pixels of f.

    shares : (S, size) CSR, sub-imagers one after the other, as measurements are ordered
    """

    shares: sparse.csr_array

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """The pixel of f at which each interval's shares begin, so that all of them lie on the axis: (S,)."""
        first = self.shares.indices[self.shares.indptr[:-1]].astype(np.int64)
        return np.minimum(first, self.shares.shape[1] - self._wide)

    @cached_property
    def share(self) -> Image:
        """Shares of the pixels from there on: (S, most that one touches)."""
        table = np.zeros((self.start.size, self._wide))
        rows = np.repeat(np.arange(self.start.size), np.diff(self.shares.indptr))
        table[rows, self.shares.indices - self.start[rows]] = self.shares.data
        return table

    @property
    def _wide(self) -> int:
        return int(np.diff(self.shares.indptr).max())

    @cached_property
    def order(self) -> NDArray[np.int64]:
        """Intervals by where they begin, so that neighbours in memory are used one after the other: (S,)."""
        return np.argsort(self.start, kind="stable")


@dataclass(frozen=True)
class Box:
    """All sub-imagers of one lens type: H is the Kronecker product of `down` and `across`, in another order of rows."""

    kind: LensType
    down: BoxAxis
    across: BoxAxis

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Rows and columns of sub-imagers, rows and columns of their pixels."""
        return (*self.kind.array, *self.kind.pixels)

    def forward(self, image: Image, out: Image) -> None:
        """H f: (rows, columns) to `out`, (measurements of the type,)."""
        from .box_kernels import average  # pyright: ignore[reportUnknownVariableType]

        down, across = self.down, self.across
        tables = (down.share, across.share)
        target = out.reshape(self.shape)
        _by_rows(
            down.start.size,
            lambda first, last: average(
                image, down.order, down.start, tables[0], across.start, tables[1], target, first, last
            ),
        )

    def adjoint(self, readings: Image, out: Image) -> None:
        """Add H^T g to `out`: (measurements of the type,) to (rows, columns)."""
        from .box_kernels import spread  # pyright: ignore[reportUnknownVariableType]

        down, across = self.down, self.across
        tables = (down.share, across.share)
        source = readings.reshape(self.shape)
        _by_rows(
            out.shape[0],
            lambda first, last: spread(
                source, down.order, down.start, tables[0], across.start, tables[1], out, first, last
            ),
        )

    def numbers(self, rows: slice, columns: slice) -> NDArray[np.int64]:
        """Which measurements see nothing but a window of f, by where they begin: (m,)."""
        k, i = np.divmod(_inside(self.down, rows), self.kind.pixels[0])
        l, j = np.divmod(_inside(self.across, columns), self.kind.pixels[1])  # noqa: E741
        _, wide, tall, broad = self.shape
        return (((k[:, None] * wide + l) * tall + i[:, None]) * broad + j).ravel()

    def part(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H of the window from these measurements: (m, pixels of the window)."""
        down = self.down.shares[_inside(self.down, rows)][:, rows]
        across = self.across.shares[_inside(self.across, columns)][:, columns]
        return sparse.csr_array(sparse.kron(down, across, format="csr"))


@dataclass(frozen=True)
class BoxFootprints:
    """H of all lens types of a perfect camera, applied without ever being stored."""

    camera: Camera

    @cached_property
    def boxes(self) -> tuple[Box, ...]:
        """One for each lens type."""
        camera = self.camera
        return tuple(Box(kind, _axis(kind, 0, camera.rows), _axis(kind, 1, camera.columns)) for kind in camera.types)

    @property
    def entries(self) -> int:
        """How many H would have if it were stored."""
        return sum(int(box.down.shares.nnz) * int(box.across.shares.nnz) for box in self.boxes)

    def forward(self, image: Image) -> Image:
        """H f: (N,) or (rows, columns) to (M,)."""
        grid = np.ascontiguousarray(image, dtype=np.float64).reshape(self.camera.shape)
        out = np.empty(self.camera.measurements)
        for box, place in zip(self.boxes, self.camera.type_slices(), strict=True):
            box.forward(grid, out[place])
        return out

    def adjoint(self, measurements: Image) -> Image:
        """H^T g: (M,) to (N,)."""
        out = np.zeros(self.camera.shape)
        readings = np.ascontiguousarray(measurements, dtype=np.float64)
        for box, place in zip(self.boxes, self.camera.type_slices(), strict=True):
            box.adjoint(readings[place], out)
        return out.ravel()

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """What two windows have in common whose `part` is the same."""
        return tuple((_pattern(box.down, rows), _pattern(box.across, columns)) for box in self.boxes)

    def measurements_inside(self, rows: slice, columns: slice) -> NDArray[np.int64]:
        """Which measurements see nothing but a window of f, by where they begin: (m,)."""
        places = zip(self.camera.type_slices(), self.boxes, strict=True)
        return np.concatenate([place.start + box.numbers(rows, columns) for place, box in places])

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H of the window from these measurements: (m, pixels of the window)."""
        return sparse.csr_array(sparse.vstack([box.part(rows, columns) for box in self.boxes], format="csr"))


def _axis(kind: LensType, axis: int, size: int) -> BoxAxis:
    starts = [kind.origin[axis] + number * kind.step for number in range(kind.array[axis])]
    parts = [overlap(kind.ratio, kind.pixels[axis], start, size) for start in starts]
    return BoxAxis(sparse.csr_array(sparse.vstack(parts, format="csr")))


def _inside(axis: BoxAxis, window: slice) -> NDArray[np.int64]:
    """Which intervals lie in a window as a whole, by where they begin."""
    first = axis.shares.indices[axis.shares.indptr[:-1]]
    last = axis.shares.indices[axis.shares.indptr[1:] - 1]
    chosen = np.flatnonzero((first >= window.start) & (last < window.stop))
    return chosen[np.argsort(first[chosen], kind="stable")]


def _pattern(axis: BoxAxis, window: slice) -> bytes:
    part = axis.shares[_inside(axis, window)]
    return part.indptr.tobytes() + (part.indices - window.start).tobytes() + part.data.tobytes()


def _by_rows(rows: int, work: Callable[[int, int], None]) -> None:
    pieces = [(first, min(first + ROWS_AT_ONCE, rows)) for first in range(0, rows, ROWS_AT_ONCE)]
    if len(pieces) == 1:
        work(*pieces[0])
        return
    with ThreadPoolExecutor(processors()) as threads:
        for _ in threads.map(work, *zip(*pieces, strict=True)):
            pass
