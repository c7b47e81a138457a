"""Rays of all sensor pixels on Mitsuba's fast backends, with a given number per pixel, all started together.

The samples of one pixel are adjacent lanes, so that a pixel's sum is the sum of a block, in float64 and the same on any
number of threads. Positions of pixels are computed for one block at a time, so that memory does not grow with the film.
A random number is drawn for an effect only if the lenses have it: two for the position in the pixel,
two more for an aperture and for the blur of pixels, one more for several wavelengths, and without walls one for the
lens. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import PixelPlaces
from ommatid.scenes.tables.estimation import Sampler

from ..sampling.passes import Plan
from ..sampling.samplers import RELATED_DRAWS, fitting
from .draws import GridDraws, ReseededSampler
from .lens import Crosstalk, Distance, LensModel, ThinLens
from .loaded import dr, mi
from .worlds.placement import MILLIMETRES_AT_ORIGIN, Placement

MOST_RAYS = 2**24  # that start together: some hundred bytes each
Seed = Callable[[int], int]  # of a sampler, by the index of a sensor


@dataclass(frozen=True, eq=False)
class Pixels:
    """Sensor pixels of a group of lens types that are rendered together: `block` of all of them, or of `subset`.

    sensor : index of the sensor that seeds their sampler on the fast backends: of the group, or of a sub-imager
    """

    group: str
    block: slice
    subset: IntArray | None = None
    sensor: int = 0

    @property
    def count(self) -> int:
        """Number of pixels."""
        return self.block.stop - self.block.start

    @property
    def numbers(self) -> IntArray:
        """Their numbers in the group, rising: (pixels,)."""
        return np.arange(self.block.start, self.block.stop) if self.subset is None else self.subset[self.block]

    def blocks(self, samples: int) -> list[Pixels]:
        """Divide them into blocks whose rays, `samples` a pixel, start together and fit into memory."""
        size, stop = max(1, MOST_RAYS // samples), self.block.stop
        if self.count <= size:
            return [self]  # whose places are loaded once for all passes
        starts = range(self.block.start, stop, size)
        return [replace(self, block=slice(first, min(first + size, stop))) for first in starts]


@dataclass(frozen=True)
class Rays:
    """`samples` rays per pixel: Mitsuba's, and the light that each carries; None if all carry the same."""

    ray: Any
    weight: Any | None
    samples: int

    def sums(self, *values: Any) -> tuple[FloatArray, ...]:
        """Return the sums of values per ray over each pixel, (pixels,) each, computed together."""
        lanes = [mi.Float64(value) for value in values]
        dr.eval(lanes)
        return tuple(np.array(dr.block_sum(lane, self.samples)) for lane in lanes)


