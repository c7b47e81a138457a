"""Files of Zemax: sequential lens files (.zmx) and glass catalogues (AGF), as glass makers publish them.

Lens files go from the object to the image, which is the order of a scene file, too. Spheres, conics and even aspheres
are read (STANDARD, EVENASPH), with curvature, thickness, semi-diameter, conic and glass. Curvatures have the sign used
here, positive if the centre lies towards the image. The object, the image and flat surfaces without glass on either
side are left out, unless they are the stop. The distance to the image is ignored, because the magnification determines
it. So are wavelengths, fields, the system aperture (the stop is as wide as its semi-diameter) and everything else that
is no surface.

A glass without a name, by its index nd and Abbe number vd (a "model" glass), has the index A + B / w^2 with that nd and
vd, from 400 to 700 nm; it differs from real glasses of the same nd and vd by some 1e-4 at 550 nm.

A glass of a catalogue begins with a line `NM name formula ...`; its line `CD` holds the coefficients of the formula,
and `LD` the shortest and the longest wavelength in micrometres. All other lines are ignored. A glass is checked when it
is used, so that a catalogue may hold glasses that cannot be read. Files are in UTF-16, UTF-8 or Latin-1, as programs of
several decades wrote them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.input_files import read_any_text

from ..optics.dispersion import COEFFICIENTS, Dispersion
from ..tables.camera import MOST_SURFACES, Surface
from ..tables.messages import validated

LARGEST = 2**24  # bytes; the largest catalogues of glass makers have one million
EXTREME = 1e9  # largest number


def number(word: str, where: str, what: str) -> float:
    """Convert a word of a file to a number. Raises InputError that begins with `where`."""
    try:
        value = float(word.replace(",", "."))  # some programs write the comma of their language
    except ValueError:
        value = float("nan")
    if not abs(value) <= EXTREME:
        raise InputError(f"{where}: expected {what}, a number of at most {EXTREME:g}, got '{shortened(word)}'")
    return value


@dataclass(frozen=True)
class Catalogue:
    """A glass catalogue: for each glass, by its name, the number of its line NM, and the words of NM, CD and LD."""

    path: Path
    entries: dict[str, tuple[int, dict[str, list[str]]]]

    def dispersion(self, name: str) -> Dispersion:
        """Return the dispersion of a glass of the catalogue. Raises InputError for a damaged entry."""
        line, words = self.entries[name]
        where = f"{self.path}, line {line}, glass {shortened(name)}"
        for keyword, fewest in (("NM", 2), ("CD", 1), ("LD", 2)):
            if len(words.get(keyword, [])) < fewest:
                raise InputError(f"{where}: expected a line {keyword} with {fewest} values or more, got fewer")
        formula = number(words["NM"][1], where, "the number of its formula")
        coefficients = [number(word, where, "a coefficient") for word in words["CD"][:COEFFICIENTS]]
        shortest, longest = (number(word, where, "a wavelength in micrometres") for word in words["LD"][:2])
        data = {
            "formula": int(formula),
            "coefficients": coefficients,
            "shortest": f"{shortest!r} um",
            "longest": f"{longest!r} um",
        }
        return validated(Dispersion, data, where)


def read_catalogue(path: Path) -> Catalogue:
    """Read a glass catalogue. Raises InputError that names the file."""
    entries: dict[str, tuple[int, dict[str, list[str]]]] = {}
    words: dict[str, list[str]] = {}
    for line, text in enumerate(read_any_text(path, "glass catalogue", LARGEST).splitlines(), start=1):
        keyword, *rest = text.split(maxsplit=1) or [""]
        if keyword == "NM" and rest:
            words = {"NM": rest[0].split()}
            entries.setdefault(words["NM"][0], (line, words))  # the first of two with the same name
        elif keyword in ("CD", "LD") and rest:
            words.setdefault(keyword, rest[0].split())
    if not entries:
        raise InputError(f"{path}: expected a glass catalogue (AGF) with lines 'NM name formula ...', got none")
    return Catalogue(path, entries)


MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "M": 1000.0, "METER": 1000.0}
ASPHERE = "EVENASPH"
KINDS = ("STANDARD", ASPHERE)
TERMS = 8  # of an even asphere, from r^2 on
REFUSED = {
    "SQAP": "a rectangular aperture",
    "ELAP": "an elliptical aperture",
    "OBSC": "an obscuration",
    "SPID": "a spider",
    "UDAD": "a drawn aperture",
    "OBDC": "a decentred aperture",
}
LEAST_ABBE, LARGEST_ABBE = 5, 200
FRAUNHOFER = {"F": 0.4861327, "d": 0.5875618, "C": 0.6562725}  # wavelengths in micrometres


@dataclass
class Lines:
    """The lines of one surface: the number of the first, and the words behind each keyword (PARM n counts as one)."""

    line: int
    words: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def value(self, keyword: str, where: str, default: float = 0.0) -> float:
        """Return the first number behind a keyword; `inf` for INFINITY."""
        words = self.words.get(keyword)
        if not words:
            return default
        return inf if words[0].upper() == "INFINITY" else number(words[0], where, keyword)


def read_zmx(path: Path) -> tuple[Surface, ...]:
    """Read the surfaces of a lens. Raises InputError that names the file, the surface and what is not supported."""
    unit, surfaces = _surfaces(read_any_text(path, "lens file", LARGEST), path)
    if len(surfaces) < 3:
        raise InputError(f"{path}: expected surfaces between the object and the image (SURF), got none")
    read: list[tuple[dict[str, float], dict[str, Any], str]] = []
    before: object = None
    for place, lines in enumerate(surfaces[1:-1], start=1):
        where = f"{path}, line {lines.line}, surface {place}"
        lengths, table = _surface(lines, where, unit)
        behind = table.get("glass") or table.get("dispersion") or table.get("index")  # None for air
        is_flat = not lengths["radius"] and "aspheric" not in table
        if before is None and behind is None and not table["stop"] and is_flat:  # it does nothing
            if read:
                read[-1][0]["thickness"] += lengths["thickness"]
        else:
            read.append((lengths, table, where))
        before = behind
    if not read:
        raise InputError(f"{path}: expected a lens, got flat surfaces without glass alone")
    read[-1][0]["thickness"] = 0.0
    return tuple(surface_of(lengths, table, where) for lengths, table, where in read)


def _surfaces(text: str, path: Path) -> tuple[float, list[Lines]]:
    """Return the unit of lengths in mm, and the lines of all surfaces."""
    unit, surfaces = 1.0, list[Lines]()
    for line, keyword, words in _keywords(text):
        if keyword == "SURF":
            if len(surfaces) == MOST_SURFACES:
                raise InputError(f"{path}, line {line}: expected at most {MOST_SURFACES} surfaces, got more")
            surfaces.append(Lines(line))
        elif keyword == "UNIT" and words:
            if words[0].upper() not in MILLIMETRES:
                expected = ", ".join(MILLIMETRES)
                raise InputError(f"{path}, line {line}: expected a unit among {expected}, got '{shortened(words[0])}'")
            unit = MILLIMETRES[words[0].upper()]
        elif keyword == "MODE" and words and words[0].upper() != "SEQ":
            raise InputError(f"{path}, line {line}: expected a sequential lens (MODE SEQ), got '{shortened(words[0])}'")
        elif surfaces and keyword == "PARM" and len(words) > 1:
            surfaces[-1].words.setdefault(f"PARM {words[0]}", words[1:])
        elif surfaces:
            surfaces[-1].words.setdefault(keyword, words)
    return unit, surfaces


def _keywords(text: str) -> Iterator[tuple[int, str, list[str]]]:
    for line, row in enumerate(text.splitlines(), start=1):
        words = row.split()
        if words:
            yield line, words[0].upper(), words[1:]


def _surface(lines: Lines, where: str, unit: float) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the lengths of a surface in mm, and its other keys of a scene file; raise InputError if unsupported."""
    for keyword, meaning in REFUSED.items():
        if keyword in lines.words:
            raise InputError(f"{where}: expected a circular opening, got {meaning} ({keyword}); remove it")
    kind = (lines.words.get("TYPE") or ["STANDARD"])[0].upper()
    if kind not in KINDS:
        what = "a coordinate break" if kind == "COORDBRK" else f"the type {shortened(kind)}"
        raise InputError(f"{where}: expected a surface of type {' or '.join(KINDS)} on one axis, got {what}")
    curvature = lines.value("CURV", where) / unit
    table: dict[str, Any] = {"conic": lines.value("CONI", where), "stop": "STOP" in lines.words}
    if kind == ASPHERE:
        terms = [lines.value(f"PARM {n}", where) / unit ** (2 * n - 1) for n in range(1, TERMS + 1)]
        if terms[0]:
            curvature, table["conic"] = _with_square(curvature, table["conic"], terms[0], where)
        if any(terms[1:]):
            table["aspheric"] = terms[1:]
    lengths = {"radius": 1 / curvature if curvature else 0.0, "thickness": lines.value("DISZ", where) * unit}
    return lengths | {"semi_diameter": _opening(lines, where) * unit}, table | _glass(lines, where)


