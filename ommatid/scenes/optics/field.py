"""What one lens type does over its field: where rays go, how much light passes, and how points blur.

A kind of lens is a class that yields the wave of a sensor point: `ThinOptics` and `SurfaceOptics`. All else follows. A
pinhole whose pixels blur is a thin lens in focus, through which light goes as rays.
Lengths are millimetres, in the coordinates of the lens. The lens is round, so that everything depends on the height of
the sensor point above the axis; point-spread functions turn with its direction. They are computed at nodes of height,
as many as linear interpolation between them needs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import pi
from typing import ClassVar

import numpy as np
from scipy.interpolate import CubicSpline

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..constants import DEVIATIONS
from ..lens_type import LensType
from ..pose import poses
from .point_spread import grid_of, point_spread
from .prescription import Prescription, prescribe
from .ray_trace import Disk, exit_disk
from .wavefront import Wavefront, thin_wavefront, wavefront_of

HEIGHTS = 17  # at which the middle and the amount of the light are traced, splines between
TOLERANCE = 1e-3  # of a point-spread function: the sum of the absolute errors of its cells
MOST_NODES = 17
MOST_WIDER = 2.0  # ratio of the widths of a common grid and of the narrowest that a wave of its own would have
LEAST_VERGENCE = 1e-9  # of a far target; that of 0 has no plane
MOST_ABERRATED = 2.0  # spot of rays in disks of defocus, up to which it is that of defocus
MOST_RINGS = 100.0  # spots of more than so many `resolution`s are computed by rays alone,
MOST_THIN_RINGS = 400.0  # and those of thin lenses: 100 waves of defocus, whose fringes at the rim pixels resolve
FINEST = 1 / 6  # pixels of f, shortest period that the rays of a row of H resolve
MOST_REACH = 1000  # pixels of f
FASTEST = 0.5  # ratio of length to width of a cone of light in air
PINHOLE = 1e-3  # of the depth: an aperture in its place, in focus


@dataclass(frozen=True, eq=False)
class Optics(ABC):
    """One lens type at one wavelength.

    distance : of the target from the front principal plane;  depth : of the sensor behind the rear one
    field : the largest height of a sensor point
    entrance_pupil : its diameter, and how far it is before the front principal plane
    working_f_number : ratio of length to width of the cone of light at the sensor
    """

    depth: float
    distance: float
    field: float
    wavelength: float | None
    focal_length: float
    entrance_pupil: tuple[float, float]
    working_f_number: float
    most_rings: ClassVar[float] = MOST_RINGS

    @abstractmethod
    def wave(self, height: float, wavelength: float | None, half: float = 0.0) -> Wavefront | None:
        """Return the wave of a sensor point (0, height), or None if it gets no light.

        half : of the width of the grid that the wave's nodes serve, where it is wider than that of its own
        """

    def rays(self, height: float, finest: float) -> Wavefront:
        """Return the rays of a sensor point that gets light, as many as resolve a period on the target."""
        del finest
        return _lit(self.wave(height, None), height)

    @cached_property
    def _rays(self) -> tuple[FloatArray, list[Wavefront]]:
        """Heights that get light, the least of them 0, and their rays."""
        heights = np.linspace(0.0, self.field, HEIGHTS)
        found = [(height, self.wave(float(height), None)) for height in heights]
        lit = [(height, wave) for height, wave in found if wave is not None]
        return np.array([height for height, _ in lit]), [wave for _, wave in lit]

    @cached_property
    def _chief_rays(self) -> CubicSpline:
        heights, waves = self._rays
        middles = np.array([wave.centre[1] for wave in waves])
        # The height on the target is an odd function of the height on the sensor.
        return CubicSpline(np.append(-heights[:0:-1], heights), np.append(-middles[:0:-1], middles))

    def chief_ray(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the middle of the light of sensor points on the target, from the lens's axis."""
        height = np.hypot(x, y)
        limited = np.clip(height, 1e-9 * self.field, self._rays[0][-1])
        scale = self._chief_rays(limited) / limited
        return x * scale, y * scale

    def weight(self, height: FloatArray) -> FloatArray:
        """Return the light at sensor points as a projected solid angle, sr; 0 where none arrives."""
        heights, waves = self._rays
        return np.interp(height, heights, [wave.brightness for wave in waves], right=0.0)

    @property
    def reach(self) -> float:
        """How far from its centre the light of a sensor point is computed."""
        spot = max(wave.spot_radius for wave in self._rays[1])
        return spot if self.rays_suffice else max(spot, self.grid[1])

    @property
    def pupil_radius(self) -> float:
        """Radius of the beam on its way to the target."""
        return self._rays[1][0].half_width * self.distance

    def waves_of(self, vergence: float) -> float:
        """Return the defocus at the pupil's rim, in waves, that a change of the target's vergence makes."""
        if self.wavelength is None:
            raise ValueError("expected light with a wavelength, got rays alone")
        return self.pupil_radius**2 * vergence / (2 * self.wavelength)

    @cached_property
    def rays_suffice(self) -> bool:
        """True if light counts as rays: it has no wavelength, or the spots are far wider than diffraction."""
        if self.wavelength is None:
            return True
        _, waves = self._rays
        return any(wave.spot_radius * 2 * wave.half_width > self.most_rings * self.wavelength for wave in waves)

    @property
    def aberrated_rays(self) -> float:
        """The widest spot in finest details of the light where rays stand for aberrated waves, 0 elsewhere.

        Rays describe defocus. The caustics of aberrations are sharper by rays than by waves at any width of the spot.
        """
        if self.wavelength is None or not self.rays_suffice:
            return 0.0
        spot = max(wave.spot_radius for wave in self._rays[1])
        defocus = self.pupil_radius * abs(1 - self.distance * (1 / self.focal_length - 1 / self.depth))
        return spot * 2 * self._rays[1][0].half_width / self.wavelength if spot > MOST_ABERRATED * defocus else 0.0

    @cached_property
    def nodes(self) -> tuple[FloatArray, list[Wavefront]]:
        """Heights of the nodes and their waves; a single node serves a field over which nothing changes."""
        if self.rays_suffice:
            return self._rays
        last = float(self._rays[0][-1])
        known = {height: self.lit_wave(height) for height in (0.0, last)}

        def interval(low: float, high: float) -> tuple[float, float, float]:
            """Return the error of interpolation in the middle of an interval, and its ends."""
            middle = (low + high) / 2
            known[middle] = self.lit_wave(middle)
            ends = [point_spread(known[height], self.grid).values for height in (low, middle, high)]
            return float(np.abs(ends[1] - (ends[0] + ends[2]) / 2).sum()), low, high

        heights, intervals = [0.0, last], [interval(0.0, last)]
        while len(heights) < MOST_NODES and max(intervals)[0] > TOLERANCE:
            worst = max(intervals)
            middle = (worst[1] + worst[2]) / 2
            intervals.remove(worst)
            heights.append(middle)
            intervals += [interval(worst[1], middle), interval(middle, worst[2])]
        heights.sort()
        return np.array(heights), [known[height] for height in heights]

    def lit_wave(self, height: float, half: float | None = None) -> Wavefront:
        """Return the wave of a sensor point that gets light, at nodes that serve a grid, by default `grid`."""
        return _lit(self.wave(height, self.wavelength, self.grid[1] if half is None else half), height)

    def outline(self, height: float) -> Wavefront:
        """Return the rays alone of a sensor point that gets light, whose grid is that of its wave."""
        return replace(_lit(self.wave(height, None), height), wavelength=self.wavelength)

    @cached_property
    def grid(self) -> tuple[float, float]:
        """The grid of all point-spread functions of this lens: for all waves but those of slivers of the pupil."""
        grids = [grid_of(replace(rays, wavelength=self.wavelength)) for rays in self._rays[1]]
        cell, widest = min(cell for cell, _ in grids), min(half for _, half in grids) * MOST_WIDER
        return cell, min(max(half for _, half in grids), widest)

    def between(self, height: float) -> list[tuple[Wavefront, float]]:
        """Return the waves of the nodes beside a height, and their weights: its wave, interpolated."""
        heights, waves = self.nodes
        if heights.size == 1 or height >= heights[-1]:
            return [(waves[-1], 1.0)]
        after = int(np.searchsorted(heights, height, side="right"))
        share = float((height - heights[after - 1]) / (heights[after] - heights[after - 1]))
        return [(waves[after - 1], 1 - share), (waves[after], share)]


