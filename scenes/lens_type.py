"""A lens type, what its lenses are beside a pinhole, and one sub-imager of it.

Lengths are millimetres; positions on the target are in pixels of f, from its top left corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from .tables.camera import Surface


@dataclass(frozen=True)
class LensOptics:
    """What a lens type's lenses are beside a pinhole in focus; absent effects are None.

    aperture : diameter of a thin lens;  focus : distance that it shows sharp, absent: the target's
    distortion : k1, k2, magnification times 1 + k1 r^2 + k2 r^4, r = 1 at the target's corner
    surfaces : of a real lens, from the target to the sensor;  scale : of them, or "fit"
    """

    aperture: float | None = None
    focus: float | None = None
    distortion: tuple[float, float] | None = None
    surfaces: tuple[Surface, ...] | None = None
    scale: float | str | None = None

    @property
    def pinhole(self) -> bool:
        """Whether there is nothing but a pinhole."""
        return self == LensOptics()

    def describe(self) -> dict[str, Any]:
        """What is there, in JSON's types."""
        surfaces = None if self.surfaces is None else [surface.model_dump(mode="json") for surface in self.surfaces]
        listed: dict[str, Any] = {"aperture": self.aperture, "focus": self.focus, "scale": self.scale}
        listed["distortion"] = None if self.distortion is None else list(self.distortion)
        listed["surfaces"] = surfaces
        return {name: value for name, value in listed.items() if value is not None}


@dataclass(frozen=True)
class LensType:
    """An array of equal sub-imagers; `ratio` is m, the pixels of f that a sensor pixel covers along one axis.

    left : columns of sub-imagers of other types to its left, absent: of those that are listed before it
    """

    name: str
    ratio: Fraction
    array: tuple[int, int]
    pixels: tuple[int, int]
    step: Fraction
    origin: tuple[int, int]
    optics: LensOptics = LensOptics()
    left: int | None = None

    @property
    def count(self) -> int:
        """Number of sub-imagers."""
        return self.array[0] * self.array[1]

    @property
    def measurements(self) -> int:
        """Number of sensor pixels of all its sub-imagers."""
        return self.count * self.pixels[0] * self.pixels[1]

    def middle(self, window: tuple[Fraction, Fraction]) -> tuple[float, float]:
        """Row and column of f in the middle of a sub-imager's view that begins at `window`."""
        row, column = (start + self.ratio * count / 2 for start, count in zip(window, self.pixels, strict=True))
        return float(row), float(column)

    @property
    def span(self) -> tuple[Fraction, Fraction]:
        """Rows and columns of f that the array sees as a whole."""
        return _span(self.ratio, self.array[0], self.pixels[0], self.step), _span(
            self.ratio, self.array[1], self.pixels[1], self.step
        )


@dataclass(frozen=True)
class SubImager:
    """One lens and the patch of sensor behind it.

    `window` is the row and column of f where its view begins; `lens` and `patch` are the (x, y) centres of the
    lens and of the patch, `depth` the distance from the lens to the patch.
    """

    type: LensType
    k: int
    l: int  # noqa: E741  (the paper's letter)
    window: tuple[Fraction, Fraction]
    lens: tuple[float, float]
    patch: tuple[float, float]
    depth: float

    @property
    def name(self) -> str:
        """Its name in a stack: type, k, l."""
        return f"{self.type.name}.{self.k:02d}.{self.l:02d}"


def _span(ratio: Fraction, count: int, pixels: int, step: Fraction) -> Fraction:
    return ratio * pixels + (count - 1) * step
