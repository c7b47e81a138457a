"""Geometry of a flat camera: one sensor behind arrays of micro-lenses, looking at a flat target.

Lengths are millimetres. The camera looks along +z from the plane of the lenses, z = 0, with +y up, so the
columns of an upright image run towards -x and its rows towards -y. Positions on the target called `row` and
`column` are in pixels of the target, f, from its top left corner. The order of measurements everywhere: lens
types as listed, sub-imagers (k, l) by rows, then pixels by rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from math import ceil, floor, hypot
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import check_memory

from .formats.picture import shape
from .lens_type import LensOptics, LensType, SubImager
from .scene import Scene
from .tables.camera import LensTable, ToleranceTable

MOST_MEASUREMENTS = 2**30
MOST_SUB_IMAGERS = 2**14
PLANES = 4  # arrays of the target's or the sensor's size that everything has to hold


@dataclass(frozen=True)
class Camera:
    """All lens types, and the target's grid that they are to resolve."""

    rows: int
    columns: int
    target_pitch: float
    distance: float
    pixel_pitch: float
    lens_pitch: float
    types: tuple[LensType, ...]
    wavelength: float | None = None
    tolerance: ToleranceTable | None = None
    lens_columns: int | None = None  # columns of sub-imagers, those of types that were left out later among them

    @property
    def unknowns(self) -> int:
        """N, pixels of f."""
        return self.rows * self.columns

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.rows, self.columns

    @property
    def measurements(self) -> int:
        """M, sensor pixels of all sub-imagers."""
        return sum(kind.measurements for kind in self.types)

    def depth(self, kind: LensType) -> float:
        """Distance of a type's sensor behind its lenses: its magnification times the target's distance."""
        return self.distance * self.pixel_pitch / (float(kind.ratio) * self.target_pitch)

    def focal_length(self, kind: LensType) -> float:
        """From the thin-lens equation, 1/focal_length = 1/focus + 1/depth."""
        return 1.0 / (1.0 / self.focus(kind) + 1.0 / self.depth(kind))

    def focus(self, kind: LensType) -> float:
        """Distance that a type's lenses show sharp."""
        return self.distance if kind.optics.focus is None else kind.optics.focus

    @property
    def corner(self) -> float:
        """From the middle of the target to its corner: r = 1 of a distortion."""
        return self.target_pitch * hypot(self.rows, self.columns) / 2

    @property
    def is_ideal_pinhole(self) -> bool:
        """Whether it is a set of pinholes that stand where they should: then H is a product of overlaps."""
        return self.tolerance is None and all(kind.optics.pinhole for kind in self.types)

    @property
    def has_box_footprints(self) -> bool:
        """Whether H of the camera as designed averages f over boxes: no distortion, and no blur that is known."""
        return all(kind.optics.distortion is None and not self.is_blurred(kind) for kind in self.types)

    def is_blurred(self, kind: LensType) -> bool:
        """Whether a thin lens shows a point of the target as a disk: out of focus, or by diffraction."""
        if kind.optics.aperture is None:
            return False
        return self.wavelength is not None or self.focus(kind) != self.distance

    @property
    def has_sharp_footprints(self) -> bool:
        """Whether footprints of misaligned sub-imagers are known in closed form: no surfaces, and no blur."""
        moved = self.tolerance is not None and (self.tolerance.focal_length or self.tolerance.tilt)
        return not any(
            kind.optics.surfaces is not None or self.is_blurred(kind) or (kind.optics.aperture is not None and moved)
            for kind in self.types
        )

    @cached_property
    def sub_imagers(self) -> tuple[SubImager, ...]:
        """Every sub-imager, in the order of measurements."""
        places = enumerate(self.types)
        return tuple(
            self.sub_imager(place, k, l)
            for place, kind in places
            for k in range(kind.array[0])
            for l in range(kind.array[1])  # noqa: E741
        )

    def sub_imager(self, place: int, k: int, l: int) -> SubImager:  # noqa: E741
        """Sub-imager (k, l) of the lens type that stands at `place` in the list; types stand side by side."""
        kind = self.types[place]
        across = sum(other.array[1] for other in self.types) if self.lens_columns is None else self.lens_columns
        left = sum(other.array[1] for other in self.types[:place]) if kind.left is None else kind.left
        x = ((across - 1) / 2 - (left + l)) * self.lens_pitch
        y = ((kind.array[0] - 1) / 2 - k) * self.lens_pitch
        return self._sub_imager(kind, k, l, (x, y))

    def _sub_imager(self, kind: LensType, k: int, l: int, lens: tuple[float, float]) -> SubImager:  # noqa: E741
        window = kind.origin[0] + k * kind.step, kind.origin[1] + l * kind.step
        x, y = self.position(*kind.middle(window))
        depth = self.depth(kind)
        shrink = depth / self.distance
        patch = lens[0] + (lens[0] - x) * shrink, lens[1] + (lens[1] - y) * shrink
        return SubImager(kind, k, l, window, lens, patch, depth)

    def position(self, row: float, column: float) -> tuple[float, float]:
        """(x, y) on the target plane of a point given in pixels of f."""
        return (self.columns / 2 - column) * self.target_pitch, (self.rows / 2 - row) * self.target_pitch

    def slices(self) -> list[slice]:
        """Where each sub-imager's pixels stand among the measurements."""
        found: list[slice] = []
        start = 0
        for sub in self.sub_imagers:
            size = sub.type.pixels[0] * sub.type.pixels[1]
            found.append(slice(start, start + size))
            start += size
        return found

    def type_slices(self) -> list[slice]:
        """Where each lens type's pixels stand among the measurements."""
        ends = list(accumulate((kind.measurements for kind in self.types), initial=0))
        return [slice(first, last) for first, last in pairwise(ends)]

    def types_seeing(self) -> NDArray[np.int64]:
        """(rows, columns): by how many lens types each pixel of f is seen whole."""
        seen = np.zeros(self.shape, dtype=np.int64)
        for kind in self.types:
            axes = [np.zeros(size, dtype=np.int64) for size in self.shape]
            for axis, marked in enumerate(axes):
                for number in range(kind.array[axis]):
                    start = kind.origin[axis] + number * kind.step
                    marked[ceil(start) : floor(start + kind.ratio * kind.pixels[axis])] = 1
            seen += np.outer(*axes)
        return seen

    def restrict(self, names: tuple[str, ...]) -> tuple[Camera, NDArray[np.bool_]]:
        """The camera with only the named lens types, and which measurements are theirs. Raises InputError."""
        known = [kind.name for kind in self.types]
        for name in names:
            if name not in known or names.count(name) > 1:
                asked = ",".join(names)
                raise InputError(f"--lens {asked}: expected each of {', '.join(known)} at most once, got '{name}'")
        kept = np.concatenate([np.full(kind.measurements, kind.name in names) for kind in self.types])
        return replace(self, types=tuple(kind for kind in self.types if kind.name in names)), kept

    def describe(self) -> dict[str, Any]:
        """What must agree between a stack and a model, in JSON's types."""
        return {
            "target.shape": [self.rows, self.columns],
            "target.pixel_pitch": self.target_pitch,
            "target.distance": self.distance,
            "camera.pixel_pitch": self.pixel_pitch,
            "camera.lens_pitch": self.lens_pitch,
            **{
                f"camera.lens.{kind.name}": {
                    "place": place,
                    "magnification": str(1 / kind.ratio),
                    "array": list(kind.array),
                    "pixels": list(kind.pixels),
                    "step": str(kind.step),
                    **kind.optics.describe(),
                }
                for place, kind in enumerate(self.types)
            },
            # Through pinholes it is all the same where the lenses stand.
            **(
                {}
                if self.is_ideal_pinhole
                else {"camera.places": [self.lens_columns, *(kind.left for kind in self.types)]}
            ),
            **({} if self.wavelength is None else {"camera.wavelength": self.wavelength}),
            **({} if self.tolerance is None else {"camera.tolerance": self.tolerance.model_dump(mode="json")}),
        }


