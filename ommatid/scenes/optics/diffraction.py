"""Diffraction of a circular pupil with defocus: the point-spread function of a thin lens.

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
from functools import lru_cache
from math import ceil, pi, sqrt

import numpy as np

from ommatid.runtime.arrays import ComplexArray, FloatArray

from .radial_density import PanelPolynomials, RadialDensity, panel_nodes

TAIL = 0.005  # share of the light beyond the largest v; it falls as 2 / (pi v), so half of it needs twice the radius
MOST_WAVES = 100.0  # of defocus; beyond, the disk of rays describes the pattern
QUANTILES = 2**16  # steps of the table of radii, each less than a ring of the pattern
FEWEST = 2**13  # radii from which quantiles are interpolated
PANEL = 4.0  # growth of v over a panel
AT_ONCE = 2**22  # Bessel functions


@dataclass(frozen=True)
class Pattern:
    """Point-spread function of a circular pupil, normalised to the light of the whole plane.

    breaks : of v, which end where a share of about TAIL is left
    spread : light per unit of v;  slant : its change per s and unit of v, in the direction of the brighter side
    """

    breaks: FloatArray
    spread: PanelPolynomials
    slant: PanelPolynomials

    @property
    def end(self) -> float:
        """Largest v."""
        return float(self.breaks[-1])

    @property
    def encircled(self) -> float:
        """Share of the light within the largest v."""
        return float(self.spread.integral(np.array([self.end]))[0])

    def quantiles(self, count: int = QUANTILES) -> FloatArray:
        """v that encircle the shares (0, 1/n, ... 1)^2 of the light within the largest v: (count + 1,)."""
        v = np.linspace(0.0, self.end, 2 * max(count, FEWEST) + 1)
        root = np.sqrt(np.maximum.accumulate(np.maximum(self.spread.integral(v) / self.encircled, 0.0)))
        return np.interp(np.linspace(0.0, 1.0, count + 1), root, v)

    def relative_slant(self, v: FloatArray) -> FloatArray:
        """Relative change of the pattern per s at v, in the direction of the brighter side."""
        light = self.spread(v)
        return np.divide(self.slant(v), light, out=np.zeros_like(light), where=light > 0)

    def spread_density(self, airy: float) -> RadialDensity:
        """Density of displacements, where `airy` is the length of v = 1."""
        return RadialDensity(self.breaks * airy, lambda r: self.spread(r / airy) / airy, self.encircled)

    def slant_density(self, airy: float) -> RadialDensity:
        """The isotropic density whose derivative along an axis is the change per s towards that axis."""
        nodes, weights = panel_nodes(self.breaks)
        # The slant is 2 pi v k(v), k cos(angle) the change; the density is 2 pi v times minus the integral of k beyond.
        per_v = PanelPolynomials(self.breaks, self.slant(nodes) / nodes)
        values = -nodes * (per_v.integral(np.array([self.end])) - per_v.integral(nodes))
        kernel = PanelPolynomials(self.breaks, values)
        return RadialDensity(self.breaks * airy, lambda r: kernel(r / airy), airy * float(weights @ values))


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
    breaks = np.linspace(0.0, end, ceil(end / PANEL) + 1)
    v, _ = panel_nodes(breaks)
    even, odd = _fields(v, waves, weight)
    whole = 1 / (2 * (1 + weight))  # integral of u / (1 + weight u^2)^2, which by Parseval is that of v |U0|^2
    spread = v * (even.real**2 + even.imag**2) / whole
    slant = 2 * v * (even.real * odd.imag - even.imag * odd.real) / whole
    return Pattern(breaks, PanelPolynomials(breaks, spread), PanelPolynomials(breaks, slant))


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
