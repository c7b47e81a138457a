"""Index of refraction of glasses and plastics by name.

Six are built in, by Sellmeier's equation. Sources:

- N-BK7, N-F2, N-SF11: SCHOTT, optical glass data sheets.
- fused silica: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965).
- PMMA, polycarbonate: N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009), one term.

All were measured in air, and lenses are in air, so the index of air is 1. Wavelengths are in millimetres. Other glasses
come from a catalogue, whose dispersion a surface then holds.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from ommatid.runtime.errors import InputError, shortened

from ..constants import GREEN
from ..optics.dispersion import Dispersion
from .camera import Surface

AIR = "air"
ALIASES = {
    "F_SILICA": "fused silica",
    "SILICA": "fused silica",
    "ACRYLIC": "PMMA",
    "POLYCARB": "polycarbonate",
}  # Zemax's


def _sellmeier(*coefficients: float, shortest: float, longest: float) -> Dispersion:
    """Return the dispersion by Sellmeier's terms B1, C1, B2, C2, ..., C in square micrometres, between two lengths."""
    return Dispersion.model_construct(formula=2, coefficients=coefficients, shortest=shortest, longest=longest)


GLASSES = {
    "N-BK7": _sellmeier(
        1.03961212, 0.00600069867, 0.231792344, 0.0200179144, 1.01046945, 103.560653, shortest=300e-6, longest=2500e-6
    ),
    "N-F2": _sellmeier(
        1.39757037, 0.00995906143, 0.159201403, 0.0546931752, 1.2686543, 119.248346, shortest=365e-6, longest=2500e-6
    ),
    "N-SF11": _sellmeier(
        1.73759695, 0.013188707, 0.313747346, 0.0623068142, 1.89878101, 155.23629, shortest=370e-6, longest=2500e-6
    ),
    "fused silica": _sellmeier(
        *(0.6961663, 0.0684043**2, 0.4079426, 0.1162414**2, 0.8974794, 9.896161**2), shortest=210e-6, longest=3710e-6
    ),
    "PMMA": _sellmeier(1.1819, 0.011313, shortest=436.8e-6, longest=1052e-6),
    "polycarbonate": _sellmeier(1.4182, 0.021304, shortest=436.8e-6, longest=1052e-6),
}


def index(name: str, wavelength: float = GREEN) -> float:
    """Index of refraction of a built-in glass, or of air, 1, at a wavelength in mm.

    Raises InputError for an unknown name, and for a wavelength outside the glass's measured range.
    """
    if name == AIR:
        return 1.0
    check(name)
    return GLASSES[name].index(wavelength, name)


def index_behind(surface: Surface, wavelength: float = GREEN) -> float:
    """Index of refraction behind a surface at a wavelength in mm; raises InputError as `index` does."""
    if surface.dispersion is not None:
        return surface.dispersion.index(wavelength, shortened(surface.glass or "the glass"))
    return surface.index or index(surface.glass or AIR, wavelength)


def spelling(name: str, known: Iterable[str]) -> str | None:
    """Return a name as it is known, itself or else in other cases of its letters; None if it is not."""
    names = list(known)
    return name if name in names else next((other for other in names if other.casefold() == name.casefold()), None)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that resembles a name most, None if none does."""
    folded = {other.casefold(): other for other in reversed(list(known))}
    near = difflib.get_close_matches(name.casefold()[:80], folded, n=1)
    return folded[near[0]] if near else None


def check(name: str) -> None:
    """Raise InputError, with the nearest known name, unless the glass is built in."""
    known = [AIR, *GLASSES]
    if name in known:
        return
    near = nearest(name, known)
    advice = f"did you mean '{near}'?" if near else "name its catalogue as camera.glass_catalogue"
    raise InputError(f"expected a glass among {', '.join(known)}, got '{shortened(name)}'; {advice}")