@dataclass(frozen=True, eq=False)
class SurfaceOptics(Optics):
    """A lens of surfaces; disk : through which rays leave towards the sensor."""

    prescription: Prescription
    disk: Disk

    def wave(self, height: float, wavelength: float | None, half: float = 0.0) -> Wavefront | None:
        """Trace the wave through the surfaces; see `Optics.wave`."""
        return wavefront_of(self.prescription, self.disk, self.depth, height, self.distance, wavelength, half)

    def lit_share(self, height: FloatArray) -> FloatArray:
        """Return the mean weight of rays that leave evenly spread over the exit disk, as `trace` gives it."""
        return self.weight(height) / (pi * (self.disk.radius / (self.depth + self.disk.height)) ** 2)


@dataclass(frozen=True, eq=False)
class ThinOptics(Optics):
    """A thin lens; aperture : its diameter;  focus : distance of the target that would be sharp."""

    aperture: float
    focus: float
    most_rings: ClassVar[float] = MOST_THIN_RINGS

    def wave(self, height: float, wavelength: float | None, half: float = 0.0) -> Wavefront | None:
        """Compute the wave, whose phase is quadratic; see `Optics.wave`."""
        return thin_wavefront(self.aperture, self.depth, height, self.distance, self.focus, wavelength, half)

    def rays(self, height: float, finest: float) -> Wavefront:
        """Return the rays of a sensor point; see `Optics.rays`."""
        return thin_wavefront(self.aperture, self.depth, height, self.distance, self.focus, None, finest=finest)


