"""Lens types, their optics, and single sub-imagers.

Lengths are millimetres; positions on the target are in pixels of f, from its top left corner.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from ommatid.runtime.errors import InputError

from .tables.camera import Surface

MOST_SUB_IMAGERS = 2**14


@dataclass(frozen=True)
class LensOptics:
    """The optics of a lens type in addition to a pinhole in focus; absent effects are None.

    aperture : diameter of a thin lens;  focus : distance in focus, absent: the target's
    distortion : k1, k2 of the magnification factor 1 + k1 r^2 + k2 r^4, r = 1 at the target's corner
    surfaces : of a real lens, from the target to the sensor;  scale : factor on the surfaces, or "fit"
    coating : reflectance of each surface to air;  absent: Fresnel's
    """

    aperture: float | None = None
    focus: float | None = None
    distortion: tuple[float, float] | None = None
    surfaces: tuple[Surface, ...] | None = None
    scale: float | str | None = None
    coating: float | None = None

    @property
    def is_pinhole(self) -> bool:
        """True for a pinhole without distortion."""
        return self == LensOptics()

    def describe(self) -> dict[str, Any]:
        """The effects present, in JSON's types; part of fingerprints."""
        surfaces = None if self.surfaces is None else [surface.model_dump(mode="json") for surface in self.surfaces]
        effects: dict[str, Any] = {"aperture": self.aperture, "focus": self.focus, "scale": self.scale}
        effects["distortion"] = None if self.distortion is None else list(self.distortion)
        effects |= {"surfaces": surfaces, "coating": self.coating}
        return {name: value for name, value in effects.items() if value is not None}


def adjacent_slices(sizes: Iterable[int]) -> list[slice]:
    """Adjacent slices of the given sizes, from 0."""
    return [slice(first, last) for first, last in pairwise(accumulate(sizes, initial=0))]


@dataclass(frozen=True)
class LensType:
    """An array of equal sub-imagers.

    ratio : m, pixels of f that a sensor pixel covers along one axis
    origin : row and column of f where the view of sub-imager (0, 0) begins
    left : columns of sub-imagers of other types to its left; None: those of the types listed before it
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
        """Number of sensor pixels of all sub-imagers."""
        return self.count * self.pixels[0] * self.pixels[1]

    def check_count(self, source: Path) -> None:
        """Raise InputError, which names the scene file, for too many sub-imagers."""
        if self.count > MOST_SUB_IMAGERS:
            raise InputError(
                f"{source}: camera.lens.{self.name}.array has {self.count} sub-imagers, expected at most"
                f" {MOST_SUB_IMAGERS} per lens type; use fewer"
            )

    def finer(self, detail: int) -> LensType:
        """The same lens type on a grid of the target that is `detail` times finer along both axes."""
        origin = self.origin[0] * detail, self.origin[1] * detail
        return replace(self, ratio=self.ratio * detail, step=self.step * detail, origin=origin)

    def middle(self, window: tuple[Fraction, Fraction]) -> tuple[float, float]:
        """Row and column of f in the middle of the view of a sub-imager whose view begins at `window`."""
        row, column = (start + self.ratio * count / 2 for start, count in zip(window, self.pixels, strict=True))
        return float(row), float(column)

    @property
    def span(self) -> tuple[Fraction, Fraction]:
        """Rows and columns of f that all sub-imagers together see."""
        rows, columns = (
            self.ratio * pixels + (count - 1) * self.step for count, pixels in zip(self.array, self.pixels, strict=True)
        )
        return rows, columns


@dataclass(frozen=True)
class SubImager:
    """One lens and the sensor patch behind it.

    window : row and column of f where its view begins
    lens, patch : (x, y) of their centres;  depth : distance from the lens to the patch
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
        """Name of its part in a stack: type.k.l."""
        return f"{self.type.name}.{self.k:02d}.{self.l:02d}"

    def check_apart(self, other: SubImager, axis: int, pixel_pitch: float, source: Path) -> None:
        """Raise InputError, which names the scene file, if this patch overlaps that of the next sub-imager.

        axis : 0 if the other one is below, 1 if it is to the right
        """
        distance = self.patch[1 - axis] - other.patch[1 - axis]
        needed = (self.type.pixels[axis] + other.type.pixels[axis]) / 2 * pixel_pitch
        if distance < needed * (1 - 1e-9):
            raise InputError(
                f"{source}: camera.lens_pitch: the sub-images {self.name} and {other.name} overlap on the sensor"
                f" (their centres are {distance:.4g} mm apart, they need {needed:.4g} mm); widen the pitch"
            )
