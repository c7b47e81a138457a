"""Cholesky factor of a positive definite matrix that was scaled to a unit diagonal, with its condition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .form import Matrix, NotSolvableError, Vector


@dataclass(frozen=True)
class Factor:
    """C C^T = D^-1 A D^-1, D^2 the diagonal of A: (n, n) lower `root` and (n,) `scale`, the diagonal of D."""

    root: Matrix
    scale: Vector

    def solve(self, right: Matrix) -> Matrix:
        """A^-1 b: (n, q) to (n, q)."""
        scaled = right / self.scale[:, None]
        solved: NDArray[np.float64] = linalg.cho_solve((self.root, True), scaled, overwrite_b=True, check_finite=False)
        return np.divide(solved, self.scale[:, None], out=solved)

    def inverse(self) -> Matrix:
        """A^-1: (n, n)."""
        inverse, _ = linalg.lapack.dpotri(self.root, lower=1)
        lower = np.tril(inverse)
        full = lower + np.tril(lower, -1).T
        return full / self.scale[:, None] / self.scale


def factorise_positive(matrix: Matrix) -> tuple[Factor, float]:
    """Factorise A, (n, n), which is overwritten: its factor, and its condition in the 1-norm once scaled.

    Raises NotSolvableError where A is not positive definite in float64.
    """
    scale = np.sqrt(np.diagonal(matrix))
    if not (scale > 0).all():
        raise NotSolvableError("a measurement has neither signal nor noise")
    matrix /= scale[:, None]
    matrix /= scale
    size = float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    try:
        root = linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise NotSolvableError("its matrix is not positive definite in double precision") from error
    reciprocal, _ = linalg.lapack.dpocon(root, size, uplo="L") if scale.size else (1.0, 0)
    # An estimate, whose last digits depend on where in memory LAPACK sums: no two runs may differ by that.
    return Factor(root, scale), float(f"{1 / reciprocal:.6g}") if reciprocal > 0 else float("inf")