def _lit(wave: Wavefront | None, height: float) -> Wavefront:
    if wave is None:
        raise ValueError(f"no light at a height of {height:g} mm, expected a lit one")
    return wave


def sampling_tables(field: Optics, vergences: FloatArray, cells: int, reach: float) -> tuple[FloatArray, float, float]:
    """Return the densities of the slopes by which diffraction and aberrations turn rays from the mean one.

    (h, v, n, n) by heights of `field.nodes` and vergences of the target, 1 / distance, which rise, with rows along the
    direction of the sensor point; the width of the slopes of all n points; and the share of the light within it.
    Offsets drawn from densities that are linear between the points are a convolution with a tent of two cells. It damps
    a frequency f along an axis by sinc(f cell)^2, which is divided out here, as the frequencies are limited.
    cells : of the grid per wavelength times f-number;  reach : of the grid beyond the spot, in the same unit
    """
    heights, vergences = field.nodes[0], np.where(np.abs(vergences) < LEAST_VERGENCE, LEAST_VERGENCE, vergences)
    cases = [(replace(field, distance=1 / v), float(height), abs(v)) for height in heights for v in vergences]
    slopes = [(each.resolution * v, each.spot_radius * v) for each, v in ((at.outline(h), v) for at, h, v in cases)]
    cell = min(fine for fine, _ in slopes) / cells
    half = max(spot + reach * fine for fine, spot in slopes)
    tables: list[FloatArray] = []
    captured: list[float] = []
    for at, height, v in cases:
        spread = point_spread(at.lit_wave(height, half / v), (cell / v, half / v))
        values = spread.values if at.distance > 0 else spread.values[::-1, ::-1]
        damping = np.maximum(np.sinc(np.fft.fftfreq(len(values))) ** 2, np.sinc(1 / cells) ** 2)
        sharpened = np.fft.ifft2(np.fft.fft2(values) / np.outer(damping, damping)).real
        tables.append(np.maximum(sharpened, 0.0) / spread.inside)
        captured.append(spread.inside)
    shape = (heights.size, vergences.size, *tables[0].shape)
    densities = np.stack(tables).reshape(shape).astype(np.float64)
    return densities, cell * (shape[-1] - 1), float(np.mean(captured))


