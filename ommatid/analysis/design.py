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
# Keys that are copied from the camera's last lens type, so that like is compared with like.
OPTICS = ("aperture", "focus", "distortion", "surfaces", "scale", "coating", "fill_factor")


@dataclass(frozen=True)
class LensCandidate:
    """A lens type of a magnification, and of an aperture (mm) and open part where these are not the last type's."""

    ratio: Fraction
    aperture: float | None = None
    open: tuple[Fraction, Fraction] | None = None

    @property
    def side(self) -> int:
        """Sub-imagers along a side of an array, which sees every pixel of f."""
        return ceil(self.ratio)

    @property
    def readings(self) -> float:
        """Readings of an array per pixel of f."""
        return float((self.side / self.ratio) ** 2)

    @property
    def words(self) -> str:
        """The type as tables name it."""
        words = [str(1 / self.ratio)]
        words += [] if self.aperture is None else [f"{self.aperture:g} mm"]
        if self.open is not None:
            words.append(f"open {' x '.join(str(part) for part in dict.fromkeys(self.open))}")
        return " ".join(words)

    def table(self, last: dict[str, Any], name: str) -> dict[str, Any]:
        """Return the type as a table of a scene; last : the scene's last lens type, whose optics it takes."""
        optics = {key: last[key] for key in OPTICS if key in last}
        if self.aperture is not None:
            optics["aperture"] = f"{self.aperture!r} mm"
        if self.open is not None:
            optics["fill_factor"] = [str(part) for part in self.open]
        array = [self.side, self.side]
        return {**optics, "name": name, "magnification": str(1 / self.ratio), "array": array, "pixels": "fit"}


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

    Its optics are those of the last type. Raises InputError where not one pixel fits the target.
    """
    data = scene.plain()
    taken = {lens["name"] for lens in data["camera"]["lens"]}
    names = [ADDED, *(f"{ADDED}-{number}" for number in range(2, MAX_CANDIDATES))]
    name = next(name for name in names if name not in taken)
    lenses = data["camera"]["lens"]
    added = LensCandidate(1 / magnification).table(lenses[-1], name)
    return parse({**data, "camera": {**data["camera"], "lens": [*lenses, added]}}, scene.source)


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
