"""Index of refraction as a function of the wavelength, by the formulas of Zemax's glass catalogues.

w is the wavelength in micrometres, c the coefficients in the order of a catalogue's line CD:

    1  Schott            n^2 = c0 + c1 w^2 + c2 w^-2 + c3 w^-4 + c4 w^-6 + c5 w^-8
    2  Sellmeier 1       n^2 = 1 + c0 w^2 / (w^2 - c1) + c2 w^2 / (w^2 - c3) + c4 w^2 / (w^2 - c5)
    3  Herzberger        n = c0 + c1 L + c2 L^2 + c3 w^2 + c4 w^4 + c5 w^6, L = 1 / (w^2 - 0.028)
    4  Sellmeier 2       n^2 = 1 + c0 + c1 w^2 / (w^2 - c2^2) + c3 / (w^2 - c4^2)
    5  Conrady           n = c0 + c1 / w + c2 / w^3.5
    6  Sellmeier 3       as 2, with four terms
    7  Handbook 1        n^2 = c0 + c1 / (w^2 - c2) - c3 w^2
    8  Handbook 2        n^2 = c0 + c1 w^2 / (w^2 - c2) - c3 w^2
    9  Sellmeier 4       n^2 = c0 + c1 w^2 / (w^2 - c2) + c3 w^2 / (w^2 - c4)
    10 Extended          as 1, and + c6 w^-10 + c7 w^-12
    11 Sellmeier 5       as 2, with five terms
    12 Extended 2        as 1, and + c6 w^4 + c7 w^6
    13 Extended 3        n^2 = c0 + c1 w^2 + c2 w^4 + c3 w^-2 + c4 w^-4 + ... + c8 w^-12

Wavelengths are in millimetres, as all lengths; the index is that at the catalogue's temperature, in air.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, sqrt
from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from ommatid.runtime.errors import InputError

from ..tables.table import Table
from ..tables.units import Length, pair

HERZBERGER = 0.028  # pole of L, in square micrometres
COEFFICIENTS = 10
SELLMEIER_TERMS = {2: 3, 6: 4, 11: 5}
POWERS = {
    1: (0, 2, -2, -4, -6, -8),
    10: (0, 2, -2, -4, -6, -8, -10, -12),
    12: (0, 2, -2, -4, -6, -8, 4, 6),
    13: (0, 2, 4, -2, -4, -6, -8, -10, -12),
}
LEAST, LARGEST = 1.0, 10.0  # index of refraction


class Dispersion(Table):
    """A formula of the index of refraction, its coefficients, and the wavelengths between which it is valid."""

    formula: int = Field(ge=1, le=13, description="number of the formula in a Zemax glass catalogue; 2: Sellmeier's")
    coefficients: Annotated[tuple[float, ...], BeforeValidator(pair), Field(min_length=1, max_length=COEFFICIENTS)] = (
        Field(description="coefficients of the formula, of wavelengths in micrometres")
    )
    shortest: Length = Field(description="shortest wavelength of the formula's range")
    longest: Length = Field(description="longest wavelength of the formula's range")

    @model_validator(mode="after")
    def _check_range(self) -> Dispersion:
        if self.shortest > self.longest:
            raise ValueError(
                f"expected shortest of at most longest, got {self.shortest:.4g} and {self.longest:.4g} mm; swap them"
            )
        return self

    def index(self, wavelength: float, name: str = "the glass") -> float:
        """Return the index of refraction at a wavelength in mm.

        Raises InputError for a wavelength outside the range, and for coefficients that yield no index there.
        """
        if not self.shortest <= wavelength <= self.longest:
            raise InputError(
                f"the index of {name} is known from {self.shortest * 1e6:.0f} to {self.longest * 1e6:.0f} nm,"
                f" got a wavelength of {wavelength * 1e6:.4g} nm; give the surface an index of refraction instead"
            )
        try:
            value = _index(self.formula, self.coefficients, wavelength * 1e3)
        except (ValueError, OverflowError, ZeroDivisionError):
            value = inf
        if not LEAST <= value <= LARGEST:
            raise InputError(
                f"expected coefficients of {name} that yield an index from {LEAST:g} to {LARGEST:g} at"
                f" {wavelength * 1e6:.4g} nm, got {value:.4g}; correct them in the glass catalogue"
            )
        return value


def _index(formula: int, coefficients: Sequence[float], w: float) -> float:
    """Return the index of refraction at w micrometres; coefficients that are missing are 0."""
    c = [*coefficients, *[0.0] * (COEFFICIENTS - len(coefficients))]
    square = w**2
    if formula in POWERS:
        return sqrt(sum(a * w**power for a, power in zip(c, POWERS[formula], strict=False)))
    if formula in SELLMEIER_TERMS:
        terms = [(c[2 * n], c[2 * n + 1]) for n in range(SELLMEIER_TERMS[formula])]
        return sqrt(1 + sum(strength * square / (square - pole) for strength, pole in terms))
    if formula == 3:
        pole = 1 / (square - HERZBERGER)
        return c[0] + c[1] * pole + c[2] * pole**2 + c[3] * square + c[4] * square**2 + c[5] * square**3
    if formula == 4:
        return sqrt(1 + c[0] + c[1] * square / (square - c[2] ** 2) + c[3] / (square - c[4] ** 2))
    if formula == 5:
        return c[0] + c[1] / w + c[2] / w**3.5
    if formula == 7:
        return sqrt(c[0] + c[1] / (square - c[2]) - c[3] * square)
    if formula == 8:
        return sqrt(c[0] + c[1] * square / (square - c[2]) - c[3] * square)
    return sqrt(c[0] + c[1] * square / (square - c[2]) + c[3] * square / (square - c[4]))