class RayGenerator:
    """Generates the rays of all sub-imagers of some lens types: one type, or several that are all pinholes."""

    def __init__(self, camera: Camera, types: tuple[LensType, ...], sampler: Sampler, has_world: bool = False) -> None:
        """Load the tables of the pixels into the renderer; a fast variant has to be active.

        has_world : True if the sampler is also used for what the rays meet
        """
        self._sampler_name: Sampler = sampler
        self._has_world = has_world
        self.sampler: Any = mi.load_dict({"type": sampler, "sample_count": fitting(sampler, 16)})
        self.lens = lens_of(camera, types[0])
        self._places = PixelPlaces(camera, types)
        self._placement = MILLIMETRES_AT_ORIGIN
        self._loaded: tuple[Pixels, list[Any], Any] | None = None  # of the last pixels
        self._pitch = float(camera.pixel_pitch)
        # The same for all of these types:
        self._open, self._height = [float(part) for part in types[0].open], camera.height(types[0])
        self._blur = types[0].optics.pixel_blur
        self._crossing = None
        if not camera.walls:
            models = {lens_type.name: lens_of(camera, lens_type) for lens_type in camera.types}
            self._crossing = Crosstalk(camera, models)

    def follow(self, distance: Distance, placement: Placement) -> None:
        """Tell all lenses how far the surfaces of a world are, and where the camera stands in it."""
        self._placement, height = placement, self._height

        def from_lens(origin: Any, direction: Any) -> Any:
            return distance((*origin[:2], origin[2] - height), direction)

        (self._crossing or self.lens).follow(from_lens)
        self.lens.captured = 1.0 if self._crossing is not None else self.lens.captured

    def sampled(self, pixels: Pixels, work: Plan, seed: int) -> Rays:
        """Start rays at the points of Mitsuba's sampler, whose number in a pass has to fit it.

        The sampler remains ready for what the rays meet. Every pixel and pass has its own stream of every sampler,
        since Mitsuba seeds by the first lane of each wavefront.
        """
        self.sampler.set_sample_count(work.samples)
        self.sampler.set_samples_per_wavefront(work.samples)
        lanes = pixels.count * work.total
        self.sampler.seed(seed, lanes)
        draws = ReseededSampler(self.sampler, seed, lanes)
        rays = self.rays(pixels, work, draws)
        if draws.has_drawn or (self._has_world and self._sampler_name in RELATED_DRAWS):
            draws.reseeded()
        return rays

    def grid(self, pixels: Pixels, cells: int, margin: float, seeds: Sequence[Seed]) -> GridDraws:
        """Return points in the cells of a grid over each pixel and pass; seeds : of the passes, by sub-imager."""
        numbers, own = self._places.numbers(pixels.numbers)
        keys = np.array([[seed(index) for seed in seeds] for index in range(int(own.max()) + 1)], dtype=np.int64)
        return GridDraws(cells, margin, keys[own], numbers)

    def falloff(self, pixels: Pixels, work: Plan) -> tuple[Any, Any]:
        """Return the relative change of each ray's weight across its pixel's open part, down and across."""
        index = dr.arange(mi.UInt32, pixels.count * work.total) // dr.opaque(mi.UInt32, work.total)
        x, y, z = (dr.gather(mi.Float, row, index) for row in self._load(pixels)[0][:3])
        x, y = x + self._pitch / 2, y + self._pitch / 2
        slope = -4 * self._pitch / (x * x + y * y + z * z) if self.lens.has_weights else 0.0  # of cos^4
        return self._open[0] * slope * y, self._open[1] * slope * x

    def _load(self, pixels: Pixels) -> tuple[list[Any], Any]:
        """Load the places of pixels: coordinates and axes, and the number of each pixel's lens."""
        if self._loaded is None or self._loaded[0] is not pixels:
            numbers = pixels.numbers
            coordinates = [mi.Float(np.ascontiguousarray(row, dtype=np.float32)) for row in self._places.at(numbers)]
            self._loaded = pixels, coordinates, mi.UInt32(self._places.numbers(numbers)[1].astype(np.uint32))
        return self._loaded[1:]

    def rays(self, pixels: Pixels, work: Plan, draws: Any) -> Rays:
        """Start the rays of some pixels; the passes of one pixel, and the samples of one pass, are adjacent."""
        coordinates, own = self._load(pixels)
        lanes = pixels.count * work.total
        index = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, work.total)
        corner_x, corner_y, corner_z, lens_x, lens_y, *axes = (dr.gather(mi.Float, row, index) for row in coordinates)
        (down, across), at = self._open, draws.position()
        at = mi.Point2f((1 - across) / 2 + across * at.x, (1 - down) / 2 + down * at.y) * self._pitch
        if self._blur is not None:
            at += self._blur * mi.warp.square_to_std_normal(draws.next_2d())
        self.lens.spreads = draws.spreads
        if axes:
            x = corner_x + axes[0] * at.x + axes[1] * at.y
            y = corner_y + axes[2] * at.x + axes[3] * at.y
            z = corner_z + axes[4] * at.x + axes[5] * at.y
        else:
            x, y, z = corner_x + at.x, corner_y + at.y, corner_z
        if self._crossing is None:
            start, direction, weight = self.lens.emit(x, y, -z, draws, (lens_x, lens_y))
        else:
            start, direction, weight = self._crossing.emit(
                dr.gather(mi.UInt32, own, index), (x, y, -z), draws, (lens_x, lens_y)
            )
        ray = dr.zeros(mi.RayDifferential3f, lanes)
        origin = mi.Point3f(lens_x + start[0], lens_y + start[1], start[2] - self._height)
        ray.o, ray.d = self._placement.carry(origin, dr.normalize(mi.Vector3f(*direction)))
        ray.maxt = dr.largest(mi.Float)
        return Rays(ray, weight, work.samples)


def lens_of(camera: Camera, lens_type: LensType) -> LensModel:
    """Create the lens model of a lens type."""
    if lens_type.optics.surfaces is not None:
        from .real_lens import real_lens

        return real_lens(camera, lens_type)
    aperture = lens_type.optics.aperture
    if aperture is None:
        return LensModel(camera, lens_type)
    if camera.wavelengths:
        from ommatid.scenes.optics.field import optics_of

        if not all(optics_of(camera, lens_type, wavelength).rays_suffice for wavelength, _ in camera.wavelengths):
            from .diffracting_lens import DiffractingLens

            return DiffractingLens(camera, lens_type, aperture)
    return ThinLens(camera, lens_type, aperture)
