"""Diffraction of a circular pupil with defocus along a radius: what the rays of a thin lens are drawn from.

The wavefront in the pupil is defocused by `waves` wavelengths at its rim. The amplitude at the radius u of the pupil,
1 at its rim, is 1 / (1 + weight u^2), the square root of the cos^4 law, and the field in the plane of the target is

    U0(v) = integral of u exp(2 pi i waves u^2) J0(u v) / (1 + weight u^2) from 0 to 1,

v = pi aperture / (wavelength distance) times the distance from the chief ray (J. W. Goodman, Introduction to Fourier
Optics, sections 6.1 and 6.4; H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955)). In focus |U0|^2 is the Airy pattern. Seen
from a pixel off the lens's axis, one side of the pupil is brighter: its amplitude is 1 + s u cos(angle) / (1 + weight
u^2) times as large, and the pattern changes, to first order in s, by s cos(angle) times a function of v.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import ceil, pi, sqrt

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from ommatid.runtime.arrays import ComplexArray, FloatArray

TAIL = 0.005  # share of the light beyond the largest v; it falls as 2 / (pi v), so half of it needs twice the radius
QUANTILES = 2**16  # steps of the table of radii, each less than a ring of the pattern
FEWEST = 2**13  # radii from which quantiles are interpolated
STEP = 0.1  # of v, between which splines of fields are right to 1e-6 of the largest
AT_ONCE = 2**22  # Bessel functions


@dataclass(frozen=True)
class Pattern:
    """Point-spread function of a circular pupil, normalised to the light of the whole plane.

    fields : U0 and its change per s of v, from 0 to the largest v, beyond which a share of about TAIL is left
    weight : (aperture / 2 depth)^2
    """

    fields: CubicSpline[np.complex128]
    weight: float

    @property
    def end(self) -> float:
        """Largest v."""
        return float(self.fields.x[-1])

    def spread(self, v: FloatArray) -> FloatArray:
        """Return the light per unit of v."""
        even, _ = np.moveaxis(self.fields(v), -1, 0)
        return v * self._light * (even.real**2 + even.imag**2)

    def slant(self, v: FloatArray) -> FloatArray:
        """Return the change of the light per s and unit of v, in the direction of the brighter side."""
        even, odd = np.moveaxis(self.fields(v), -1, 0)
        return 2 * v * self._light * (even.real * odd.imag - even.imag * odd.real)

    @property
    def _light(self) -> float:
        return 2 * (1 + self.weight)  # 1 over the integral of u / (1 + weight u^2)^2, by Parseval that of v |U0|^2

    @cached_property
    def within(self) -> PPoly[np.float64]:
        """Share of the light within v."""
        return CubicSpline(self.fields.x, self.spread(self.fields.x)).antiderivative()

    @property
    def encircled(self) -> float:
        """Share of the light within the largest v."""
        return float(self.within(self.end))

    def quantiles(self, count: int = QUANTILES) -> FloatArray:
        """v that encircle the shares (0, 1/n, ... 1)^2 of the light within the largest v: (count + 1,)."""
        v = np.linspace(0.0, self.end, 2 * max(count, FEWEST) + 1)
        root = np.sqrt(np.maximum.accumulate(np.maximum(self.within(v) / self.encircled, 0.0)))
        return np.interp(np.linspace(0.0, 1.0, count + 1), root, v)

    def relative_slant(self, v: FloatArray) -> FloatArray:
        """Relative change of the pattern per s at v, in the direction of the brighter side."""
        light = self.spread(v)
        return np.divide(self.slant(v), light, out=np.zeros_like(light), where=light > 0)


def end_of(waves: float) -> float:
    """v beyond which a uniform pupil leaves the share TAIL, from the waves that its rim diffracts."""
    # Beyond the disk of rays, which ends at e = 4 pi waves, the share outside v is (2 / pi) v / (v^2 - e^2).
    return 1 / (pi * TAIL) + sqrt(1 / (pi * TAIL) ** 2 + (4 * pi * waves) ** 2)


@lru_cache(maxsize=256)
def pattern(waves: float, weight: float = 0.0) -> Pattern:
    """The point-spread function of a pupil with `waves` >= 0 of defocus.

    weight : (aperture / 2 depth)^2
    """
    end = end_of(waves)
    v = np.linspace(0.0, end, ceil(end / STEP) + 1)
    return Pattern(CubicSpline(v, np.stack(_fields(v, waves, weight), axis=-1)), weight)


def _fields(v: FloatArray, waves: float, weight: float) -> tuple[ComplexArray, ComplexArray]:
    """U0, and the integral of u^2 exp(2 pi i waves u^2) J1(u v) / (1 + weight u^2)^2: complex, shaped as v."""
    from scipy.special import j0, j1, roots_legendre

    x, w = roots_legendre(40 + ceil((v[-1] + 4 * pi * waves) / 2))
    u = (1 + x) / 2
    share = w / 2 * u / (1 + weight * u**2) * np.exp(2j * pi * waves * u**2)
    tilted = share * u / (1 + weight * u**2)
    size = max(1, AT_ONCE // u.size)
    parts = [np.outer(v[first : first + size], u) for first in range(0, v.size, size)]
    even, odd = (
        np.concatenate([np.asarray(bessel(part) @ values, dtype=np.complex128) for part in parts])
        for bessel, values in ((j0, share), (j1, tilted))
    )
    return even, odd
