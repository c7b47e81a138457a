"""Geometry of a flat camera: one sensor behind arrays of micro-lenses, looking at a flat target.

Lengths are millimetres. The camera looks along +z from the plane of the foremost lenses, z = 0, with +y up, so the
columns of an upright image run towards -x and its rows towards -y. Positions on the target called `row` and
`column` are in pixels of the target, f, from its top left corner. The order of measurements everywhere: lens
types as listed, sub-imagers (k, l) by rows, then pixels by rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import accumulate
from math import floor, hypot
from typing import Any

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError, named
from ommatid.runtime.machine import check_memory

from .constants import AIRY_FIRST_ZERO, MOST_DENSE
from .formats.picture import target_shape
from .layout import check_overlap, check_sensor, whole_pixels, with_steering
from .lens_type import LensOptics, LensType, SubImager, adjacent_slices, check_counts
from .optics.spectrum import wavelengths_of
from .scene import Scene
from .tables.camera import LensTable, ToleranceTable

MOST_MEASUREMENTS = 2**30
PLANES = 4  # arrays of the target's or the sensor's size that every stage holds at once


@dataclass(frozen=True)
class Camera:
    """All lens types, and the target's grid on which the image is reconstructed.

    lens_columns : columns of sub-imagers on the sensor, those of types left out by `restrict` included
    detail : the world's grid is so many times finer than f
    wavelength : the mean, if there are several;  bands : each wavelength and the share of electrons that it frees
    walls : False if light of every lens reaches every patch
    distance : from the foremost lenses to the target
    sensor_distance : from one sensor behind all lenses to the target; None if all lenses stand in one plane
    """

    rows: int
    columns: int
    target_pitch: float
    distance: float
    pixel_pitch: float
    lens_pitch: float
    types: tuple[LensType, ...]
    wavelength: float | None = None
    tolerance: ToleranceTable | None = None
    lens_columns: int | None = None
    detail: int = 1
    bands: tuple[tuple[float, float], ...] = ()
    walls: bool = True
    sensor_distance: float | None = None

    def __repr__(self) -> str:
        """Return target and lens types in one line."""
        lenses = named(lens.name for lens in self.types)
        return f"<Camera: target {self.rows} x {self.columns} pixels, lens types {lenses}>"

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """Wavelengths over which diffraction and dispersion are averaged, with weights of sum 1; none: rays alone."""
        return () if self.wavelength is None else self.bands or ((self.wavelength, 1.0),)

    @property
    def world(self) -> Camera:
        """The same camera described on the grid of the world, `detail` times finer than f along both axes."""
        if self.detail == 1:
            return self
        finer, types = self.detail, tuple(lens_type.finer(self.detail) for lens_type in self.types)
        rows, columns, pitch = self.rows * finer, self.columns * finer, self.target_pitch / finer
        return replace(self, rows=rows, columns=columns, target_pitch=pitch, types=types, detail=1)

    @property
    def with_grid_of_matrix(self) -> Camera:
        """The camera on the grid of H's columns: the world's, or f's where its detail does not matter."""
        return self.world if self.has_detail else replace(self, detail=1)

    @property
    def has_detail(self) -> bool:
        """True if the world is finer than f, and measurements depend on its detail."""
        return self.detail > 1 and not self.covers_whole_pixels

    @property
    def covers_whole_pixels(self) -> bool:
        """True if every sensor pixel averages whole pixels of f, so that detail finer than f changes no measurement."""
        whole = all(lens.covers_whole_pixels for lens in self.types)
        sharp = all(lens.optics.surfaces is None for lens in self.types) and self.has_box_footprints
        return whole and sharp and self.tolerance is None

    @property
    def unknowns(self) -> int:
        """N, number of pixels of f."""
        return self.rows * self.columns

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.rows, self.columns

    @property
    def measurements(self) -> int:
        """M, number of sensor pixels of all sub-imagers."""
        return sum(lens_type.measurements for lens_type in self.types)

    def distance_of(self, lens_type: LensType) -> float:
        """Distance from a type's lenses to the target.

        In front of one sensor it is the one whose image has the type's magnification: their distances from the sensor
        and from the target have the ratio of the magnification and the same sum.
        """
        if self.sensor_distance is None:
            return self.distance
        magnification = self.pixel_pitch / (float(lens_type.ratio) * self.target_pitch)
        return self.sensor_distance / (1 + magnification)

    def height(self, lens_type: LensType) -> float:
        """Distance of a type's lenses behind the foremost ones."""
        return self.distance_of(lens_type) - self.distance

    def depth(self, lens_type: LensType) -> float:
        """Distance of a type's sensor behind its lenses: its magnification times the target's distance from them."""
        return self.distance_of(lens_type) * self.pixel_pitch / (float(lens_type.ratio) * self.target_pitch)

    def optical_magnification(self, lens_type: LensType) -> float:
        """Magnification of a type's image on the sensor, in lengths."""
        return self.depth(lens_type) / self.distance_of(lens_type)

    def diffusion(self, lens_type: LensType) -> float:
        """Standard deviation of the blur of a type's pixels on the target, in pixels of f; 0 without one."""
        return (lens_type.optics.pixel_blur or 0.0) / self.pixel_pitch * float(lens_type.ratio)

    def airy_pixels(self, lens_type: LensType, aperture: float, wavelength: float) -> float:
        """Diameter, in sensor pixels, of the Airy disk behind an aperture before a type's sensor."""
        return 2 * AIRY_FIRST_ZERO * wavelength * self.depth(lens_type) / aperture / self.pixel_pitch

    def focal_length(self, lens_type: LensType) -> float:
        """Focal length by the thin-lens equation, 1/focal_length = 1/focus + 1/depth."""
        return 1.0 / (1.0 / self.focus(lens_type) + 1.0 / self.depth(lens_type))

    def focus(self, lens_type: LensType) -> float:
        """Distance at which a type's lenses are in focus."""
        return self.distance_of(lens_type) if lens_type.optics.focus is None else lens_type.optics.focus

    @property
    def has_width(self) -> bool:
        """True if a lens type has an aperture or surfaces: not all are pinholes."""
        return any(lens.optics.has_width for lens in self.types)

    @property
    def half_diagonal(self) -> float:
        """Distance from the middle of the target to its corner: r = 1 of a distortion."""
        return self.target_pitch * hypot(self.rows, self.columns) / 2

    @property
    def is_ideal_pinhole(self) -> bool:
        """True for well-aligned pinholes without distortion, whose H is a product of overlaps of intervals."""
        return self.tolerance is None and all(lens.optics.is_pinhole and not lens.is_rotated for lens in self.types)

    @property
    def has_stock_sensors(self) -> bool:
        """True if Mitsuba's own sensors render it: ideal pinholes before pixels open as a whole, without blur."""
        return self.is_ideal_pinhole and all(lens_type.is_open for lens_type in self.types)

    @property
    def has_box_footprints(self) -> bool:
        """True if the designed H averages f over boxes: without distortion, rotation and blur, and with walls."""
        return all(self.has_boxes(lens_type) for lens_type in self.types)

    def has_boxes(self, lens_type: LensType) -> bool:
        """True if the designed H of a lens type averages f over boxes."""
        bent = lens_type.optics.distortion is not None or lens_type.is_rotated
        return self.walls and not (bent or self.is_blurred(lens_type))

    def has_kernel(self, lens_type: LensType) -> bool:
        """True if the designed H of a lens type may be a few kernels: it is blurred, and its pixels are aligned.

        Kernels of surfaces are traced, and held by a model; distortion of more than a pixel or so is not held by them.
        """
        if lens_type.optics.distortion is not None or (lens_type.optics.surfaces is not None and lens_type.steered):
            return False
        return self.walls and self.is_blurred(lens_type) and lens_type.is_aligned

    @property
    def has_surfaces(self) -> bool:
        """True if a lens type has surfaces."""
        return any(lens_type.optics.surfaces is not None for lens_type in self.types)

    @property
    def has_structure(self) -> bool:
        """True if the designed H consists of boxes and kernels."""
        return all(self.has_boxes(lens_type) or self.has_kernel(lens_type) for lens_type in self.types)

    @property
    def is_sliding(self) -> bool:
        """True if the camera is shift-invariant except at the edges and for what varies over a lens's field."""
        return all(lens_type.is_sliding for lens_type in self.types)

    @property
    def is_applied(self) -> bool:
        """True if the designed H, on the grid of its columns, needs no entries: boxes, or kernels of large frames."""
        camera = self.with_grid_of_matrix
        return camera.has_box_footprints or (camera.has_structure and camera.unknowns > MOST_DENSE)

    def is_blurred(self, lens_type: LensType) -> bool:
        """True if a pixel sees more than a box: by surfaces, defocus, diffraction or its own blur."""
        if lens_type.optics.pixel_blur is not None:
            return True
        if lens_type.optics.aperture is None:
            return lens_type.optics.surfaces is not None
        return self.wavelength is not None or self.focus(lens_type) != self.distance_of(lens_type)

    @property
    def has_sharp_footprints(self) -> bool:
        """True if footprints have a closed form even when misaligned: no surfaces, and no blur."""
        defocused = self.tolerance is not None and (self.tolerance.focal_length or self.tolerance.tilt)
        return self.walls and not any(
            lens_type.optics.surfaces is not None
            or self.is_blurred(lens_type)
            or (lens_type.optics.aperture is not None and defocused)
            for lens_type in self.types
        )

    @cached_property
    def middles(self) -> tuple[FloatArray, FloatArray]:
        """Row and column of the middle of each measurement's footprint: (M,) each."""
        places: list[FloatArray] = []
        for lens_type in self.on_grids.types:
            ratio = float(lens_type.ratio)
            axes = [
                np.add.outer([float(start) for start in lens_type.starts(axis)], ratio * (np.arange(pixels) + 0.5))
                for axis, pixels in enumerate(lens_type.pixels)
            ]
            grid = np.meshgrid(*(axis.ravel() for axis in axes), indexing="ij")
            places.append(np.stack([lens_type.in_order(line) for line in grid]))
        row, column = np.concatenate(places, axis=1)
        return row, column

    @property
    def received(self) -> FloatArray:
        """What a reading counts of the mean light on its sensor pixel, by its open part and by binning: (M,)."""
        shares = [float(each.light) for each in self.types]
        if all(share == 1 for share in shares):
            return np.broadcast_to(1.0, self.measurements)
        return np.repeat(shares, [each.measurements for each in self.types])

    @cached_property
    def sub_imagers(self) -> tuple[SubImager, ...]:
        """Every sub-imager, in the order of measurements."""
        return tuple(
            self.sub_imager(index, k, l)
            for index, lens_type in enumerate(self.types)
            for k in range(lens_type.array[0])
            for l in range(lens_type.array[1])  # noqa: E741
        )

    def sub_imager(self, index: int, k: int, l: int) -> SubImager:  # noqa: E741
        """Sub-imager (k, l) of the lens type `types[index]`; types lie side by side on the sensor."""
        lens_type = self.types[index]
        columns = sum(other.array[1] for other in self.types) if self.lens_columns is None else self.lens_columns
        left = sum(other.array[1] for other in self.types[:index]) if lens_type.left is None else lens_type.left
        lens_x = ((columns - 1) / 2 - (left + l)) * self.lens_pitch
        above, rows = lens_type.above or (0, lens_type.array[0])
        lens_y = ((rows - 1) / 2 - above - k) * self.lens_pitch
        view = lens_type.view(k, l)
        x, y = self.position(*lens_type.middle(view.window))
        distance, depth = self.distance_of(lens_type), self.depth(lens_type)
        shrink = self.optical_magnification(lens_type)
        patch = lens_x + (lens_x - x) * shrink, lens_y + (lens_y - y) * shrink
        return SubImager(lens_type, k, l, view.window, (lens_x, lens_y), patch, depth, distance, view.rotation)

    @cached_property
    def on_grids(self) -> Camera:
        """The same camera, in which every sub-imager of an array with steered ones is a lens type of its own."""
        if not any(lens_type.steered for lens_type in self.types):
            return self
        return replace(self, types=tuple(part for lens_type in self.types for part in lens_type.on_grids))

    def position(self, row: float, column: float) -> tuple[float, float]:
        """(x, y) on the target plane of a point given in pixels of f."""
        return (self.columns / 2 - column) * self.target_pitch, (self.rows / 2 - row) * self.target_pitch

    def slices(self) -> list[slice]:
        """The measurements of each sub-imager."""
        return adjacent_slices(sub.type.pixels[0] * sub.type.pixels[1] for sub in self.sub_imagers)

    def type_slices(self) -> list[slice]:
        """The measurements of each lens type."""
        return adjacent_slices(lens_type.measurements for lens_type in self.types)

    def types_seeing(self) -> IntArray:
        """Number of lens types that see each pixel of f as a whole: (rows, columns)."""
        count = np.zeros(self.shape, dtype=np.int64)
        for lens_type in self.types:
            count += whole_pixels(lens_type, self.shape)
        return count

    def restrict(self, names: tuple[str, ...]) -> tuple[Camera, BoolArray]:
        """The camera with only the named lens types, and a mask of their measurements. Raises InputError."""
        known = [lens_type.name for lens_type in self.types]
        for name in names:
            if name not in known or names.count(name) > 1:
                raise InputError(
                    f"--lens {','.join(names)}: expected each of {', '.join(known)} at most once, got '{name}'"
                )
        mask = np.concatenate([np.full(lens_type.measurements, lens_type.name in names) for lens_type in self.types])
        return replace(self, types=tuple(lens_type for lens_type in self.types if lens_type.name in names)), mask

    def describe(self) -> dict[str, Any]:
        """The properties that a stack and a model must agree in, in JSON's types; part of fingerprints."""
        description: dict[str, Any] = {
            "target.shape": [self.rows, self.columns],
            "target.pixel_pitch": self.target_pitch,
            "target.distance": self.distance,
            "camera.pixel_pitch": self.pixel_pitch,
            "camera.lens_pitch": self.lens_pitch,
        }
        for index, lens_type in enumerate(self.types):
            description[f"camera.lens.{lens_type.name}"] = {
                "place": index,
                "magnification": str(1 / lens_type.ratio),
                "array": list(lens_type.array),
                "pixels": list(lens_type.pixels),
                "step": lens_type.described_step,
                **({} if lens_type.is_open else {"open": lens_type.opening, "light": str(lens_type.light)}),
                **lens_type.optics.describe(),
                **({"sub_imagers": [each.describe() for each in lens_type.steered]} if lens_type.steered else {}),
            }
        if not self.is_ideal_pinhole:  # sub-images of ideal pinholes do not depend on where the lenses are
            description["camera.places"] = [self.lens_columns, *(lens_type.left for lens_type in self.types)]
        bands = [list(band) for band in self.bands] or None
        optional = ("target.detail", self.detail, 1), ("camera.wavelength", self.wavelength, None)
        optional += ("camera.bands", bands, None), ("camera.walls", self.walls, True)
        optional += (("camera.sensor_distance", self.sensor_distance, None),)
        description |= {key: value for key, value, default in optional if value != default}
        if self.tolerance is not None:
            description["camera.tolerance"] = self.tolerance.model_dump(mode="json")
        return description


