"""Detail finer than f where the exact moments are too large: each pixel's world is predicted from its neighbourhood.

B of `world_prior` decays within a few pixels of f. Here a pixel of the world is predicted from a window of NEIGHBOURS x
WINDOW pixels of f around it, moved inwards at the edges of the image: B of an image of that size serves them all. What
a measurement leaves unexplained has the variance z^T P z with z = h - A^T g, h its row of H and g that of G: for any
prediction, the best or not, this is right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.processors import processors

from .world_prior import WorldPrior, averaging

NEIGHBOURS = 5  # pixels of f, odd
VALUES = 2**24  # of the patches that are transformed at once


def local_interpolation(prior: WorldPrior, window: WorldPrior) -> sparse.csr_array:
    """Return B, (pixels of the world, N), each row from the neighbourhood of its pixel.

    window : the same prior for an image of at most NEIGHBOURS x NEIGHBOURS pixels
    """
    detail, weights = prior.detail, window.interpolation
    fine, sides = prior.fine_shape, window.shape
    starts = [np.clip(np.arange(n) - side // 2, 0, n - side) for n, side in zip(prior.shape, sides, strict=True)]
    pixels = [np.arange(size) // detail for size in fine]
    first = [start[pixel] for start, pixel in zip(starts, pixels, strict=True)]
    inside = [np.arange(size) - detail * start for size, start in zip(fine, first, strict=True)]
    row = inside[0][:, None] * (sides[1] * detail) + inside[1][None, :]  # of `weights`
    down, across = np.divmod(np.arange(sides[0] * sides[1]), sides[1])
    corner = first[0][:, None] * prior.shape[1] + first[1][None, :]
    columns = corner.ravel()[:, None] + (down * prior.shape[1] + across)[None, :]
    indptr = np.arange(fine[0] * fine[1] + 1) * weights.shape[1]
    shape = fine[0] * fine[1], prior.shape[0] * prior.shape[1]
    matrix = sparse.csr_array((weights[row.ravel()].ravel(), columns.ravel(), indptr), shape=shape)
    matrix.sum_duplicates()
    return matrix


def unexplained_variance(prior: WorldPrior, fine: sparse.csr_array, coarse: sparse.csr_array) -> FloatArray:
    """Return z^T P z with z = h - A^T g of every measurement: (M,).

    fine : rows h of H on the world's grid;  coarse : rows g of G on f's
    """
    left = sparse.csr_array(fine - coarse @ averaging(prior.shape, prior.detail))
    left.eliminate_zeros()
    variance = np.zeros(fine.shape[0])
    for batch in _batches(left, prior.fine_shape):
        shape = batch.rows * 2, batch.columns * 2
        spectrum = fft.rfft2(_central_lags(prior.lags, shape)).real
        patches = np.zeros((batch.measurements.size, *shape))
        patches[batch.number, batch.row, batch.column] = batch.values
        power = np.square(np.abs(fft.rfft2(patches, workers=processors())))
        weight = np.full(power.shape[-1], 2.0)
        weight[0] = weight[-1] = 1.0  # their waves have no partner of negative frequency
        variance[batch.measurements] = np.einsum("nij,ij,j->n", power, spectrum, weight) / (shape[0] * shape[1])
    return np.maximum(variance, 0.0)


@dataclass(frozen=True)
class _Batch:
    """Rows of a matrix on patches of one size: the number of each entry's patch, its place there, and its value."""

    measurements: IntArray
    rows: int
    columns: int
    number: IntArray
    row: IntArray
    column: IntArray
    values: FloatArray


def _batches(matrix: sparse.csr_array, shape: tuple[int, int]) -> Iterator[_Batch]:
    """Yield the rows of a matrix that have entries, in patches as large as the largest among some of similar size."""
    row, column = np.divmod(matrix.indices.astype(np.int64), shape[1])
    filled = np.flatnonzero(np.diff(matrix.indptr))
    starts = matrix.indptr[filled].astype(np.int64)
    if not filled.size:
        return
    extents: list[IntArray] = []
    for index in (row, column):
        first, last = np.minimum.reduceat(index, starts), np.maximum.reduceat(index, starts)
        extents += [first, last - first + 1]
    top, height, left, width = extents
    order = np.argsort(height * width, kind="stable")
    while order.size:
        # The largest of a batch comes last; it grows until the patches fill the memory allowed for it.
        area = np.maximum.accumulate(height[order]) * np.maximum.accumulate(width[order]) * 4
        count = max(1, int(np.searchsorted(area * np.arange(1, order.size + 1), VALUES)))
        chosen, order = order[:count], order[count:]
        sizes = np.diff(matrix.indptr)[filled[chosen]].astype(np.int64)
        before = np.repeat(np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
        entries: IntArray = np.repeat(starts[chosen], sizes) + np.arange(int(sizes.sum())) - before
        number = np.repeat(np.arange(chosen.size), sizes)
        yield _Batch(
            filled[chosen],
            int(fft.next_fast_len(int(height[chosen].max()), real=True)),
            int(fft.next_fast_len(int(width[chosen].max()), real=True)),
            number,
            row[entries] - np.repeat(top[chosen], sizes),
            column[entries] - np.repeat(left[chosen], sizes),
            matrix.data[entries],
        )


def _central_lags(lags: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the table of lags for patches of half of `shape`, from that of a larger image or a smaller one."""
    rows, columns = (
        np.where(np.arange(size) < size // 2, np.arange(size), np.arange(size) - size) % known
        for size, known in zip(shape, lags.shape, strict=True)
    )
    return lags[rows[:, None], columns[None, :]]
