"""Solve for the geometry of a scene file from any sufficient set of its keys.

A lens of focal length f, in focus at the distance F, has its sensor at depth d behind it, 1/f = 1/F + 1/d. A pixel of
the sensor, of pitch s, then spans Z s / d of a target at distance Z, which is 1/magnification pixels of pitch p:

    magnification = d p / (Z s),   field of view = 2 atan(pixels s / (2 d)),   f-number = f / aperture.

F is Z unless the lens has a focus of its own. In front of one sensor (camera.common) Z differs between lens types, and
Z + d is the same for all; target.distance is the Z of the type with the largest d. Each equation gives the one of its
quantities that is absent from the others. Quantities are exact fractions of the decimal numbers in the file, lengths in
millimetres.

A redundant key must agree with the geometry that the others give. A number counts as given to its last digit, and to
three digits at least: 2 mm stands for 1.995 to 2.005 mm. Numbers of more than six digits agree to a millionth.
"""

from __future__ import annotations

import copy
import re
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import partial
from math import atan, degrees, prod, tan
from typing import Any, cast

from pydantic import TypeAdapter, ValidationError

from ..tables.camera import MOST_TYPES
from ..tables.units import Length, Magnification, Pair
from .quantities import FieldOfView, FNumber

LEADING_NUMBER = re.compile(r"\s*[-+]?([\d_]*)\.?([\d_]*)")
FINEST = Fraction(1, 10**6)
FEWEST = 100  # smallest number of three digits
PLANES = ("magnification", "distance", "sensor_pitch", "target_pitch", "focus")


def contradiction(lens: Mapping[str, Any], known: Mapping[str, Fraction]) -> str:
    """Return a sentence with the numbers if a redundant key of a lens type contradicts the others; empty if none does.

    lens : its table in the file;  known : its quantities, those that were derived included
    """
    where = f"camera.lens.{lens.get('name')}"
    depth, focal_length = required_depth(known), required_focal_length(known)
    if depth is None or focal_length is None:
        return ""
    if known["magnification"] > 1:
        return _too_large(where, known)
    if "focal_length" in lens and not _agree(lens["focal_length"], known["focal_length"], focal_length):
        return (
            f"{where}.focal_length: got {lens['focal_length']}, but magnification {known['magnification']},"
            f" {_distance_words(known)}, target.pixel_pitch {_mm(known['target_pitch'])} and"
            f" camera.pixel_pitch {_mm(known['sensor_pitch'])} make it {_mm(focal_length)}; remove or correct one of"
            " these keys"
        )
    if "f_number" in lens and "aperture" in lens:
        number = focal_length / known["aperture"]
        if not _agree(lens["f_number"], known["f_number"], number):
            return (
                f"{where}.f_number: got {lens['f_number']}, but a focal length of {_mm(focal_length)} and an aperture"
                f" of {_mm(known['aperture'])} make it {float(number):.4g}; remove or correct one of these keys"
            )
    return _view_contradiction(lens, where, known, depth) if "field_of_view" in lens else ""


def required_depth(known: Mapping[str, Fraction]) -> Fraction | None:
    """Return the distance from lens to sensor that magnification, distance and pitches require; None if one lacks."""
    if any(name not in known for name in PLANES):
        return None
    return known["magnification"] * known["distance"] * known["sensor_pitch"] / known["target_pitch"]


def required_focal_length(known: Mapping[str, Fraction]) -> Fraction | None:
    """Return the focal length that magnification, distance, focus and pitches require; None if one of them lacks."""
    depth = required_depth(known)
    return None if depth is None else depth * known["focus"] / (depth + known["focus"])


def _view_contradiction(lens: Mapping[str, Any], where: str, known: Mapping[str, Fraction], depth: Fraction) -> str:
    if lens.get("pixels") == "fit":
        return (
            f"{where}.field_of_view gives the number of pixels, and pixels = 'fit' as many as the target holds;"
            " remove one of the two keys"
        )
    for name, count in (("down", "rows"), ("across", "columns")):
        if name not in known:
            continue
        pixels, pitch = known[name] * depth / known["sensor_pitch"], known["sensor_pitch"]
        if abs(pixels - known[count]) > Fraction(1, 2) + pixels * FINEST:
            seen = degrees(2 * atan(known[count] * pitch / depth / 2))
            return (
                f"{where}.field_of_view: got {lens['field_of_view']}, which is {float(pixels):.4g} pixels, but"
                f" {known[count]} {count} of {_mm(pitch)} at {_mm(depth)} behind the lens see {seen:.4g} deg; remove or"
                " correct one of these keys"
            )
    return ""


def _distance_words(known: Mapping[str, Fraction]) -> str:
    words = "target.distance" if "whole" not in known else "a distance from the target, before one sensor, of"
    return f"{words} {_mm(known['distance'])}"


def _too_large(where: str, known: Mapping[str, Fraction]) -> str:
    ratio = 1 / known["magnification"]
    return (
        f"{where}: a sensor pixel spans {float(ratio):.4g} pixels of the target, expected at least 1; make"
        f" target.pixel_pitch {_mm(known['target_pitch'] * ratio)} or less, or the focal length shorter"
    )


