"""A form whose every solution is refined until the certificate accepts it: the last resort of the estimator.

If rows and columns of H both differ widely in size, a float64 factorisation may keep few digits of the smallest
variances and still suffice for refinement to converge. It costs many solutions per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..forms.form import Form
from .certificate import exact_variances, refine
from .double_double import exact
from .error_norms import last_digit
from .residuals import ExactResiduals

CHUNK = 256  # pixels solved together


@dataclass(frozen=True)
class RefinedForm(Form):
    """The refined solutions of another form."""

    form: Form
    residuals: ExactResiduals

    name: ClassVar[str] = "corrected"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the refined solution."""
        refined = refine(self.form, self.residuals, shift, exact(residual))
        return refined.coefficients, refined.multipliers

    @cached_property
    def _variances(self) -> tuple[FloatArray, FloatArray]:
        pixels = np.arange(self.problem.unknowns)
        blocks = [pixels[start : start + CHUNK] for start in range(0, pixels.size, CHUNK)]
        values, errors = zip(*(exact_variances(self.form, self.residuals, block) for block in blocks), strict=True)
        return np.maximum(np.concatenate(values), 0.0), np.concatenate(errors)

    def variance(self) -> FloatArray:
        """Return the refined posterior variances."""
        return self._variances[0]

    @property
    def description(self) -> str:
        """Name of the form that is refined."""
        return f"{self.form.name}, corrected"

    @property
    def variance_error(self) -> float:
        """A bound on the relative error of every posterior variance."""
        variance, error = self._variances
        error = np.where(error >= 0, error, np.inf)  # NaN counts as an unbounded error
        relative = np.divide(error, variance, out=np.where(error > 0, np.inf, 0.0), where=variance > 0)
        return float(relative.max(initial=0.0)) + last_digit(variance)
