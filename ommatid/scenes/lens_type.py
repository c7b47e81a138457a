"""Lens types, their optics, and single sub-imagers.

Lengths are millimetres; positions on the target are in pixels of f, from its top left corner.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import accumulate, pairwise, product
from math import ceil
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError

from .tables.camera import Surface

Number = TypeVar("Number", np.float64, np.int64)

MOST_SUB_IMAGERS, MOST_OF_ALL_TYPES = 2**14, 2**16


@dataclass(frozen=True)
class LensOptics:
    """The optics of a lens type in addition to a pinhole in focus; absent effects are None.

    aperture : diameter of a thin lens;  focus : distance in focus, absent: the target's
    distortion : k1, k2 of the magnification factor 1 + k1 r^2 + k2 r^4, r = 1 at the target's corner
    surfaces : of a real lens, from the target to the sensor;  scale : factor on the surfaces, or "fit"
    coating : reflectance of each surface to air;  absent: Fresnel's
    pixel_blur : standard deviation, along an axis of the sensor, of the displacement of charges by diffusion
    """

    aperture: float | None = None
    focus: float | None = None
    distortion: tuple[float, float] | None = None
    surfaces: tuple[Surface, ...] | None = None
    scale: float | str | None = None
    coating: float | None = None
    pixel_blur: float | None = None

    @property
    def is_pinhole(self) -> bool:
        """True for a pinhole without distortion, before pixels without blur."""
        return self == LensOptics()

    @property
    def has_width(self) -> bool:
        """True if it has an aperture or surfaces: light of a point reaches it at more than one point."""
        return self.aperture is not None or self.surfaces is not None

    @property
    def draws_more(self) -> bool:
        """True if a ray of a sensor pixel is drawn by more than its point in the pixel."""
        return self.has_width or self.pixel_blur is not None

    def describe(self) -> dict[str, Any]:
        """The effects present, in JSON's types; part of fingerprints."""
        surfaces = None if self.surfaces is None else [surface.model_dump(mode="json") for surface in self.surfaces]
        effects: dict[str, Any] = {"aperture": self.aperture, "focus": self.focus, "scale": self.scale}
        effects["distortion"] = None if self.distortion is None else list(self.distortion)
        effects |= {"surfaces": surfaces, "coating": self.coating, "pixel_blur": self.pixel_blur}
        return {name: value for name, value in effects.items() if value is not None}


def adjacent_slices(sizes: Iterable[int]) -> list[slice]:
    """Adjacent slices of the given sizes, from 0."""
    return [slice(first, last) for first, last in pairwise(accumulate(sizes, initial=0))]


@dataclass(frozen=True)
class Steering:
    """The view of sub-imager (k, l), which differs from that of the grid.

    window : row and column of f where it begins;  rotation : of the sensor patch, clockwise in the upright picture
    """

    k: int
    l: int  # noqa: E741  (the paper's letter)
    window: tuple[Fraction, Fraction]
    rotation: float = 0.0

    def describe(self) -> list[Any]:
        """The steering in JSON's types; part of fingerprints."""
        return [self.k, self.l, *map(str, self.window), *([self.rotation] if self.rotation else [])]