def _agree(stated: object, value: Fraction, derived: Fraction) -> bool:
    return abs(value - derived) <= value * _tolerance(str(stated))


def _tolerance(text: str) -> Fraction:
    """Half a unit of the last digit of a number, relative to it."""
    found = LEADING_NUMBER.match(text)
    digits = "" if found is None or "/" in text else (found[1] + found[2]).replace("_", "")
    number = int(digits or "0")
    if number == 0:
        return FINEST
    while number < FEWEST:
        number *= 10
    return max(FINEST, Fraction(1, 2 * number))


def _mm(length: Fraction) -> str:
    return f"{float(length):.5g} mm"


Known = Mapping[str, Fraction]
Result = tuple[str, Fraction] | None
SHARED = {  # by all lens types
    "distance": ("target", "distance"),
    "target_pitch": ("target", "pixel_pitch"),
    "sensor_pitch": ("camera", "pixel_pitch"),
}
LENGTH, RATIO = TypeAdapter[float](Length), TypeAdapter[Fraction](Magnification)
PIXELS = TypeAdapter[tuple[int, int]](Pair)
NUMBER, ANGLES = TypeAdapter[float](FNumber), TypeAdapter[tuple[float, ...]](FieldOfView)
ASKING = ("focal_length", "field_of_view", "f_number")  # keys that only the solution reads
EXACT = 1000  # largest numerator and denominator of a derived magnification that is kept as it is
NEAR = Fraction(1, 2 * 10**6)  # relative, within which the simplest ratio stands for any other one
DIGITS = 15  # that survive the conversion of a decimal number to a float and back


