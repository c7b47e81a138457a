"""A form whose every answer is corrected until the certificate is content: the last resort of the estimator.

Where rows and columns of H are of very different size at once, a factorisation in float64 may keep few digits of the
least variances and yet enough for corrections to converge. It costs many solutions a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..forms.form import Form, Matrix, Vector
from .certificate import exact_variances, refine
from .double_double import exact
from .residuals import ExactResiduals

CHUNK = 256


@dataclass(frozen=True)
class RefinedForm(Form):
    """Another form's solutions, refined."""

    form: Form
    exactly: ExactResiduals

    name: ClassVar[str] = "corrected"

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """What refinement makes of the other form's solution."""
        refined = refine(self.form, self.exactly, shift, exact(residual))
        return refined.freedoms, refined.multipliers

    @cached_property
    def _variances(self) -> tuple[Vector, Vector]:
        pixels = np.arange(self.problem.unknowns)
        blocks = [pixels[start : start + CHUNK] for start in range(0, pixels.size, CHUNK)]
        values, doubts = zip(*(exact_variances(self.form, self.exactly, block) for block in blocks), strict=True)
        return np.maximum(np.concatenate(values), 0.0), np.concatenate(doubts)

    def variance(self) -> Vector:
        """To the last digit that the other form's corrections converge to."""
        return self._variances[0]

    @property
    def variance_error(self) -> float:
        """A bound on the relative error of every posterior variance."""
        variance, doubt = self._variances
        doubt = np.where(doubt >= 0, doubt, np.inf)  # NaN is a doubt, too
        return float(np.divide(doubt, variance, out=np.where(doubt > 0, np.inf, 0.0), where=variance > 0).max())
