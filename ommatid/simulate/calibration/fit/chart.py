"""The chart of a calibration: the few sensor pixels from whose rows of H a smooth map of the field follows.

A grid of at most 12 x 12 pixels, corners included, serves any sub-imager: with n pixels along a side the errors of
shift, magnification and rotation fall as 1/n, as fast as with all pixels and more samples in each, and twelve leave
280 degrees of freedom to the F test for what five numbers do not explain.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, special

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

SIDE = 12  # most pixels of a chart along a side of a sub-imager
SHARED = 650  # pixels of a chart that serve kernels, which all sub-imagers of a lens type share
LEAST_LIGHT = 1e-9  # of a pixel's rays, below which it has no centroid
BESIDE = 1  # pixels of f around what a pixel's rays meet, where a model may expect light too


def side_for_kernels(lens_type: LensType) -> int:
    """Return the most pixels along a side of a sub-imager in a chart for kernels."""
    return min(SIDE, max(2, round((SHARED / lens_type.count) ** 0.5)))


def chart_of(lens_type: LensType, whole: BoolArray | None = None, side: int = SIDE) -> IntArray:
    """Return the pixels of a lens type that are measured, by their number in the type, rising: (pixels,).

    whole : (sub-imagers,), True for those of which all pixels are measured;  side : most pixels of a chart along a side
    """
    rows, columns = (
        np.unique(np.linspace(0, size - 1, min(size, side)).round().astype(np.int64)) for size in lens_type.pixels
    )
    few = (rows[:, None] * lens_type.pixels[1] + columns).ravel()
    size = lens_type.pixels[0] * lens_type.pixels[1]
    if whole is None:
        return (np.arange(lens_type.count)[:, None] * size + few).ravel()
    return (np.flatnonzero(whole)[:, None] * size + np.arange(size)).ravel()


@dataclass(frozen=True)
class ChartRows:
    """Measured rows of H of one sub-imager, each in a window of f of the same size W x V.

    down, across : (pixels,) i and j in the sub-imager;  row, column : (pixels,) of f where the window begins
    values : (pixels, W, V);  batches : (batches, pixels, W, V) deviations
    """

    down: FloatArray
    across: FloatArray
    row: IntArray
    column: IntArray
    values: FloatArray
    batches: Float32Array

    @cached_property
    def light(self) -> FloatArray:
        """Share of a pixel's rays that meet the target: (pixels,)."""
        return self.values.sum(axis=(1, 2))

    @cached_property
    def known(self) -> BoolArray:
        """True for entries that were measured, (pixels, W, V), where each has noise."""
        return (self.batches != 0).any(axis=0)

    @cached_property
    def centroids(self) -> tuple[FloatArray, FloatArray]:
        """The centroids of the rows, in rows and columns of f: (pixels,) each."""
        nothing = np.zeros(self.row.size)
        down, across = (along[0] for along in self._along(self.values[None], (nothing, nothing)))
        return down, across

    @cached_property
    def batch_centroids(self) -> tuple[FloatArray, FloatArray]:
        """The deviations of the batches' centroids to first order: (batches, pixels), rows and columns of f."""
        down, across = self._along(self.batches, self.centroids)
        return down, across

    def _along(self, values: NDArray[np.floating], origin: Sequence[FloatArray]) -> Iterator[FloatArray]:
        """Yield moments of rows, (n, pixels, W, V), about an origin, relative to the light: (n, pixels) by axis."""
        light = np.maximum(self.light, LEAST_LIGHT)
        for axis, first in enumerate((self.row, self.column)):
            start: FloatArray = np.subtract(first, origin[axis]) + 0.5
            places = start[:, None] + np.arange(self.values.shape[1 + axis], dtype=np.float64)
            lines = np.asarray(values.sum(axis=3 - axis), dtype=np.float64)
            yield np.einsum("bpx,px->bp", lines, places) / light


def chart_rows(camera: Camera, lens_type: LensType, matrix: sparse.csr_array, batches: Float32Array) -> list[ChartRows]:
    """Return the measured rows of each sub-imager of a lens type.

    matrix : (measurements of the type, N), rows that were not measured, or got no light, are empty
    """
    size = lens_type.pixels[0] * lens_type.pixels[1]
    lit = np.flatnonzero(np.diff(matrix.indptr))
    starts, counts = matrix.indptr[lit].astype(np.int64), np.diff(matrix.indptr)[lit]
    cells = np.repeat(np.arange(lit.size), counts)
    where = np.divmod(matrix.indices.astype(np.int64), camera.columns)
    windows: list[tuple[IntArray, int]] = []
    for axis, indices in enumerate(where):
        first, last = (extreme.reduceat(indices, starts) for extreme in (np.minimum, np.maximum))
        width = min(int((last - first).max(initial=0)) + 1 + 2 * BESIDE, camera.shape[axis])
        windows.append((np.clip(first - BESIDE, 0, camera.shape[axis] - width), width))
    (row, high), (column, wide) = windows
    inside = (where[0] - row[cells]) * wide + where[1] - column[cells]
    dense = np.zeros((1 + len(batches), lit.size, high * wide))
    for layer, values in zip(dense, [matrix.data, *batches], strict=True):
        layer[cells, inside] = values
    dense = dense.reshape(1 + len(batches), lit.size, high, wide)
    ends = np.searchsorted(lit, size * np.arange(lens_type.count + 1))
    result: list[ChartRows] = []
    for first, last in pairwise(ends.tolist()):
        part = slice(first, last)
        down, across = (each.astype(np.float64) for each in np.divmod(lit[part] % size, lens_type.pixels[1]))
        result.append(
            ChartRows(down, across, row[part], column[part], dense[0, part], dense[1:, part].astype(np.float32))
        )
    return result


def freedom_of(gram: FloatArray) -> float:
    """Return the effective degrees of freedom (tr S)^2 / tr S^2 of the covariance S, from the Gram matrix of draws.

    tr S^2 without bias from few draws: Bai and Saranadasa 1996, Statistica Sinica 6, 311.
    """
    free = len(gram) - 1
    trace, square = float(np.trace(gram)) / free, float(np.square(gram).sum()) / free**2
    squares = free**2 / ((free - 1) * (free + 2)) * (square - trace**2 / free)
    if trace == 0:
        return 1.0
    return max(1.0, trace**2 / max(squares, trace**2 * 1e-9))


@dataclass(frozen=True)
class Explanation:
    """Weighted sum of squared residuals, its expectation from the batches, and the degrees of freedom of the sums."""

    left: float
    expected: float
    freedom: float
    batches: int

    @property
    def chance(self) -> float:
        """Probability of a sum of squares at least as large if the model is correct; 0 where nothing was measured."""
        if not self.expected:
            return 0.0
        return float(special.fdtrc(self.freedom, self.freedom * (self.batches - 1), self.left / self.expected))

    @property
    def excess(self) -> float:
        """The part of the sum of squares that is not noise, in units of the noise."""
        return self.left / self.expected - 1 if self.expected else 0.0

    @staticmethod
    def of(residuals: Iterable[FloatArray], floor: float = 0.0) -> Explanation:
        """Compare residuals of the mean, the first, with those of the batches; floor : added to the expectation."""
        flat = np.stack([each.ravel() for each in residuals])
        products = np.asarray(flat @ flat.T, dtype=np.float64)
        count, noise = len(flat) - 1, products[1:, 1:]
        expected = float(np.trace(noise)) / (count * (count - 1)) + floor
        return Explanation(float(products[0, 0]), expected, min(freedom_of(noise), float(flat.shape[1])), count)
