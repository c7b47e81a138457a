"""Square-root information form: QR of the whitened rows B = S^-1 H L above the unit matrix that stands for the prior.

Nothing is squared, so twice the digits of the information form survive. Rows are sorted by size and columns pivoted,
so noise of very different size from one measurement to the next does no harm. Where H leaves a null space and the
noise is so small that the rounding of B outweighs the prior, it is wrong in silence, and the certificate must say so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..problem import Problem
from .form import Form, Matrix, NotSolvableError, Vector, multipliers, root_variance
from .sorted_qr import SortedQr, sorted_qr


@dataclass(frozen=True)
class SquareRootInformation(Form):
    """The QR of [B; I], (M + K, K), in `normal`."""

    normal: SortedQr

    name: ClassVar[str] = "square-root-information"

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """The least squares solution of B u = S^-1 r, u = c."""
        u = self.normal.solve(np.vstack([residual / self.problem.deviation[:, None], shift]))
        return u, multipliers(self.problem, u, residual)

    def variance(self) -> Vector:
        """The diagonal of L R^-1 R^-T L^T."""
        return root_variance(self.problem, self.normal.inverse())


def square_root_information(problem: Problem) -> SquareRootInformation:
    """Factorise in square-root information form. Raises NotSolvableError where a measurement has no noise."""
    if not problem.noisy:
        raise NotSolvableError("it needs noise in every measurement")
    stacked = np.vstack([problem.whitened(), np.eye(problem.prior.freedoms)])
    if not np.isfinite(stacked).all():
        raise NotSolvableError("its matrix leaves the range of double precision")
    normal = sorted_qr(stacked)
    return SquareRootInformation(problem, normal.condition, normal)