@dataclass(frozen=True)
class LensType:
    """An array of equal sub-imagers.

    ratio : m, pixels of f that a sensor pixel covers along one axis
    step : pixels of f from one window to the next, down and across
    origin : row and column of f where the view of sub-imager (0, 0) begins; whole ones, so that the array stands at
        most half a pixel of f off the target's middle
    left : columns of sub-imagers of other types to its left; None: those of the types listed before it
    steered : sub-imagers off the grid;  rotation : of all sensor patches
    above : rows of lenses above it, and rows of all, of a part of an array; None of a whole array
    open : height and width of the open part of a sensor pixel over its pitch
    light : of a uniform target that it receives
    """

    name: str
    ratio: Fraction
    array: tuple[int, int]
    pixels: tuple[int, int]
    step: tuple[Fraction, Fraction]
    origin: tuple[int | Fraction, int | Fraction]
    optics: LensOptics = LensOptics()
    left: int | None = None
    steered: tuple[Steering, ...] = ()
    rotation: float = 0.0
    above: tuple[int, int] | None = None
    open: tuple[Fraction, Fraction] = (Fraction(1), Fraction(1))
    light: Fraction = Fraction(1)

    @property
    def is_open(self) -> bool:
        """True if sensor pixels are open as a whole."""
        return self.open == (1, 1)

    @property
    def opening(self) -> str:
        """The side of the open parts of sensor pixels over the pitch, or height x width."""
        down, across = map(str, self.open)
        return down if down == across else f"{down} x {across}"

    @property
    def footprint(self) -> tuple[Fraction, Fraction]:
        """Pixels of f that the open part of a sensor pixel covers, down and across."""
        return self.open[0] * self.ratio, self.open[1] * self.ratio

    @property
    def inset(self) -> tuple[Fraction, Fraction]:
        """Pixels of f from the edge of a sensor pixel to that of its open part, down and across."""
        down, across = self.footprint
        return (self.ratio - down) / 2, (self.ratio - across) / 2

    @property
    def count(self) -> int:
        """Number of sub-imagers."""
        return self.array[0] * self.array[1]

    @property
    def measurements(self) -> int:
        """Number of sensor pixels of all sub-imagers."""
        return self.count * self.pixels[0] * self.pixels[1]

    def in_order(self, lines: NDArray[Number]) -> NDArray[Number]:
        """Return readings by (sensor rows, sensor columns) in the order of measurements."""
        (down, across), (rows, columns) = self.array, self.pixels
        return lines.reshape(down, rows, across, columns).swapaxes(1, 2).ravel()

    def by_lines(self, readings: NDArray[Number]) -> NDArray[Number]:
        """Return readings, in the order of measurements, as (sensor rows, sensor columns)."""
        (down, across), (rows, columns) = self.array, self.pixels
        return readings.reshape(down, across, rows, columns).swapaxes(1, 2).reshape(down * rows, across * columns)

    def finer(self, detail: int | Fraction) -> LensType:
        """The same lens type on a grid of the target that is `detail` times finer along both axes."""
        origin = self.origin[0] * detail, self.origin[1] * detail
        step = self.step[0] * detail, self.step[1] * detail
        steered = tuple(
            replace(each, window=(each.window[0] * detail, each.window[1] * detail)) for each in self.steered
        )
        return replace(self, ratio=self.ratio * detail, step=step, origin=origin, steered=steered)

    def view(self, k: int, l: int) -> Steering:  # noqa: E741
        """Window and rotation of sub-imager (k, l)."""
        steered = self._steered_by_place.get((k, l))
        if steered is not None:
            return steered
        return Steering(k, l, (self.origin[0] + k * self.step[0], self.origin[1] + l * self.step[1]), self.rotation)

    @cached_property
    def _steered_by_place(self) -> dict[tuple[int, int], Steering]:
        return {(each.k, each.l): each for each in self.steered}

    @property
    def is_rotated(self) -> bool:
        """True if the patch of some sub-imager is rotated."""
        return bool(self.rotation) or any(each.rotation for each in self.steered)

    @property
    def on_grids(self) -> tuple[LensType, ...]:
        """Lens types on regular grids that have the same sub-imagers in the same order: itself, or one for each."""
        if not self.steered:
            return (self,)
        left, rows = self.left or 0, self.array[0]
        views = [self.view(k, l) for k, l in product(*map(range, self.array))]  # noqa: E741
        return tuple(
            replace(
                self,
                array=(1, 1),
                origin=view.window,
                left=left + view.l,
                steered=(),
                rotation=view.rotation,
                above=(view.k, rows),
            )
            for view in views
        )

    @property
    def is_sliding(self) -> bool:
        """True if its sensor pixels are all the averages over m x m boxes inside its field: it is shift-invariant."""
        whole = self.ratio.denominator == 1 and self.array == (int(self.ratio), int(self.ratio))
        return whole and not self.steered and self.step == (1, 1)

    @property
    def is_aligned(self) -> bool:
        """True if sensor pixels of pinholes begin and end between pixels of f, so that all cut these alike."""
        ends = [number for part in self.on_grids for number in (*part.origin, *part.step, part.ratio)]
        return not self.is_rotated and all(number.denominator == 1 for number in ends)

    @property
    def covers_whole_pixels(self) -> bool:
        """True if footprints of pinholes are whole pixels of f."""
        return self.is_aligned and all(number.denominator == 1 for number in (*self.footprint, *self.inset))

    @property
    def bounds(self) -> tuple[tuple[Fraction, Fraction], tuple[Fraction, Fraction]]:
        """First row and end of the rows of f that some sub-imager sees, and the same of columns, without rotation."""
        parts = self.on_grids
        rows, columns = (
            (
                Fraction(min(part.origin[axis] for part in parts)),
                max(part.origin[axis] + part.span[axis] for part in parts),
            )
            for axis in (0, 1)
        )
        return rows, columns

    def starts(self, axis: int) -> tuple[Fraction, ...]:
        """Row (axis 0) or column (1) of f where the view of each sub-imager of the grid along this axis begins."""
        return tuple(self.origin[axis] + number * self.step[axis] for number in range(self.array[axis]))

    @property
    def described_step(self) -> str:
        """The step as text: one number, or two if they differ."""
        down, across = self.step
        return str(down) if down == across else f"{down} down, {across} across"

    def middle(self, window: tuple[Fraction, Fraction]) -> tuple[float, float]:
        """Row and column of f in the middle of the view of a sub-imager whose view begins at `window`."""
        row, column = (start + self.ratio * count / 2 for start, count in zip(window, self.pixels, strict=True))
        return float(row), float(column)

    @property
    def span(self) -> tuple[Fraction, Fraction]:
        """Rows and columns of f that all sub-imagers of the grid together see."""
        rows, columns = (
            self.ratio * pixels + (count - 1) * step
            for count, pixels, step in zip(self.array, self.pixels, self.step, strict=True)
        )
        return rows, columns

    def centred(self, rows: int, columns: int) -> LensType:
        """The same lens type in the middle of a target, to the nearest whole pixel of f, the lower one of two."""
        top, left = (ceil((size - span - 1) / 2) for size, span in zip((rows, columns), self.span, strict=True))
        return replace(self, origin=(top, left))

    def gaps(self, shape: tuple[int, int]) -> tuple[tuple[Fraction, Fraction], ...]:
        """Pixels of f before and after what all sub-imagers together see, along the rows and columns of `shape`."""
        return tuple(
            (Fraction(start), size - span - start)
            for start, span, size in zip(self.origin, self.span, shape, strict=True)
        )


