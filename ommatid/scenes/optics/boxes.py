"""The ideal H without a matrix: every sensor pixel averages f over a box (Wood et al., section 2).

A box is a product of an interval of rows and one of columns, so that a lens type is two short tables. Overlaps of
intervals with pixels are computed in integers and are exact for any ratio.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray

from ..lens_type import LensType
from ..observation import Back, ObservationPart, Seen, on_lines, repetition

if TYPE_CHECKING:
    from ..camera import Camera

DIGITS = 12  # of shares that count as the same
SLOW = 100_000  # entries whose products take longer than starting a thread


def overlap(ratio: Fraction, pixels: int, start: Fraction, size: int, part: Fraction = Fraction(1)) -> sparse.csr_array:
    """Shares of `size` unit cells in `pixels` adjacent intervals of length `ratio` from `start` on: (pixels, size).

    part : of each interval, in its middle, that counts
    """
    first = start + ratio * (1 - part) / 2
    unit = lcm(*(each.denominator for each in (ratio, part * ratio, first)))
    pitch, length = int(ratio * unit), int(part * ratio * unit)
    lower = int(first * unit) + pitch * np.arange(pixels, dtype=np.int64)
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

    @property
    def width(self) -> int:
        """Largest number of pixels in an interval."""
        return int(np.diff(self.shares.indptr).max())


@dataclass(frozen=True)
class Box(ObservationPart):
    """H of a lens type or of a sub-imager: the Kronecker product of `down` and `across`, by measurements."""

    lens_type: LensType
    down: BoxAxis
    across: BoxAxis

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.down.shares.shape[1], self.across.shares.shape[1]

    @property
    def measurements(self) -> int:
        """Number of measurements."""
        return self.lens_type.measurements

    @property
    def entries(self) -> int:
        """Number of entries."""
        return int(self.down.shares.nnz) * int(self.across.shares.nnz)

    @property
    def reach(self) -> int:
        """Largest number of rows or of columns of f that a measurement spans."""
        return max(self.down.width, self.across.width)

    @property
    def is_slow(self) -> bool:
        """True of many entries."""
        return self.entries > SLOW

    def forward(self, seen: Seen, out: FloatArray) -> None:
        """Write H f to `out`, (measurements,)."""
        out[:] = self.lens_type.in_order(on_lines(self.down.shares, self.across.shares, seen.image))

    def adjoint(self, readings: FloatArray, back: Back) -> None:
        """Add H^T g to `back`; readings : (measurements,)."""
        back.add_image(self.down.shares.T @ (self.lens_type.by_lines(readings) @ self.across.shares))

    def to_sparse(self) -> sparse.csr_array:
        """Return H as a matrix: (measurements, N)."""
        intervals = np.arange(self.down.shares.shape[0]), np.arange(self.across.shares.shape[0])
        order = np.argsort(self.numbers(*intervals), kind="stable")
        return sparse.csr_array(sparse.kron(self.down.shares, self.across.shares, format="csr"))[order]

    def coarser(self, camera: Camera, detail: int) -> Box:
        """H of images of `detail` times larger pixels; camera : on their grid."""
        down, across = (
            BoxAxis(sparse.csr_array(axis.shares @ repetition(size, detail)))
            for axis, size in zip((self.down, self.across), camera.shape, strict=True)
        )
        for axis in (down, across):
            axis.shares.sort_indices()
        return Box(self.lens_type.finer(Fraction(1, detail)), down, across)

    def numbers(self, down: IntArray, across: IntArray) -> IntArray:
        """Indices of the measurements of all pairs of intervals along the two axes: (pairs,)."""
        k, i = np.divmod(down, self.lens_type.pixels[0])
        l, j = np.divmod(across, self.lens_type.pixels[1])  # noqa: E741
        sub_columns, (rows_each, columns_each) = self.lens_type.array[1], self.lens_type.pixels
        return (((k[:, None] * sub_columns + l) * rows_each + i[:, None]) * columns_each + j).ravel()

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Indices of the measurements inside a window of f, by their first pixel: (m,)."""
        return self.numbers(_inside(self.down, rows), _inside(self.across, columns))

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H from the window to the measurements inside it: (m, pixels of the window)."""
        down = self.down.shares[_inside(self.down, rows)][:, rows]
        across = self.across.shares[_inside(self.across, columns)][:, columns]
        return sparse.csr_array(sparse.kron(down, across, format="csr"))

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """A key that is equal for two windows only if their submatrices are, to `DIGITS`."""
        return _pattern(self.down, rows), _pattern(self.across, columns)


def designed_box(shape: tuple[int, int], lens_type: LensType) -> Box:
    """H of a lens type as designed, on a target of this shape."""
    down, across = (_axis(size, lens_type, axis) for axis, size in enumerate(shape))
    down.shares.data *= float(lens_type.light)
    return Box(lens_type, down, across)


def _axis(size: int, lens_type: LensType, axis: int) -> BoxAxis:
    ratio, pixels, starts = lens_type.ratio, lens_type.pixels[axis], lens_type.starts(axis)
    parts = [overlap(ratio, pixels, start, size, lens_type.open[axis]) for start in starts]
    return BoxAxis(sparse.csr_array(sparse.vstack(parts, format="csr")))


def _inside(axis: BoxAxis, window: slice) -> IntArray:
    """Indices of the intervals that lie in a window as a whole, sorted by their first pixel."""
    first = axis.shares.indices[axis.shares.indptr[:-1]]
    last = axis.shares.indices[axis.shares.indptr[1:] - 1]
    inside = np.flatnonzero((first >= window.start) & (last < window.stop))
    return inside[np.argsort(first[inside], kind="stable")]


def _pattern(axis: BoxAxis, window: slice) -> bytes:
    shares = axis.shares[_inside(axis, window)]
    data = shares.data.round(DIGITS)  # those of displaced intervals are rounded otherwise everywhere
    return shares.indptr.tobytes() + (shares.indices - window.start).tobytes() + data.tobytes()
