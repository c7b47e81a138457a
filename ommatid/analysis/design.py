"""Candidate lens types for a camera: their magnifications, and a scene with one more of them."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import count
from math import ceil
from typing import Any

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.negligible import ignores_detail
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.tables.series import continued
from ommatid.scenes.tables.units import magnification

ADDED = "added"  # name of the lens type
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


def magnifications(text: str) -> list[Fraction]:
    """Read "1/3,1/4,...,1/9", as of `design.magnifications`: ratios above 0 and up to 1.

    Raises InputError that names what cannot be read.
    """
    try:
        parts = continued([part.strip() for part in text.split(",")])
    except ValueError as error:
        raise InputError(f"design.magnifications: {error}") from error
    return list(dict.fromkeys(_magnification(part) for part in parts))


def with_lens(scene: Scene, magnification: Fraction) -> Scene:
    """Return the scene with one more lens type: 1/magnification sub-imagers along each axis, as large as fits.

    Its optics are those of the last type. Raises InputError where not one pixel fits the target.
    """
    data = scene.plain()
    taken = {lens["name"] for lens in data["camera"]["lens"]}
    names = (ADDED if number == 1 else f"{ADDED}-{number}" for number in count(1))
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


def _magnification(text: str) -> Fraction:
    try:
        return magnification(text)
    except ValueError as error:
        raise InputError(f"design.magnifications: {error}") from error