def derive(scene: Scene) -> Camera:
    """The camera that a scene describes.

    Raises InputError if an array does not fit the target or if sub-images overlap on the sensor.
    """
    rows, columns = shape(scene)
    types = tuple(_lens_type(lens, rows, columns, scene) for lens in scene.camera.lens)
    lefts = list(accumulate((kind.array[1] for kind in types), initial=0))
    types = tuple(replace(kind, left=left) for kind, left in zip(types, lefts, strict=False))
    camera = Camera(
        rows=rows,
        columns=columns,
        target_pitch=scene.target.pixel_pitch,
        distance=scene.target.distance,
        pixel_pitch=scene.camera.pixel_pitch,
        lens_pitch=scene.camera.lens_pitch,
        types=types,
        wavelength=scene.camera.wavelength,
        tolerance=scene.camera.tolerance,
        lens_columns=lefts[-1],
    )
    for kind in types:
        if kind.count > MOST_SUB_IMAGERS:
            raise InputError(
                f"{scene.source}: camera.lens.{kind.name}.array has {kind.count} sub-imagers, at most"
                f" {MOST_SUB_IMAGERS} a lens type are served; use fewer"
            )
    needed = PLANES * 8 * (camera.unknowns + camera.measurements)
    check_memory(needed, f"{scene.source}: a target of {rows} x {columns} pixels", "make target.shape smaller")
    if camera.measurements > MOST_MEASUREMENTS:
        raise InputError(f"{scene.source}: the lens arrays have {camera.measurements} pixels, at most 2^30 are served")
    _refuse_overlap(camera, scene)
    return camera


