"""The diagonal of the inverse of a large sparse matrix without the inverse (Takahashi, Fagan and Chin 1973).

The matrix is block tridiagonal and positive definite. A forward sweep eliminates the blocks (block Cholesky), a
backward sweep computes the diagonal blocks of the inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.processors import one_thread, processors

CORE = 40  # columns of a frame whose variances come from one strip


def inverse_diagonal(count: int, block: Callable[[int, int], FloatArray]) -> FloatArray:
    """Return the diagonal of the inverse of `count` x `count` blocks; `block` gives the diagonal and upper blocks."""
    inverses: list[FloatArray] = []
    links: list[FloatArray] = []
    for index in range(count):
        diagonal = block(index, index)
        if index:
            link = block(index - 1, index)
            links.append(inverses[-1] @ link)
            diagonal = diagonal - link.T @ links[-1]
        inverses.append(np.asarray(linalg.inv(diagonal, check_finite=False)))
    covariance = inverses[-1]
    variances = [np.diagonal(covariance)]
    for index in range(count - 2, -1, -1):
        covariance = inverses[index] + links[index] @ covariance @ links[index].T
        variances.append(np.diagonal(covariance))
    return np.concatenate(variances[::-1])


def frame_variances(precision: sparse.csr_array, shape: tuple[int, int], reach: int, halo: int) -> FloatArray:
    """Return the diagonal of K^-1 for the pixels of a frame, (rows, columns), from strips of columns.

    reach : largest distance, in rows and in columns, of pixels that K couples
    halo : columns on each side of a strip; pixels beyond it are treated as known
    Strips are computed in parallel, each by one thread.
    """
    numbers: NDArray[np.intp] = np.arange(shape[0] * shape[1]).reshape(shape)
    upright = [(numbers, slice(first, min(first + CORE, shape[1]))) for first in range(0, shape[1], CORE)]
    # At an edge outside the field of some lens types errors are correlated over any distance along it: strips of rows.
    level = [(numbers.T, slice(0, min(CORE, shape[0]))), (numbers.T, slice(max(shape[0] - CORE, 0), shape[0]))]

    def variances(strip: tuple[NDArray[np.intp], slice]) -> FloatArray:
        return _strip_variances(precision, *strip, reach, halo)

    with one_thread(), ThreadPoolExecutor(processors()) as threads:
        parts = list(threads.map(variances, upright + level))
    variance = np.concatenate(parts[: len(upright)], axis=1)
    for (_, rows), part in zip(level, parts[len(upright) :], strict=True):
        variance[rows] = np.maximum(variance[rows], part.T)  # pixels beyond a strip count as known: none is too large
    return variance


def whole_variances(precision: sparse.csr_array, shape: tuple[int, int], reach: int) -> FloatArray:
    """Return the same from one strip, for errors that are correlated over any distance."""
    numbers: NDArray[np.intp] = np.arange(shape[0] * shape[1]).reshape(shape)
    upright = shape[1] <= shape[0]
    ordered = numbers if upright else numbers.T
    with one_thread():
        variances = _strip_variances(precision, ordered, slice(0, ordered.shape[1]), reach, 0)
    return variances if upright else variances.T


def _strip_variances(
    precision: sparse.csr_array, numbers: NDArray[np.intp], core: slice, reach: int, halo: int
) -> FloatArray:
    """Variances of the core's columns; `numbers`, (rows, columns), are the indices of the pixels in K."""
    rows, columns = numbers.shape
    wide = slice(max(core.start - halo, 0), min(core.stop + halo, columns))
    blocks = [numbers[first : first + max(reach, 1), wide].ravel() for first in range(0, rows, max(reach, 1))]

    def block(row: int, column: int) -> FloatArray:
        return precision[blocks[row]][:, blocks[column]].toarray()

    variances = inverse_diagonal(len(blocks), block).reshape(rows, wide.stop - wide.start)
    return variances[:, core.start - wide.start : core.stop - wide.start]
