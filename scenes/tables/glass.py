"""Index of refraction of glasses and plastics by name, from Sellmeier's equation.

n^2 = 1 + sum over k of B_k w^2 / (w^2 - C_k), w the wavelength in vacuum in micrometres. Sources:

- N-BK7, N-F2, N-SF11: SCHOTT, optical glass data sheets.
- fused silica: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965).
- PMMA, polycarbonate: N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009), one term.

All were measured in air, and lenses are in air, so the index of air is 1. Wavelengths are in millimetres.
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
    """Sellmeier's terms (B, C in square micrometres) and the range of wavelengths, in mm, where they are valid."""

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

    Raises InputError for an unknown name, and for a wavelength outside the glass's measured range.
    """
    if name == AIR:
        return 1.0
    check(name)
    dispersion = GLASSES[name]
    if not dispersion.shortest <= wavelength <= dispersion.longest:
        raise InputError(
            f"the index of {name} is known from {dispersion.shortest * 1e6:.0f} to {dispersion.longest * 1e6:.0f} nm,"
            f" got a wavelength of {wavelength * 1e6:.4g} nm; give the surface an index of refraction instead"
        )
    square = (wavelength * 1e3) ** 2
    return sqrt(1 + sum(strength * square / (square - pole) for strength, pole in dispersion.terms))


def check(name: str) -> None:
    """Raise InputError, with the nearest known name, unless the glass is known."""
    known = [AIR, *GLASSES]
    if name in known:
        return
    folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.4)
    advice = f"did you mean '{folded[near[0]]}'?" if near else "give an index of refraction instead"
    raise InputError(f"expected a glass among {', '.join(known)}, got '{name}'; {advice}")