def check_waves(lens_type: LensType, field: Optics) -> None:
    """Raise InputError for aberrations of so many waves that the light can be computed neither as waves nor as rays."""
    if field.aberrated_rays:
        raise InputError(
            f"camera.lens.{lens_type.name}.surfaces: expected a spot of at most {MOST_RINGS:g} times the finest detail"
            f" of the light, got aberrations that spread it over {field.aberrated_rays:.3g}; reduce semi_diameter, or"
            " take camera.wavelength = 'none' for rays, whose image is sharper than that of such a lens"
        )


def bands(camera: Camera) -> tuple[tuple[float | None, float], ...]:
    """Return the wavelengths of the light and their weights; a single None for rays alone."""
    return camera.wavelengths or ((None, 1.0),)


def light_reach(camera: Camera, lens_type: LensType) -> float:
    """Return how far light reaches beyond a pixel's footprint, in pixels of f.

    Raises InputError for more than can be computed, and as `optics_of` does.
    """
    far = max(optics_of(camera, lens_type, wavelength).reach for wavelength, _ in bands(camera)) / camera.target_pitch
    far += DEVIATIONS * camera.diffusion(lens_type)
    if far > MOST_REACH:
        raise InputError(
            f"camera.lens.{lens_type.name}: its blur reaches {far:.3g} pixels of f, expected at most {MOST_REACH};"
            " change its aperture or its focus"
        )
    return far


@lru_cache(maxsize=32)
def optics_of(camera: Camera, lens_type: LensType, wavelength: float | None) -> Optics:
    """Return a lens type of the camera at a wavelength.

    Raises InputError for a cone of light that no lens in air forms, and as `surface_optics` does.
    """
    if lens_type.optics.surfaces is not None:
        return surface_optics(camera, lens_type, wavelength)
    depth, (far, _, _), aperture = camera.depth(lens_type), reach(camera, lens_type), lens_type.optics.aperture
    if aperture is None:
        aperture, wavelength = PINHOLE * depth, None
    elif depth / aperture < FASTEST:
        raise InputError(
            f"camera.lens.{lens_type.name}.aperture: expected a cone of light of f/{FASTEST:g} at the sensor or"
            f" narrower, the limit of lenses in air, got f/{depth / aperture:.2g}; make the aperture smaller"
        )
    return ThinOptics(
        depth=depth,
        distance=camera.distance_of(lens_type),
        field=far,
        wavelength=wavelength,
        focal_length=1 / (1 / depth + 1 / camera.focus(lens_type)),
        entrance_pupil=(aperture, 0.0),
        working_f_number=depth / aperture,
        aperture=aperture,
        focus=camera.focus(lens_type),
    )


def surface_optics(camera: Camera, lens_type: LensType, wavelength: float | None) -> SurfaceOptics:
    """Return a lens type of surfaces at a wavelength.

    The lens is scaled and placed as at the camera's wavelength; another one changes the glass alone, so that principal
    planes move and the distances from them with them. Raises InputError if the surfaces form no image.
    """
    (far, _, _), depth, distance = reach(camera, lens_type), camera.depth(lens_type), camera.distance_of(lens_type)
    lens = prescription_of(camera, lens_type)
    if wavelength is not None and wavelength != camera.wavelength and lens_type.optics.surfaces is not None:
        other = replace(lens, index=prescribe(lens_type.optics.surfaces, wavelength).index)
        depth += lens.rear_principal - other.rear_principal
        distance += other.front_principal - lens.front_principal
        lens = other
    pupil = lens.entrance_pupil
    return SurfaceOptics(
        depth=depth,
        distance=distance,
        field=far,
        wavelength=wavelength,
        focal_length=lens.focal_length,
        entrance_pupil=(2 * pupil.radius, lens.front_principal - pupil.position),
        working_f_number=lens.working_f_number(depth),
        prescription=lens,
        disk=exit_disk(lens, depth, far),
    )