def _lens_type(lens: LensTable, rows: int, columns: int, scene: Scene) -> LensType:
    ratio = 1 / lens.magnification
    most = tuple(
        floor((size - (count - 1) * lens.step) / ratio) for size, count in zip((rows, columns), lens.array, strict=True)
    )
    if min(most) < 1:
        raise InputError(
            f"{scene.source}: camera.lens.{lens.name}.array: {lens.array[0]} x {lens.array[1]} sub-imagers of"
            f" magnification {lens.magnification} do not fit a target of {rows} x {columns} pixels; use fewer"
        )
    pixels = (most[0], most[1]) if lens.pixels == "fit" else lens.pixels
    if pixels[0] > most[0] or pixels[1] > most[1]:
        raise InputError(
            f"{scene.source}: camera.lens.{lens.name}.pixels asks for {pixels[0]} x {pixels[1]} pixels,"
            f" but a {rows} x {columns}-pixel target holds at most {most[0]} x {most[1]}"
        )
    surfaces = None if isinstance(lens.surfaces, str) else lens.surfaces  # a file's name was replaced by what it holds
    glass = LensOptics(lens.aperture, lens.focus, lens.distortion, surfaces, lens.scale)
    kind = LensType(lens.name, ratio, lens.array, pixels, lens.step, (0, 0), glass)
    origin = floor((rows - kind.span[0]) / 2), floor((columns - kind.span[1]) / 2)
    return replace(kind, origin=origin)


def _refuse_overlap(camera: Camera, scene: Scene) -> None:
    # The patches of a type form a regular grid and the types stand side by side, so these neighbours suffice.
    pairs: list[tuple[SubImager, SubImager, int]] = []
    for place, kind in enumerate(camera.types):
        first = camera.sub_imager(place, 0, 0)
        if kind.array[0] > 1:
            pairs.append((first, camera.sub_imager(place, 1, 0), 0))
        if kind.array[1] > 1:
            pairs.append((first, camera.sub_imager(place, 0, 1), 1))
        if place:
            pairs.append((camera.sub_imager(place - 1, 0, camera.types[place - 1].array[1] - 1), first, 1))
    for first, second, axis in pairs:
        apart = first.patch[1 - axis] - second.patch[1 - axis]
        needed = (first.type.pixels[axis] + second.type.pixels[axis]) / 2 * camera.pixel_pitch
        if apart < needed * (1 - 1e-9):
            raise InputError(
                f"{scene.source}: camera.lens_pitch: the sub-images {first.name} and {second.name} overlap on the"
                f" sensor (their centres stand {apart:.4g} mm apart, they need {needed:.4g} mm); widen the pitch"
            )
