"""Rays of all sensor pixels on Mitsuba's fast backends, with a given number per pixel, all started together.

The samples of one pixel are adjacent lanes, so that a pixel's sum is the sum of a block, in float64 and the same on any
number of threads. Positions of pixels are computed for one block at a time, so that memory does not grow with the film.
A random number is drawn for an effect only if the lenses have it: two for the position in the pixel,
two more for an aperture and for the blur of pixels, one more for several wavelengths, and without walls one for the
lens. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import PixelPlaces
from ommatid.scenes.tables.estimation import Sampler

from ..sampling.passes import Plan
from ..sampling.samplers import RELATED_DRAWS, fitting
from .draws import Grid, ReseededSampler, SobolDraws
from .lens import Distance, LensModel, ThinLens
from .worlds.placement import MILLIMETRES_AT_ORIGIN, Placement

MOST_RAYS = 2**24  # that start together: some hundred bytes each


@dataclass(frozen=True)
class Rays:
    """`samples` rays per pixel: Mitsuba's, and the light that each carries; None if all carry the same."""

    ray: Any
    weight: Any | None
    samples: int

    def sums(self, *values: Any) -> tuple[FloatArray, ...]:
        """Return the sums of values per ray over each pixel, (pixels,) each, computed together."""
        import drjit as dr
        import mitsuba as mi

        lanes = [mi.Float64(value) for value in values]
        dr.eval(lanes)
        return tuple(np.array(dr.block_sum(lane, self.samples)) for lane in lanes)