def _with_square(curvature: float, conic: float, term: float, where: str) -> tuple[float, float]:
    """Return curvature and conic constant of a surface to which `term` r^2 is added: a paraboloid stays one."""
    if curvature and conic != -1:
        raise InputError(
            f"{where}: expected PARM 1, the coefficient of r^2, of 0, got {term:g}; add it to the curvature instead"
        )
    return curvature + 2 * term, -1.0


def _opening(lines: Lines, where: str) -> float:
    """Return the semi-diameter: that of an aperture, or else the one that DIAM holds."""
    openings = [lines.value("DIAM", where)]
    for keyword in ("CLAP", "FLAP"):
        words = lines.words.get(keyword, [])
        if len(words) > 1:
            if number(words[0], where, keyword) > 0:
                raise InputError(
                    f"{where}: expected an opening without an obscuration, got an inner radius ({keyword})"
                )
            openings.append(number(words[1], where, keyword))
    return next((opening for opening in reversed(openings) if opening), 0.0)


def _glass(lines: Lines, where: str) -> dict[str, Any]:
    """Return the keys of the medium behind a surface; none for air."""
    words = lines.words.get("GLAS", [])
    if not words or words[0].upper() == "AIR":
        return {}
    if words[0].upper() == "MIRROR":
        raise InputError(f"{where}: expected a lens of refracting surfaces, got a mirror")
    if words[0] != "___BLANK":
        return {"glass": words[0]}
    return _model_glass(words[3:5], where)