def derive(scene: Scene) -> Camera:
    """Derive the camera of a scene. Raises InputError if arrays do not fit the target, or sub-images the sensor."""
    (rows, columns), (wavelength, bands) = target_shape(scene), wavelengths_of(scene)
    types = tuple(_lens_type(lens, rows, columns, scene) for lens in scene.camera.lens)
    lefts = list(accumulate((lens_type.array[1] for lens_type in types), initial=0))
    camera = Camera(
        rows=rows,
        columns=columns,
        target_pitch=scene.target.pixel_pitch,
        distance=scene.target.distance,
        pixel_pitch=scene.camera.pixel_pitch,
        lens_pitch=scene.camera.lens_pitch,
        types=tuple(replace(lens_type, left=left) for lens_type, left in zip(types, lefts, strict=False)),
        wavelength=wavelength,
        tolerance=scene.camera.tolerance,
        lens_columns=lefts[-1],
        detail=scene.target.detail,
        bands=bands,
        walls=scene.camera.walls,
        sensor_distance=scene.sensor_distance,
    )
    check_counts(types, scene.source)
    needed = PLANES * 8 * (camera.world.unknowns + camera.measurements)
    check_memory(needed, f"{scene.source}: a target of {rows} x {columns} pixels", "make target.shape smaller")
    if camera.measurements > MOST_MEASUREMENTS:
        raise InputError(
            f"{scene.source}: the lens arrays have {camera.measurements} pixels, expected at most 2^30; use fewer"
        )
    check_overlap(camera.types, camera.sub_imager, camera.pixel_pitch, scene.source)
    check_sensor(scene, camera.sub_imagers)
    return camera


def _lens_type(lens: LensTable, rows: int, columns: int, scene: Scene) -> LensType:
    ratio = 1 / lens.magnification
    most = tuple(
        floor((size - (count - 1) * step) / ratio)
        for size, count, step in zip((rows, columns), lens.array, lens.step, strict=True)
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
            f" but a {rows} x {columns}-pixel target holds at most {most[0]} x {most[1]}; use 'fit'"
        )
    surfaces = None if isinstance(lens.surfaces, str) else lens.surfaces  # reading the scene replaced file names
    blur = scene.camera.pixel_blur
    optics = LensOptics(lens.aperture, lens.focus, lens.distortion, surfaces, lens.scale, lens.coating, blur)
    part = scene.camera.fill_factor if lens.fill_factor is None else lens.fill_factor
    light = Fraction(1) if scene.camera.fill_light == "kept" else part[0] * part[1]
    light *= ratio**2 if scene.camera.binning == "sum" else 1
    lens_type = LensType(lens.name, ratio, lens.array, pixels, lens.step, (0, 0), optics, open=part, light=light)
    return with_steering(lens_type.centred(rows, columns), lens.sub_imager or (), (rows, columns), scene.source)
