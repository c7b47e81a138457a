"""The expected error (Eq. 5) of every pixel of a frame of independent pixels from one sweep over it.

In blocks of lines K is block tridiagonal, and the diagonal of its inverse needs no inverse of its size (Takahashi,
Fagan and Chin 1973): a forward sweep eliminates the blocks (block Cholesky), a backward sweep computes the diagonal
blocks of the inverse. The terms of Eq. 5 are derivatives of that diagonal. It serves narrow frames of any length, and
small ones where errors are correlated over any distance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import one_thread

STEP = 1e-4  # relative step of a finite difference, and the largest relative error it causes


def swept_maps(
    matrix: sparse.csr_array, weights: FloatArray, ratios: FloatArray, prior: float, shape: tuple[int, int], reach: int
) -> FloatArray:
    """Return the diagonals of C, C P0^-1 C and C S C: (3, rows, columns).

    S is H^T Rv^-1 Rvm Rv^-1 H, Rvm the actual noise; the last two are derivatives of the diagonal of
    (K + s P0^-1 + t S)^-1. If Rvm is Rv the last is the rest of C.

    matrix : (M, N) H;  weights : (M,) 1 / Rv;  ratios : (M,) Rvm / Rv;  prior : 1 / P0
    reach : rows or columns that a measurement spans
    """
    largest = float(ratios.max()) or 1.0

    def perturbed(by_prior: float, by_noise: float) -> FloatArray:
        changed = weights * (1 + by_noise * ratios / largest)
        information = matrix.T @ sparse.csr_array(matrix.multiply(changed[:, None]))
        diagonal = (1 + by_prior) * prior * sparse.eye_array(matrix.shape[1], format="csr")
        return whole_variances(sparse.csr_array(information + diagonal), shape, reach - 1)

    posterior = perturbed(0.0, 0.0)
    missing = (posterior - perturbed(STEP, 0.0)) / STEP
    if np.allclose(ratios[weights > 0], 1.0, rtol=1e-12):
        return np.array([posterior, missing, posterior - missing])
    return np.array([posterior, missing, largest * (perturbed(0.0, -STEP) - perturbed(0.0, STEP)) / (2 * STEP)])


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
