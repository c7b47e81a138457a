"""Redundant keys of a lens type: whether they agree with the geometry that the others give.

A number counts as given to its last digit, and to three digits at least: 2 mm stands for 1.995 to 2.005 mm. Numbers of
more than six digits agree to one part in a million.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from math import atan, degrees
from typing import Any

NUMBER = re.compile(r"\s*[-+]?([\d_]*)\.?([\d_]*)")
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
            f" target.distance {_mm(known['distance'])}, target.pixel_pitch {_mm(known['target_pitch'])} and"
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
    found = NUMBER.match(text)
    digits = "" if found is None or "/" in text else (found[1] + found[2]).replace("_", "")
    number = int(digits or "0")
    if number == 0:
        return FINEST
    while number < FEWEST:
        number *= 10
    return max(FINEST, Fraction(1, 2 * number))


def _mm(length: Fraction) -> str:
    return f"{float(length):.5g} mm"
