"""Lens types that might be added to a camera: a list of magnifications, and the scene with one more type."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene, parse

ADDED = "added"
MOST = 1000


def magnifications(text: str) -> list[Fraction]:
    """Read "1/2,1/3,...,1/9": ratios above 0 and up to 1; dots continue the step of the two 1/magnifications before.

    Raises InputError that names what cannot be read.
    """
    parts = [part.strip() for part in text.split(",")]
    ratios: list[Fraction] = []
    for place, part in enumerate(parts):
        if part != "...":
            ratios.append(_magnification(part))
            continue
        if len(ratios) < 2 or place + 1 == len(parts):
            raise InputError('--candidates: "..." needs two ratios before it and one after it, as in 1/2,1/3,...,1/9')
        ratios += _between(ratios[-2], ratios[-1], _magnification(parts[place + 1]))
    return list(dict.fromkeys(ratios))


GLASS = ("aperture", "focus", "distortion", "surfaces", "scale")


def with_lens(scene: Scene, magnification: Fraction) -> Scene:
    """The scene with one more lens type: as many sub-imagers as a sensor pixel covers target pixels, each that fits.

    Its lenses are such as those of the last type: their aperture, focus, distortion, or surfaces.

    Raises InputError where not one pixel of it fits the target.
    """
    data = scene.plain()
    count = ceil(1 / magnification)
    taken = {lens["name"] for lens in data["camera"]["lens"]}
    name = next(name for name in [ADDED, *(f"{ADDED}-{number}" for number in range(2, MOST))] if name not in taken)
    last = data["camera"]["lens"][-1]
    glass = {key: last[key] for key in GLASS if key in last}  # else a pinhole would be compared with real lenses
    added = {**glass, "name": name, "magnification": str(magnification), "array": [count, count], "pixels": "fit"}
    camera = {**data["camera"], "lens": [*data["camera"]["lens"], added]}
    return parse({**data, "camera": camera}, scene.source)


def _between(before: Fraction, last: Fraction, end: Fraction) -> list[Fraction]:
    step = 1 / last - 1 / before
    steps = (1 / end - 1 / last) / step if step else Fraction(-1)
    if steps > MOST:
        raise InputError(f"--candidates: expected at most {MOST} magnifications, got {int(steps)} up to {end}")
    if steps <= 0 or steps.denominator != 1:
        raise InputError(f"--candidates: steps of {step} in 1/magnification never reach {end} after {last}")
    return [1 / (1 / last + step * number) for number in range(1, int(steps))]


def _magnification(text: str) -> Fraction:
    try:
        ratio = Fraction(text)
    except (ValueError, ZeroDivisionError):
        ratio = Fraction(0)
    if not 0 < ratio <= 1:
        raise InputError(f"--candidates: expected magnifications above 0 and at most 1, such as 1/6, got '{text}'")
    return ratio
