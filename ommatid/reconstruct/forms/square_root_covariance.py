"""Square-root covariance form (array form): needs the inverse of neither P0 nor Rv.

One orthogonal triangularisation (Kailath, Sayed and Hassibi 2000, section 12.3)

    [ S      0 ]         [ C  K ]
    [ (HL)^T I ]  = Q    [ 0  T ]

gives the root C of H P0 H^T + Rv, the gain as K^T C^-T, and a root T^T of the posterior covariance of u.
T is rounded relative to the prior, so posterior variances far below the prior's lose half their digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem
from .form import Form, NotSolvableError, root_variance


@dataclass(frozen=True)
class SquareRootCovariance(Form):
    """C, (M, M) upper, K, (M, K), and T, (K, K) upper, of the array above; rows are divided by (M,) `scale`."""

    innovation: FloatArray
    cross: FloatArray
    posterior: FloatArray
    scale: FloatArray

    name: ClassVar[str] = "square-root-covariance"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = c + K^T C^-T (r - H L c) and l = C^-1 C^-T (r - H L c)."""
        scaled = (residual - self.problem.forward(shift)) / self.scale[:, None]
        white = linalg.solve_triangular(self.innovation, scaled, trans="T", check_finite=False)
        multiplier = linalg.solve_triangular(self.innovation, white, check_finite=False)
        return shift + self.cross.T @ white, multiplier / self.scale[:, None]

    def variance(self) -> FloatArray:
        """Return the diagonal of L T^T T L^T."""
        return root_variance(self.problem, self.posterior.T)


def square_root_covariance(problem: Problem) -> SquareRootCovariance:
    """Factorise in array form. Raises NotSolvableError if measurements without noise are linearly dependent."""
    dense = problem.dense_matrix()
    measurements, dimension = dense.shape
    scale = np.hypot(np.sqrt(np.square(dense).sum(axis=1)), problem.deviation)
    if not (scale > 0).all():
        raise NotSolvableError("a measurement has neither signal nor noise")
    array = np.zeros((measurements + dimension, measurements + dimension))
    array[:measurements, :measurements] = np.diag(problem.deviation / scale)
    array[measurements:, :measurements] = dense.T / scale
    array[measurements:, measurements:] = np.eye(dimension)
    qr: Any = linalg.qr
    triangle: FloatArray = qr(array, mode="r", overwrite_a=True, check_finite=False)[0]
    innovation = triangle[:measurements, :measurements]
    diagonal = np.abs(np.diagonal(innovation))
    condition = float(diagonal.max(initial=1.0) / max(diagonal.min(initial=1.0), np.finfo(np.float64).tiny))
    if condition * np.finfo(np.float64).eps * measurements > 1:
        raise NotSolvableError("measurements with too little noise are linearly dependent")
    cross, posterior = triangle[:measurements, measurements:], triangle[measurements:, measurements:]
    return SquareRootCovariance(problem, condition, innovation, cross, posterior, scale)