@dataclass(frozen=True)
class SubImager:
    """One lens and the sensor patch behind it.

    window : row and column of f where its view begins
    lens, patch : (x, y) of their centres;  rotation : of the patch
    depth, distance : from the lens to the patch, and to the target
    """

    type: LensType
    k: int
    l: int  # noqa: E741  (the paper's letter)
    window: tuple[Fraction, Fraction]
    lens: tuple[float, float]
    patch: tuple[float, float]
    depth: float
    distance: float
    rotation: float = 0.0

    @property
    def name(self) -> str:
        """Name of its part in a stack: type.k.l."""
        return f"{self.type.name}.{self.k:02d}.{self.l:02d}"


def check_counts(types: Iterable[LensType], source: Path) -> None:
    """Raise InputError, which names the scene file, for too many sub-imagers."""
    counts = {lens_type.name: lens_type.count for lens_type in types}
    for name, count in counts.items():
        if count > MOST_SUB_IMAGERS:
            raise InputError(
                f"{source}: camera.lens.{name}.array has {count} sub-imagers, expected at most"
                f" {MOST_SUB_IMAGERS} per lens type; use fewer"
            )
    if sum(counts.values()) > MOST_OF_ALL_TYPES:
        raise InputError(f"{source}: camera.lens: expected at most {MOST_OF_ALL_TYPES} sub-imagers in all; use fewer")
