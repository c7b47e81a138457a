"""Candidate lens types for a camera: read their magnifications, add one to a scene, rank them by expected error.

The error with each is that of Eq. 5 (Wood et al., section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil
from typing import Any

from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.negligible import ignores_detail
from ommatid.scenes.scene import Scene, parse

from .prediction_table import DIGITS, json_of

ADDED = "added"  # name of the lens type
MAX_CANDIDATES = 1000
OPTICS = ("aperture", "focus", "distortion", "surfaces", "scale")  # keys copied from the camera's last lens type


@dataclass(frozen=True)
class DesignCandidate:
    """A magnification and the prediction with it; None and `reason` where it is impossible."""

    magnification: str
    expected: Prediction | None
    reason: str = ""


@dataclass(frozen=True)
class DesignComparison:
    """The expected error of a scene, and the candidates by theirs, the least first; impossible ones are last."""

    before: Prediction
    candidates: list[DesignCandidate]

    def describe(self) -> dict[str, Any]:
        """Describe the comparison in JSON's types."""
        candidates = [
            {
                "magnification": candidate.magnification,
                "expected": None if candidate.expected is None else json_of(candidate.expected),
                "reason": candidate.reason,
            }
            for candidate in self.candidates
        ]
        return {"before": json_of(self.before), "candidates": candidates}

    def rows(self) -> list[tuple[str, str]]:
        """Return magnification and expected error, one row per candidate after that of the camera itself."""
        before = self.before
        lines = [("unchanged", error_words(before.mse, DIGITS) + _null_space(before, ", "))]
        for candidate in self.candidates:
            after, name = candidate.expected, f"+ {candidate.magnification}"
            if after is None:
                lines.append((name, candidate.reason))
                continue
            gain = f"{before.mse / after.mse:.3g} times less" if after.mse > 0 else "no error is left"
            added = after.measurements - before.measurements
            more = f"{_null_space(after, '')}{', ' if after.null_space is not None else ''}{added} measurements more"
            lines.append((name, f"{error_words(after.mse, DIGITS)}, {gain}; {more}"))
        return lines


def _null_space(prediction: Prediction, before: str) -> str:
    """Return the words about the null space, none for a frame, of which it is not computed."""
    known = prediction.null_space is not None
    return f"{before}null space of {prediction.null_space} dimensions" if known else ""


def magnifications(text: str, where: str = "--candidates") -> list[Fraction]:
    """Read "1/2,1/3,...,1/9": ratios above 0 and up to 1; dots continue the step of the two 1/magnifications before.

    Raises InputError that names what cannot be read.
    """
    parts = [part.strip() for part in text.split(",")]
    ratios: list[Fraction] = []
    for index, part in enumerate(parts):
        if part != "...":
            ratios.append(_magnification(part, where))
            continue
        if len(ratios) < 2 or index + 1 == len(parts):
            raise InputError(f'{where}: "..." needs two ratios before it and one after it, as in 1/2,1/3,...,1/9')
        ratios += _between(ratios[-2], ratios[-1], _magnification(parts[index + 1], where), where)
    return list(dict.fromkeys(ratios))


def with_lens(scene: Scene, magnification: Fraction) -> Scene:
    """Return the scene with one more lens type: 1/magnification sub-imagers along each axis, as large as fits.

    Aperture, focus, distortion and surfaces are those of the last type, so that like is compared with like.
    Raises InputError where not one pixel fits the target.
    """
    data = scene.plain()
    count = ceil(1 / magnification)
    taken = {lens["name"] for lens in data["camera"]["lens"]}
    names = [ADDED, *(f"{ADDED}-{number}" for number in range(2, MAX_CANDIDATES))]
    name = next(name for name in names if name not in taken)
    last = data["camera"]["lens"][-1]
    optics = {key: last[key] for key in OPTICS if key in last}
    added = {**optics, "name": name, "magnification": str(magnification), "array": [count, count], "pixels": "fit"}
    camera = {**data["camera"], "lens": [*data["camera"]["lens"], added]}
    return parse({**data, "camera": camera}, scene.source)


def check_detail(scene: Scene, wider: Scene) -> None:
    """Raise InputError for lens types that see detail finer than f, of which a scene of whole pixels says nothing."""
    if derive(scene).covers_whole_pixels and ignores_detail(wider, derive(wider)):
        raise InputError(
            "its readings divide pixels of f, so its error depends on detail finer than f; set target.detail and a"
            " correlated prior"
        )


def _between(before: Fraction, last: Fraction, end: Fraction, where: str) -> list[Fraction]:
    step = 1 / last - 1 / before
    steps = (1 / end - 1 / last) / step if step else Fraction(-1)
    if steps > MAX_CANDIDATES:
        raise InputError(f"{where}: expected at most {MAX_CANDIDATES} magnifications, got {int(steps)} up to {end}")
    if steps <= 0 or steps.denominator != 1:
        raise InputError(f"{where}: steps of {step} in 1/magnification never reach {end} after {last}")
    return [1 / (1 / last + step * number) for number in range(1, int(steps))]


def _magnification(text: str, where: str) -> Fraction:
    try:
        ratio = Fraction(text)
    except (ValueError, ZeroDivisionError):
        ratio = Fraction(0)
    if not 0 < ratio <= 1:
        raise InputError(f"{where}: expected magnifications above 0 and at most 1, such as 1/6, got '{text}'")
    return ratio