def _model_glass(words: list[str], where: str) -> dict[str, Any]:
    """Return the keys of a glass without a name, of which nd and vd are given; a vd of 0 is no dispersion."""
    index, abbe = (number(word, where, "nd and vd of a glass") for word in (*words, "", "")[:2])
    if abbe and not LEAST_ABBE <= abbe <= LARGEST_ABBE:
        raise InputError(
            f"{where}: expected a glass of vd 0 or from {LEAST_ABBE} to {LARGEST_ABBE}, got {abbe:g}; give its name"
        )
    if not abbe:
        return {"index": index}
    if not 1 <= index <= 5:  # the formula is a square, which hides a sign
        raise InputError(f"{where}: expected a glass of nd from 1 to 5, got {index:g}")
    inverse = {line: wavelength**-2 for line, wavelength in FRAUNHOFER.items()}
    slope = (index - 1) / abbe / (inverse["F"] - inverse["C"])
    level = index - slope * inverse["d"]
    # (A + B / w^2)^2 as Schott's formula
    coefficients = [level**2, 0.0, 2 * level * slope, slope**2]
    return {"dispersion": {"formula": 1, "coefficients": coefficients, "shortest": "400 nm", "longest": "700 nm"}}


def surface_of(lengths: dict[str, float], table: dict[str, Any], where: str) -> Surface:
    """Return a surface from its lengths in mm, of which 0 is none, and its other keys. Raises InputError."""
    stated = {name: f"{length!r} mm" for name, length in lengths.items() if length}
    return validated(Surface, table | stated, where)
