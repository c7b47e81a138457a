"""The diagonal of the inverse of a large sparse matrix, which itself is never formed (Takahashi, Fagan and Chin 1973).

The matrix is block tridiagonal and positive definite. Forwards each block is told of those before it (block Cholesky),
backwards of those behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.processors import one_thread, processors

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Numbers = NDArray[np.intp]

CORE = 40  # columns of a frame whose variances come from one strip of it


def inverse_diagonal(count: int, block: Callable[[int, int], Matrix]) -> Vector:
    """Of a matrix of `count` x `count` blocks; `block` gives those on the diagonal and right of it."""
    inverses: list[Matrix] = []
    links: list[Matrix] = []
    for number in range(count):
        own = block(number, number)
        if number:
            link = block(number - 1, number)
            links.append(inverses[-1] @ link)
            own = own - link.T @ links[-1]
        inverses.append(np.asarray(linalg.inv(own, check_finite=False)))
    covariance = inverses[-1]
    found = [np.diagonal(covariance)]
    for number in range(count - 2, -1, -1):
        covariance = inverses[number] + links[number] @ covariance @ links[number].T
        found.append(np.diagonal(covariance))
    return np.concatenate(found[::-1])


def frame_variances(precision: sparse.csr_array, shape: tuple[int, int], reach: int, halo: int) -> Matrix:
    """The diagonal of K^-1 for pixels of a frame, (rows, columns), from strips of columns.

    reach : rows, and columns, that K joins at most;  halo : columns beside a strip beyond which pixels are taken for
    known. Strips are computed side by side, each by one thread.
    """
    numbers: Numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    upright: list[tuple[Numbers, slice]] = [
        (numbers, slice(first, min(first + CORE, shape[1]))) for first in range(0, shape[1], CORE)
    ]
    # Along an edge that some lens types do not see errors go together over any distance: there strips lie along it.
    level = [(numbers.T, slice(0, min(CORE, shape[0]))), (numbers.T, slice(max(shape[0] - CORE, 0), shape[0]))]

    def work(strip: tuple[Numbers, slice]) -> Matrix:
        return _strip(precision, *strip, reach, halo)

    with one_thread(), ThreadPoolExecutor(processors()) as threads:
        parts = list(threads.map(work, upright + level))
    found = np.concatenate(parts[: len(upright)], axis=1)
    for (_, rows), part in zip(level, parts[len(upright) :], strict=True):
        found[rows] = np.maximum(found[rows], part.T)  # what is beyond a strip is taken for known: none is too large
    return found


def _strip(precision: sparse.csr_array, numbers: Numbers, core: slice, reach: int, halo: int) -> Matrix:
    """Variances of the columns of a core; `numbers` are those of the pixels, (rows, columns)."""
    rows, columns = numbers.shape
    wide = slice(max(core.start - halo, 0), min(core.stop + halo, columns))
    places = [numbers[first : first + max(reach, 1), wide].ravel() for first in range(0, rows, max(reach, 1))]

    def block(one: int, other: int) -> Matrix:
        return precision[places[one]][:, places[other]].toarray()

    variances = inverse_diagonal(len(places), block).reshape(rows, wide.stop - wide.start)
    return variances[:, core.start - wide.start : core.stop - wide.start]