def complete(data: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the tables of a scene file with the keys that follow from others, and what contradicts them, if anything.

    Tables that need no solution, and those with a value that is no quantity, are returned as they are.
    """
    lenses = _lens_tables(data)
    if not any(key in lens for lens in lenses for key in ASKING):
        return data, ""
    try:
        shared = {name: _length(data[table][key]) for name, (table, key) in SHARED.items() if key in data[table]}
        known = [ChainMap(_given(lens), shared) for lens in lenses]
    except ValidationError:
        return data, ""
    names = [str(lens.get("name")) for lens in lenses]
    problem = _solve(known, shared, names)
    depths = [required_depth(quantities) for quantities in known]
    if data["camera"].get("common") == "sensor" and not problem and all(depths):
        front = max(range(len(lenses)), key=lambda index: depths[index] or 0)
        pitches = {name: shared[name] for name in ("target_pitch", "sensor_pitch")}
        whole = {"whole": shared["distance"] + (depths[front] or 0)}
        behind = [ChainMap(_given(lens) | whole, pitches) for lens in lenses]
        known = [known[index] if index == front else each for index, each in enumerate(behind)]
        problem = _solve(known, shared, names)
    completed = copy.deepcopy(data)
    for name, (table, key) in SHARED.items():
        if name in shared:
            completed[table].setdefault(key, _text(shared[name]))
    for lens, quantities in zip(_lens_tables(completed), known, strict=True):
        problem = problem or contradiction(lens, quantities)
        _write(lens, quantities)
    return completed, problem


def _lens_tables(data: dict[str, Any]) -> list[dict[str, Any]]:
    """The tables of the lens types; none if the file is malformed, or names too many."""
    camera, target = data.get("camera"), data.get("target")
    lenses = cast(dict[str, object], camera).get("lens") if isinstance(camera, dict) else None
    tables = list(cast(Iterable[object], lenses)) if isinstance(lenses, list | tuple) else []
    if not isinstance(target, dict) or len(tables) > MOST_TYPES or not all(isinstance(table, dict) for table in tables):
        return []
    return cast(list[dict[str, Any]], tables)


def _length(value: object) -> Fraction:
    return _decimal(LENGTH.validate_python(value))


def _decimal(value: float) -> Fraction:
    """The decimal number that was converted to a float."""
    return Fraction(f"{value:.{DIGITS}g}")


def _text(length: Fraction) -> str:
    return f"{float(length)!r} mm"


def _given(lens: Mapping[str, Any]) -> dict[str, Fraction]:
    """The quantities in the table of a lens type. Raises ValidationError for a value that is none.

    across, down : 2 tan(field of view / 2) along a row of pixels and along a column
    """
    known = {key: _length(lens[key]) for key in ("focal_length", "focus", "aperture") if key in lens}
    if "magnification" in lens:
        known["magnification"] = RATIO.validate_python(lens["magnification"])
    if "f_number" in lens:
        known["f_number"] = _decimal(NUMBER.validate_python(lens["f_number"]))
    if "pixels" in lens and lens["pixels"] != "fit":
        known["rows"], known["columns"] = (Fraction(count) for count in PIXELS.validate_python(lens["pixels"]))
    if "field_of_view" in lens:
        tangents = [Fraction(2 * tan(angle / 2)) for angle in ANGLES.validate_python(lens["field_of_view"])]
        known["across"] = tangents[-1]
        known |= {"down": tangents[0]} if len(tangents) > 1 else {}
    return known


def _solve(known: list[ChainMap[str, Fraction]], shared: dict[str, Fraction], names: list[str]) -> str:
    """Apply the equations until none gives another quantity. Returns why one has no solution, empty if all have."""
    grows = True
    while grows:
        grows = False
        for equation, (quantities, name) in ((e, lens) for e in EQUATIONS for lens in zip(known, names, strict=True)):
            try:
                found = equation(quantities)
            except ValueError as error:
                return f"camera.lens.{name}: {error}"
            if found is not None:
                own = found[0] not in SHARED or "whole" in quantities
                (quantities if own else shared)[found[0]] = found[1]
                grows = True
                break
    return ""


def _focus(known: Known) -> Result:
    if "focus" not in known and "distance" in known:
        return "focus", known["distance"]
    return None


def _one_sensor(known: Known) -> Result:
    """The distance from the target of a lens whose sensor is `whole` from it, and which is sharp if nothing else."""
    if "whole" not in known or "distance" in known:
        return None
    whole = known["whole"]
    if "depth" in known:
        return "distance", whole - known["depth"]
    if "magnification" in known:
        return "distance", whole / (1 + known["magnification"] * known["sensor_pitch"] / known["target_pitch"])
    if "focal_length" not in known or "focus" in known:
        return None
    apart = max(whole * (whole - 4 * known["focal_length"]), Fraction(0))  # below 0 by rounding alone: whole is long
    return "distance", (whole + _decimal(float(apart) ** 0.5)) / 2


def _product(known: Known, above: tuple[str, ...], below: tuple[str, ...]) -> Result:
    """The only absent one of the quantities whose products, `above` and `below` a fraction line, are equal."""
    absent = [name for name in (*above, *below) if name not in known]
    if len(absent) != 1:
        return None
    over, under = (prod(known[name] for name in names if name in known) for names in (above, below))
    value = Fraction(under, over) if absent[0] in above else Fraction(over, under)
    if absent[0] in ("rows", "columns"):
        value = Fraction(round(value))
        if value < 1:
            raise ValueError("field_of_view is narrower than half a pixel; make it wider, or the pixels smaller")
    return absent[0], _manageable(value) if absent[0] == "magnification" else value


def _lens_equation(known: Known) -> Result:
    """The depth or the focal length; or, of a lens in focus at the target, the target's distance."""
    focal_length, focus, depth = (known.get(name) for name in ("focal_length", "focus", "depth"))
    if focus is None:
        names = "focal_length", "magnification", "sensor_pitch", "target_pitch"
        if all(name in known for name in names):
            length, magnification, sensor_pitch, target_pitch = (known[name] for name in names)
            return "distance", length * (1 + target_pitch / (magnification * sensor_pitch))
        return None
    if focal_length is None:
        return None if depth is None else ("focal_length", depth * focus / (depth + focus))
    if focal_length >= focus:
        raise ValueError(
            f"focal_length {float(focal_length):.6g} mm: expected less than the distance in focus,"
            f" {float(focus):.6g} mm, since no sensor has a sharp image otherwise; make it shorter"
        )
    return ("depth", focal_length * focus / (focus - focal_length)) if depth is None else None


def _square(known: Known) -> Result:
    """A sub-image whose height is not given is as high as wide."""
    return ("rows", known["columns"]) if "columns" in known and not {"rows", "down"} & known.keys() else None


EQUATIONS: tuple[Callable[[Known], Result], ...] = (  # fields of view last: they give pixels to the nearest whole one
    _focus,
    _one_sensor,
    partial(_product, above=("magnification", "distance", "sensor_pitch"), below=("depth", "target_pitch")),
    partial(_product, above=("f_number", "aperture"), below=("focal_length",)),
    _lens_equation,
    partial(_product, above=("columns", "sensor_pitch"), below=("across", "depth")),
    partial(_product, above=("rows", "sensor_pitch"), below=("down", "depth")),
    _square,
)


def _write(lens: dict[str, Any], known: Known) -> None:
    """Add the keys that were derived to the table of a lens type."""
    if "magnification" in known and known["magnification"] <= 1:
        lens.setdefault("magnification", str(known["magnification"]))
    if "rows" in known and "columns" in known:
        lens.setdefault("pixels", [int(known["rows"]), int(known["columns"])])
    focal_length = required_focal_length(known)
    if "f_number" in lens and focal_length is not None and "surfaces" not in lens:
        lens.setdefault("aperture", _text(focal_length / known["f_number"]))


def _manageable(ratio: Fraction) -> Fraction:
    """The ratio itself if its numbers are small, else the simplest one within `NEAR`."""
    if max(ratio.numerator, ratio.denominator) <= EXACT:
        return ratio
    return _simplest(ratio * (1 - NEAR), ratio * (1 + NEAR))


def _simplest(low: Fraction, high: Fraction) -> Fraction:
    """The fraction of the smallest denominator from `low` to `high`, both above 0."""
    whole = low.numerator // low.denominator
    if whole == low:
        return Fraction(whole)
    if whole + 1 <= high:
        return Fraction(whole + 1)
    return whole + 1 / _simplest(1 / (high - whole), 1 / (low - whole))
