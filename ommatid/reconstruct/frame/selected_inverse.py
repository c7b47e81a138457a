"""The diagonal of the inverse of a large sparse matrix without the inverse (Takahashi, Fagan and Chin 1973).

The matrix is block tridiagonal and positive definite. A forward sweep eliminates the blocks (block Cholesky), a
backward sweep computes the diagonal blocks of the inverse.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.processors import one_thread

from .stencil import Stencil, half_offsets

Places = NDArray[np.intp]


def inverse_diagonal(count: int, block: Callable[[int, int], FloatArray]) -> FloatArray:
    """Return the diagonal of the inverse of `count` x `count` blocks; `block` gives the diagonal and upper blocks.

    Of a diagonal block only the upper triangle is read. Raises LinAlgError if the matrix is not positive definite.
    """
    inverses: list[FloatArray] = []
    links: list[FloatArray] = []
    for index in range(count):
        diagonal = block(index, index)
        if index:
            link = block(index - 1, index)
            links.append(inverses[-1] @ link)
            diagonal = diagonal - link.T @ links[-1]
        inverses.append(_inverse(diagonal))
    covariance = inverses[-1]
    variances = [np.diagonal(covariance)]
    for index in range(count - 2, -1, -1):
        covariance = inverses[index] + links[index] @ covariance @ links[index].T
        variances.append(np.diagonal(covariance))
    return np.concatenate(variances[::-1])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite matrix from its upper triangle."""
    factor, failed = linalg.lapack.dpotrf(matrix.T, lower=1, clean=0)  # the transpose is in Fortran's order
    inverse, singular = linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed or singular:
        raise linalg.LinAlgError("the precision of a part of the frame is singular in float64")
    lower = np.tril(inverse, -1)
    return lower + lower.T + np.diag(np.diagonal(inverse))


def stencil_variances(stencil: Stencil) -> FloatArray:
    """Return the diagonal of the inverse of K of a rectangle, (rows, columns), by blocks of `reach` of its rows."""
    rows, columns = stencil.values.shape[1:]
    high = max(stencil.reach, 1)
    blocks = _StencilBlocks(stencil, high)
    diagonal = inverse_diagonal(-(-rows // high), blocks)
    return diagonal[: rows * columns].reshape(rows, columns)


class _StencilBlocks:
    """Dense blocks of K: `high` lines of a rectangle each; lines beyond the last are independent of all others."""

    def __init__(self, stencil: Stencil, high: int) -> None:
        self.values, self.high = stencil.values, high
        self.columns = stencil.values.shape[2]
        self.places = self._places(stencil.reach)

    def __call__(self, row: int, column: int) -> FloatArray:
        """Return the diagonal block (upper triangle) or the block right of it: (high columns, high columns)."""
        side = self.high * self.columns
        source, target = self.places[column - row]
        part = self.values[:, row * self.high : (row + 1) * self.high]
        missing = self.high - part.shape[1]
        if missing:
            part = np.pad(part, ((0, 0), (0, missing), (0, 0)))
            part[0, -missing:] = 1.0
        block = np.zeros(side * side)
        block[target] = part.ravel()[source]
        return block.reshape(side, side)

    def _places(self, reach: int) -> tuple[tuple[Places, Places], tuple[Places, Places]]:
        """Return, for both kinds of block, the places of entries in the stencil's lines and in the block."""
        high, columns = self.high, self.columns
        sources: tuple[list[Places], list[Places]] = [], []
        targets: tuple[list[Places], list[Places]] = [], []
        for number, (down, across) in enumerate(half_offsets(reach)):
            begin = np.asarray(range(max(0, -across), min(columns, columns - across)), dtype=np.intp)
            for line in range(high):
                kind, other = divmod(line + down, high)
                sources[kind].append((number * high + line) * columns + begin)
                targets[kind].append((line * columns + begin) * high * columns + other * columns + begin + across)
        first, second = ((np.concatenate(a), np.concatenate(b)) for a, b in zip(sources, targets, strict=True))
        return first, second


def whole_variances(precision: sparse.csr_array, shape: tuple[int, int], reach: int) -> FloatArray:
    """Return the diagonal of K^-1 for the pixels of a frame, (rows, columns), from one sweep over all of it.

    reach : largest distance, in rows and in columns, of pixels that K couples
    Use it where errors are correlated over any distance.
    """
    numbers: NDArray[np.intp] = np.arange(shape[0] * shape[1]).reshape(shape)
    upright = shape[1] <= shape[0]
    ordered = numbers if upright else numbers.T
    blocks = [ordered[first : first + max(reach, 1)].ravel() for first in range(0, ordered.shape[0], max(reach, 1))]
    with one_thread():
        variances = inverse_diagonal(
            len(blocks), lambda row, column: precision[blocks[row]][:, blocks[column]].toarray()
        ).reshape(ordered.shape)
    return variances if upright else variances.T
