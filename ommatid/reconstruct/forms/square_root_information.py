"""Square-root information form: QR of the whitened rows B = S^-1 H L stacked on the identity of the prior.

Nothing is squared, so it keeps twice the digits of the information form. Rows are sorted by size and columns pivoted,
so noise may differ widely between measurements. If H has a null space and the noise is so small that the rounding of B
outweighs the prior, the result is wrong without a warning; the certificate has to detect it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem
from .form import Form, multipliers, root_variance, whitened_matrix
from .sorted_qr import SortedQr, sorted_qr


@dataclass(frozen=True)
class SquareRootInformation(Form):
    """The QR decomposition of [B; I], (M + K, K), as `normal`."""

    normal: SortedQr

    name: ClassVar[str] = "square-root-information"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the least-squares solution of B u = S^-1 r, u = c, and its multipliers."""
        u = self.normal.solve(np.vstack([residual / self.problem.deviation[:, None], shift]))
        return u, multipliers(self.problem, u, residual)

    def variance(self) -> FloatArray:
        """Return the diagonal of L R^-1 R^-T L^T."""
        return root_variance(self.problem, self.normal.inverse())


def square_root_information(problem: Problem) -> SquareRootInformation:
    """Factorise in square-root information form. Raises NotSolvableError if a measurement has no noise."""
    normal = sorted_qr(np.vstack([whitened_matrix(problem), np.eye(problem.prior.dimension)]))
    return SquareRootInformation(problem, normal.condition, normal)