class RayGenerator:
    """Generates the rays of all sub-imagers of some lens types: one type, or several that are all pinholes."""

    def __init__(self, camera: Camera, types: tuple[LensType, ...], sampler: Sampler, has_world: bool = False) -> None:
        """Load the tables of the pixels into the renderer; a fast variant has to be active.

        has_world : True if the sampler is also used for what the rays meet
        """
        import mitsuba as mi

        self._sampler_name: Sampler = sampler
        self._has_world = has_world
        self.sampler: Any = mi.load_dict({"type": sampler, "sample_count": fitting(sampler, 16)})
        self.lens = lens_of(camera, types[0])
        self._places = PixelPlaces(camera, types)
        self.pixels = self._places.count
        self._placement = MILLIMETRES_AT_ORIGIN
        self._loaded: tuple[slice, list[Any], Any] | None = None  # of the last block of all pixels
        self._pitch = float(camera.pixel_pitch)
        # The same for all of these types:
        self._open, self._height = [float(part) for part in types[0].open], camera.height(types[0])
        self._blur = types[0].optics.pixel_blur
        self._crossing = None
        if not camera.walls:
            from .crosstalk import Crosstalk

            models = {lens_type.name: lens_of(camera, lens_type) for lens_type in camera.types}
            self._crossing = Crosstalk(camera, models)

    def follow(self, distance: Distance, placement: Placement) -> None:
        """Tell all lenses how far the surfaces of a world are, and where the camera stands in it."""
        self._placement, height = placement, self._height

        def from_lens(origin: Any, direction: Any) -> Any:
            return distance((*origin[:2], origin[2] - height), direction)

        (self._crossing or self.lens).follow(from_lens)
        self.lens.captured = 1.0 if self._crossing is not None else self.lens.captured

    def blocks(self, samples: int, pixels: int | None = None) -> list[slice]:
        """Divide all pixels, or `pixels` of them, into blocks whose rays start together and fit into memory."""
        size, count = max(1, MOST_RAYS // samples), self.pixels if pixels is None else pixels
        return [slice(first, min(first + size, count)) for first in range(0, count, size)]

    def rays(self, samples: int, seed: int, block: slice, passes: int = 1, subset: IntArray | None = None) -> Rays:
        """Start `samples` rays per pixel of a block and pass, or as many more as fit the sampler.

        The sampler remains ready for what the rays meet. Every pixel and pass has its own stream of every sampler,
        since Mitsuba seeds by the first lane of each wavefront. The passes of one pixel are adjacent.
        subset : pixels that the block selects from; None: all
        """
        samples = fitting(self._sampler_name, samples)
        self.sampler.set_sample_count(samples)
        self.sampler.set_samples_per_wavefront(samples)
        lanes = (block.stop - block.start) * passes * samples
        self.sampler.seed(seed, lanes)
        draws = ReseededSampler(self.sampler, seed, lanes)
        rays = self._started(self._load(block, subset), Plan(passes, samples), self.sampler.next_2d(), draws)
        if draws.has_drawn or (self._has_world and self._sampler_name in RELATED_DRAWS):
            draws.reseeded()
        return rays

    def sobol_rays(self, samples: int, seed: int, block: slice, passes: int, subset: IntArray) -> Rays:
        """Start rays as `rays` does, a power of two per pixel and pass, at Sobol's points of pixel and pupil together.

        Mitsuba's sampler is not ready for what the rays meet.
        """
        draws = SobolDraws(seed, (block.stop - block.start) * passes * samples, samples)
        return self._started(self._load(block, subset), Plan(passes, samples), draws.next_2d(), draws)

    def middle_rays(
        self, samples: int, seed: int, block: slice, passes: int, subset: IntArray
    ) -> tuple[Rays, tuple[Any, Any]]:
        """Start rays as `sobol_rays` does, but from the middles of pixels; return the falloff across their pixels, too.

        falloff : relative change of the weight from one edge of a pixel's open part to the other, down and across
        """
        import drjit as dr
        import mitsuba as mi

        lanes = (block.stop - block.start) * passes * samples
        self.lens.spreads = True
        draws, places = SobolDraws(seed, lanes, samples), self._load(block, subset)
        rays = self._started(places, Plan(passes, samples), mi.Point2f(0.5), draws)
        self.lens.spreads = False
        index = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, passes * samples)
        x, y, z = (dr.gather(mi.Float, row, index) for row in places[0][:3])
        x, y = x + self._pitch / 2, y + self._pitch / 2
        slope = -4 * self._pitch / (x * x + y * y + z * z) if self.lens.has_weights else 0.0  # of cos^4
        return rays, (self._open[0] * slope * y, self._open[1] * slope * x)

    def middles(self, pixels: IntArray) -> Rays:
        """Start the ray from the middle of each of some pixels of the group, of pinholes."""
        import mitsuba as mi

        return self._started(self._load(slice(0, pixels.size), pixels), Plan(1, 1), mi.Point2f(0.5), None)

    def grid_rays(self, grid: Grid, passes: int, keys: IntArray, pixels: IntArray) -> Rays:
        """Start one ray per cell of a grid over each pixel and pass, of pinholes, by random numbers of each pixel.

        The numbers depend on the key of a pixel's sub-imager and pass, and on the pixel's place in the sub-imager.
        keys : (sub-imagers of the camera, passes) of 32 bits;  pixels : of the group. The passes of one are adjacent.
        """
        import drjit as dr
        import mitsuba as mi

        work = Plan(passes, grid.cells**2)
        lane = dr.arange(mi.UInt32, pixels.size * work.total)
        of_pass = lane // dr.opaque(mi.UInt32, work.samples)
        numbers, own = self._places.numbers(pixels)
        key = mi.UInt32(keys[own].astype(np.uint32).ravel())
        number = dr.gather(mi.UInt32, mi.UInt32(numbers.astype(np.uint32)), of_pass // dr.opaque(mi.UInt32, passes))
        at = grid.position(lane, dr.gather(mi.UInt32, key, of_pass), number)
        return self._started(self._load(slice(0, pixels.size), pixels), work, at, None)

    def _load(self, block: slice, subset: IntArray | None) -> tuple[list[Any], Any]:
        """Load the places of the pixels of a block: coordinates and axes, and the number of each pixel's lens."""
        import mitsuba as mi

        if subset is None and self._loaded is not None and self._loaded[0] == block:
            return self._loaded[1:]
        pixels = np.arange(block.start, block.stop) if subset is None else subset[block]
        coordinates = [mi.Float(np.ascontiguousarray(row, dtype=np.float32)) for row in self._places.at(pixels)]
        own = mi.UInt32(self._places.numbers(pixels)[1].astype(np.uint32))
        if subset is None:
            self._loaded = block, coordinates, own
        return coordinates, own

    def _started(self, places: tuple[list[Any], Any], work: Plan, at: Any, draws: Any) -> Rays:
        """Return the rays of some pixels.

        places : of these, as of `_load`
        at : points of the open parts, in [0, 1)^2;  draws : of the other random numbers
        """
        import drjit as dr
        import mitsuba as mi

        coordinates, own = places
        lanes = dr.width(own) * work.total
        index = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, work.total)
        corner_x, corner_y, corner_z, lens_x, lens_y, *axes = (dr.gather(mi.Float, row, index) for row in coordinates)
        down, across = self._open
        at = mi.Point2f((1 - across) / 2 + across * at.x, (1 - down) / 2 + down * at.y) * self._pitch
        if self._blur is not None:
            at += self._blur * mi.warp.square_to_std_normal(draws.next_2d())
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
        from ommatid.scenes.optics.blur import blurs_of

        if any(blur.airy for blur, _ in blurs_of(camera, lens_type)):  # not so far out of focus that light is rays
            from .diffracting_lens import DiffractingLens

            return DiffractingLens(camera, lens_type, aperture)
    return ThinLens(camera, lens_type, aperture)
