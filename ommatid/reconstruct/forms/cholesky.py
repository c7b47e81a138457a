"""Cholesky factor of a positive definite matrix scaled to a unit diagonal, with its condition number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from .form import NotSolvableError


@dataclass(frozen=True)
class Factor:
    """C C^T = D^-1 A D^-1 with D^2 the diagonal of A: (n, n) lower `root` and (n,) `scale`, the diagonal of D."""

    root: FloatArray
    scale: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        """Return A^-1 b: (n, q) to (n, q)."""
        scaled = right / self.scale[:, None]
        solution: FloatArray = linalg.cho_solve((self.root, True), scaled, overwrite_b=True, check_finite=False)
        return np.divide(solution, self.scale[:, None], out=solution)

    def inverse(self) -> FloatArray:
        """Return A^-1: (n, n)."""
        inverse, _ = linalg.lapack.dpotri(self.root, lower=1)
        lower = np.tril(inverse)
        full = lower + np.tril(lower, -1).T
        return full / self.scale[:, None] / self.scale


def factorise_positive(matrix: FloatArray) -> tuple[Factor, float]:
    """Factorise A, (n, n), in place; return the factor and the 1-norm condition number of the scaled matrix.

    Raises NotSolvableError if A is not positive definite in float64.
    """
    scale = np.sqrt(np.diagonal(matrix))
    if not (scale > 0).all():
        raise NotSolvableError("a measurement has neither signal nor noise")
    matrix /= scale[:, None]
    matrix /= scale
    norm = float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    try:
        root = linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise NotSolvableError("its matrix is not positive definite in double precision") from error
    reciprocal, _ = linalg.lapack.dpocon(root, norm, uplo="L") if scale.size else (1.0, 0)
    # The last digits of LAPACK's estimate depend on memory alignment; rounding makes runs reproducible.
    return Factor(root, scale), float(f"{1 / reciprocal:.6g}") if reciprocal > 0 else float("inf")