def prescription_of(camera: Camera, lens_type: LensType) -> Prescription:
    """Return the surfaces of a lens type at the camera's wavelength, scaled as the scene asks.

    With scale "fit", or none, the focal length is `camera.focal_length`. The front principal plane is the plane of the
    lenses; the sensor is `camera.depth` behind the rear one, so that the magnification is the type's. Raises InputError
    if the lens type has no surfaces or these cannot form an image there.
    """
    key = f"camera.lens.{lens_type.name}.surfaces"
    if lens_type.optics.surfaces is None:
        raise InputError(f"{key}: expected a list of surfaces or a lens file, got none")
    try:
        lens = prescribe(lens_type.optics.surfaces, camera.wavelength)
        focal_length = lens.focal_length
    except InputError as error:
        raise InputError(f"{key}: {error}") from error
    if focal_length < 0:
        raise InputError(
            f"{key}: expected a converging lens, got a focal length of {focal_length:.4g} mm; check the signs of the"
            " radii: positive if the centre lies towards the sensor"
        )
    scale = lens_type.optics.scale
    scaled = lens.scaled(scale if isinstance(scale, float | int) else camera.focal_length(lens_type) / focal_length)
    edge = scaled.vertices[-1] + scaled.last_extent()[1]
    room = scaled.rear_principal + camera.depth(lens_type) - edge
    if room <= 0:
        raise InputError(
            f"{key}: the sensor would lie {-room:.4g} mm inside the lens, {camera.depth(lens_type):.4g} mm behind its"
            " rear principal plane; turn the lens round, make it thinner or scale it"
        )
    _check_width(camera, lens_type, scaled)
    return scaled


def _check_width(camera: Camera, lens_type: LensType, scaled: Prescription) -> None:
    """Raise InputError if lenses would reach into their neighbours."""
    widest, room = 2 * float(scaled.semi_diameter.max()), camera.lens_pitch
    if widest > room * (1 + 1e-9) and len(camera.sub_imagers) > 1:
        raise InputError(
            f"camera.lens.{lens_type.name}.surfaces: expected openings of at most camera.lens_pitch, {room:.4g} mm, got"
            f" a diameter of {widest:.4g} mm after scaling; reduce semi_diameter or widen the pitch"
        )


def reach(camera: Camera, lens_type: LensType) -> tuple[float, float, float]:
    """Return the largest distance of a lens type's sensor points from the axis, and their least and largest depth."""
    half = np.array(lens_type.pixels[::-1]) / 2 * camera.pixel_pitch
    corners = (half * [[1, 1], [1, -1], [-1, 1], [-1, -1]]).T
    pairs = zip(camera.sub_imagers, poses(camera), strict=True)
    points = np.array([pose.middle[:, None] + pose.axes @ corners for sub, pose in pairs if sub.type == lens_type])
    far = np.hypot(points[:, 0], points[:, 1]).max()
    return float(far), float(-points[:, 2].max()), float(-points[:, 2].min())


def vergence_shifts(camera: Camera, lens_type: LensType) -> tuple[float, float]:
    """Return the least and largest change of a target's vergence that the depths of a type's sensor points make."""
    (_, least, largest), depth = reach(camera, lens_type), camera.depth(lens_type)
    return 1 / largest - 1 / depth, 1 / least - 1 / depth


def exit_disk_of(camera: Camera, lens_type: LensType, prescription: Prescription) -> Disk:
    """Return the exit disk for every sensor point of a lens type."""
    field, least, largest = reach(camera, lens_type)
    return exit_disk(prescription, sorted({least, largest}), field)
