"""Rays from the sensor through the surfaces of a real lens into the world, on Mitsuba's fast backends.

Light that is waves leaves in directions drawn from the point-spread function of the sensor point at the distance of
what it meets. Before a flat target this is the target's. In a world the ray of geometrical optics through a point of
the pupil finds the distance. (Where a surface ends before another, the pattern on either is not exact.)
"""

# pyright: basic
from __future__ import annotations

from math import ceil, pi
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.optics.field import (
    SurfaceOptics,
    bands,
    check_waves,
    exit_disk_of,
    prescription_of,
    sampling_tables,
    surface_optics,
    vergence_shifts,
)
from ommatid.scenes.optics.ray_trace import Functions, path, trace
from ommatid.scenes.optics.wavefront import GRID_REACH

from .lens import Distance, Emission, LensModel, Point, drawn_bands
from .loaded import dr, mi

HEIGHTS = 257  # off the axis, between which the middle and the amount of the light are interpolated linearly
CELLS, FEW = 8, 4  # of the grid that slopes are drawn from, per wavelength times f-number; where defocus varies
FEW_REACH = 20.0  # of that grid where defocus varies
WAVES = 3.0  # of defocus, beyond which light is rays in a world
NEAR = 20.0  # pupil radii: surfaces that are nearer get light as rays
STEP = 0.125  # waves between tabulated defoci, between which the light of the two is mixed
SAME = 1e-3  # waves by which defocus may vary without a table of several
TINY = 1e-6  # share of the light that lands within a million times the largest slope
FARTHEST = 1e-9  # vergence of the farthest surface


