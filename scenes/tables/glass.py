"""Index of refraction of glasses and plastics by name, after Sellmeier's equation.

n^2 = 1 + sum over k of B_k w^2 / (w^2 - C_k), w the wavelength in vacuum in micrometres. Sources:

- N-BK7, N-F2, N-SF11: SCHOTT, optical glass data sheets.
- fused silica: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965).
- PMMA, polycarbonate: N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009), one term.

All were measured in air, and lenses stand in air, so its index is 1. Wavelengths are millimetres, as all lengths are.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from math import sqrt

from ommatid.runtime.errors import InputError

from ..constants import GREEN

AIR = "air"


@dataclass(frozen=True)
class Dispersion:
    """Sellmeier's terms (B, C in square micrometres) and the wavelengths, in mm, between which they hold."""

    terms: tuple[tuple[float, float], ...]
    shortest: float
    longest: float


GLASSES = {
    "N-BK7": Dispersion(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), 300e-6, 2500e-6
    ),
    "N-F2": Dispersion(
        ((1.39757037, 0.00995906143), (0.159201403, 0.0546931752), (1.2686543, 119.248346)), 365e-6, 2500e-6
    ),
    "N-SF11": Dispersion(
        ((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)), 370e-6, 2500e-6
    ),
    "fused silica": Dispersion(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)), 210e-6, 3710e-6
    ),
    "PMMA": Dispersion(((1.1819, 0.011313),), 436.8e-6, 1052e-6),
    "polycarbonate": Dispersion(((1.4182, 0.021304),), 436.8e-6, 1052e-6),
}


def index(name: str, wavelength: float = GREEN) -> float:
    """Index of refraction of a glass, or of air, 1, at a wavelength in mm.

    Raises InputError for an unknown name, and for a wavelength at which the glass was not measured.
    """
    if name == AIR:
        return 1.0
    check(name)
    found = GLASSES[name]
    if not found.shortest <= wavelength <= found.longest:
        raise InputError(
            f"the index of {name} is known from {found.shortest * 1e6:.0f} to {found.longest * 1e6:.0f} nm, got a"
            f" wavelength of {wavelength * 1e6:.4g} nm; give the surface an index of refraction instead of a glass"
        )
    square = (wavelength * 1e3) ** 2
    return sqrt(1 + sum(strength * square / (square - pole) for strength, pole in found.terms))


def check(name: str) -> None:
    """Raise InputError unless a glass of that name is known."""
    known = [AIR, *GLASSES]
    if name in known:
        return
    folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.4)
    meant = f"; did you mean '{folded[near[0]]}'?" if near else ""
    raise InputError(
        f"expected a glass of {', '.join(known)}, got '{name}'{meant or '; give an index of refraction instead'}"
    )