class RealLens(LensModel):
    """A lens of surfaces, whose light is rays."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType) -> None:
        """Create the model of a lens type with surfaces. Raises InputError if these form no image or pass no light."""
        super().__init__(camera, lens_type)
        lens = prescription_of(camera, lens_type)
        numbers = path(lens, exit_disk_of(camera, lens_type, lens))
        self._numbers = numbers.converted(lambda number: dr.opaque(mi.Float, float(number)))
        self._functions = Functions(dr.sqrt, dr.select, dr.maximum)

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        del lens
        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        (at_x, at_y), direction, weight, _ = trace(self._numbers, x, y, on_disk.x, on_disk.y, depth, self._functions)
        return (at_x, at_y, 0), direction, weight


class WaveLens(RealLens):
    """A lens of surfaces, whose light is waves of one or several wavelengths."""

    def __init__(self, camera: Camera, lens_type: LensType, fields: list[tuple[SurfaceOptics, float]]) -> None:
        """Create the model of a lens type with its fields at the wavelengths of the light, and their shares."""
        super().__init__(camera, lens_type)
        self._fields, self._depth, self._vergence = fields, camera.depth(lens_type), 1 / camera.distance_of(lens_type)
        self._focus = 1 / camera.focus(lens_type)
        self._distance: Distance | None = None
        self._shifts = vergence_shifts(camera, lens_type)
        self._tabulate([self._vergence + shift for shift in self._shifts], CELLS, GRID_REACH)

    def follow(self, distance: Distance) -> None:
        """Let rays have the pattern of the distance of the surface that they meet."""
        self._distance = distance
        field, least, largest = self._fields[0][0], *self._shifts
        wave = 1 / field.waves_of(1.0)  # of defocus, as a vergence
        low, high = self._focus - WAVES * wave, self._focus + WAVES * wave
        self._tabulate(
            [max(low, FARTHEST + least), min(high, 1 / (NEAR * field.pupil_radius) + largest)], FEW, FEW_REACH
        )
        self.captured = 1.0  # rays go where the rest of the light lands, too

    def _tabulate(self, ends: list[float], cells: int, beyond: float) -> None:
        self._bands = [_Band(field, share, ends, cells, beyond) for field, share in self._fields]
        shares = [share for _, share in self._fields]
        self.captured = float(np.average([band.captured for band in self._bands], weights=shares))

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        sample, bands = sampler.next_2d(), drawn_bands([band.share for band in self._bands], sampler)
        vergence, ray = self._vergence, None
        if self._distance is not None:
            ray = super().emit(x, y, depth, sampler, lens)
            vergence = self._met(self._distance, ray, x, y, depth, lens)
        vergence += 1 / depth - 1 / self._depth
        found = 0.0, 0.0, 0.0
        for later, band in zip(bands, self._bands, strict=True):
            of_band = band.emit(x, y, self._depth / depth, vergence, sample, ray is not None)
            found = [dr.select(later, new, old) for new, old in zip(of_band, found, strict=True)]
        across, up, weight = found
        if ray is None:
            return (0, 0, 0), (across, up, 1), weight
        # Nearer or further than the tables go, light is rays.
        inside = (vergence >= self._bands[0].ends[0]) & (vergence <= self._bands[0].ends[1])
        (at_x, at_y, _), (u, v, w), traced = ray
        origin = dr.select(inside, 0.0, at_x), dr.select(inside, 0.0, at_y), 0
        slopes = dr.select(inside, across, u / w), dr.select(inside, up, v / w), 1
        return origin, slopes, dr.select(inside, weight, traced)

    def _met(self, distance: Distance, ray: Emission, x: Any, y: Any, depth: Any, lens: Point) -> Any:
        """Return 1 over the distance that a ray goes, or the ray through the middle of the lens if it is blocked."""
        (at_x, at_y, _), direction, weight = ray
        passed = weight > 0
        start = lens[0] + dr.select(passed, at_x, 0.0), lens[1] + dr.select(passed, at_y, 0.0), 0
        chief = (*self._bands[0].chief(x, y, self._depth / depth), 1)
        return 1 / distance(start, [dr.select(passed, *pair) for pair in zip(direction, chief, strict=True)])


class _Band:
    """The tables of a lens type at one wavelength, whose share of the light is `share`."""

    def __init__(self, field: SurfaceOptics, share: float, ends: list[float], cells: int, beyond: float) -> None:
        """Tabulate the slopes between two vergences of the target, or at one if these are the same."""
        self.share, self.ends, self._last = share, ends, field.field
        heights = np.linspace(0.0, field.field, HEIGHTS)
        # The ratio of heights on the target and on the sensor; that on the axis is the limit.
        near = np.maximum(heights, 1e-6 * field.field)
        self._scale = _table(field.chief_ray(near, np.zeros(HEIGHTS))[0] / near / field.distance)
        self._light = _table(field.lit_share(heights))
        waves = field.waves_of(ends[1] - ends[0])
        vergences = np.linspace(ends[0], ends[1], ceil(waves / STEP) + 1) if waves > SAME else np.array([sum(ends) / 2])
        densities, self._width, self.captured = sampling_tables(field, vergences, cells, beyond)
        densities, self._varies = densities.astype(np.float32), vergences.size > 1
        nodes = [field.nodes[0].tolist()]
        self._slopes: Any = (
            mi.MarginalContinuous2D2(densities, [*nodes, vergences.tolist()])
            if self._varies
            else mi.MarginalContinuous2D1(densities[:, 0], nodes)
        )

    def chief(self, x: Any, y: Any, nearer: Any) -> tuple[Any, Any]:
        """Return the mean slopes of the light of a sensor point whose depth is the designed one over `nearer`."""
        scale = self._interpolated(self._scale, dr.sqrt(x * x + y * y)) * nearer
        return x * scale, y * scale

    def emit(self, x: Any, y: Any, nearer: Any, vergence: Any, sample: Any, all_light: bool) -> tuple[Any, Any, Any]:
        """Return the slopes of a ray and its weight; `all_light` is False for the light within the table alone."""
        height, (across, up) = dr.sqrt(x * x + y * y), self.chief(x, y, nearer)
        at = [dr.minimum(height, self._last)]
        share = self.captured if all_light else 1.0
        within = type(sample)(dr.minimum(sample.x / share, 1.0), sample.y)
        drawn, _ = self._slopes.sample(within, [*at, dr.clip(vergence, *self.ends)] if self._varies else at)
        beside, along = (drawn.x - 0.5) * self._width, (drawn.y - 0.5) * self._width
        if all_light:  # the light beyond radius r falls as 1 / r
            beyond, (turn, other) = sample.x > share, dr.sincos(2 * pi * sample.y)
            radius = self._width / 2 * (1 - share) / dr.maximum(1 - sample.x, TINY)
            beside, along = dr.select(beyond, radius * turn, beside), dr.select(beyond, radius * other, along)
        cosine = dr.select(height > 0, y / height, 1.0)
        sine = dr.select(height > 0, x / height, 0.0)
        weight = self._interpolated(self._light, height)
        return across + along * sine + beside * cosine, up + along * cosine - beside * sine, weight

    def _interpolated(self, table: Any, height: Any) -> Any:
        position = dr.minimum(height / self._last, 1.0) * (HEIGHTS - 1)
        lower = dr.minimum(mi.UInt32(position), HEIGHTS - 2)
        low, high = (dr.gather(mi.Float, table, index) for index in (lower, lower + 1))
        return dr.lerp(low, high, position - mi.Float(lower))


def _table(values: FloatArray) -> Any:
    return mi.Float(values.astype(np.float32))


def real_lens(camera: Camera, lens_type: LensType) -> LensModel:
    """Return the model of a lens type with surfaces: of waves, unless light is rays or diffraction is negligible.

    Raises InputError if the surfaces form no image or pass no light.
    """
    fields = [(surface_optics(camera, lens_type, wavelength), share) for wavelength, share in bands(camera)]
    for field, _ in fields:
        check_waves(lens_type, field)
    if any(field.rays_suffice for field, _ in fields):
        return RealLens(camera, lens_type)
    return WaveLens(camera, lens_type, fields)
