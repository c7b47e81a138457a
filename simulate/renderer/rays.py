"""Rays of all sensor pixels on Mitsuba's fast backends, with a given number per pixel, all started together.

The samples of one pixel are adjacent lanes, so that a pixel's sum is the sum of a block, in float64 and the same on any
number of threads. A random number is drawn for an effect only if the lenses have it: two for the position in the pixel,
two more for an aperture, one more for several wavelengths, and without walls one for the lens. Lengths are
millimetres.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import corner_offset, poses
from ommatid.scenes.scene import Sampler

from ..sampling.samplers import RELATED_DRAWS, fitting
from .lens import Distance, LensModel, ThinLens
from .reseeded_sampler import ReseededSampler

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
        import drjit as dr
        import mitsuba as mi

        self._sampler_name: Sampler = sampler
        self._has_world = has_world
        self.sampler: Any = mi.load_dict({"type": sampler, "sample_count": fitting(sampler, 16)})
        self.pixels = sum(lens_type.measurements for lens_type in types)
        self.lens = lens_of(camera, types[0])
        self._tables = [mi.Float(np.ascontiguousarray(row, dtype=np.float32)) for row in _tables(camera, types)]
        dr.make_opaque(self._tables)
        self._pitch = float(camera.pixel_pitch)
        self._crossing, self._own = None, None
        if not camera.walls:
            from .crosstalk import Crosstalk

            models = {lens_type.name: lens_of(camera, lens_type) for lens_type in camera.types}
            self._crossing = Crosstalk(camera, models)
            self._own = mi.UInt32(own_lenses(camera, types).astype(np.uint32))
            self.lens.tail = self._crossing.tail

    def follow(self, distance: Distance) -> None:
        """Tell all lenses how far the surfaces of a world are."""
        (self._crossing or self.lens).follow(distance)
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
        import drjit as dr
        import mitsuba as mi

        samples = fitting(self._sampler_name, samples)
        self.sampler.set_sample_count(samples)
        self.sampler.set_samples_per_wavefront(samples)
        lanes = (block.stop - block.start) * passes * samples
        self.sampler.seed(seed, lanes)
        each = dr.opaque(mi.UInt32, passes * samples)
        index = dr.arange(mi.UInt32, lanes) // each + dr.opaque(mi.UInt32, block.start)
        if subset is not None:
            index = dr.gather(mi.UInt32, mi.UInt32(subset.astype(np.uint32)), index)
        corner_x, corner_y, corner_z, lens_x, lens_y, *axes = (dr.gather(mi.Float, row, index) for row in self._tables)
        at = self.sampler.next_2d() * self._pitch
        if axes:
            x = corner_x + axes[0] * at.x + axes[1] * at.y
            y = corner_y + axes[2] * at.x + axes[3] * at.y
            z = corner_z + axes[4] * at.x + axes[5] * at.y
        else:
            x, y, z = corner_x + at.x, corner_y + at.y, corner_z
        draws = ReseededSampler(self.sampler, seed, lanes)
        if self._crossing is None:
            start, direction, weight = self.lens.emit(x, y, -z, draws, (lens_x, lens_y))
        else:
            own = dr.gather(mi.UInt32, self._own, index)
            start, direction, weight = self._crossing.emit(own, (x, y, -z), draws, (lens_x, lens_y))
        if draws.has_drawn or (self._has_world and self._sampler_name in RELATED_DRAWS):
            draws.reseeded()
        ray = dr.zeros(mi.RayDifferential3f, lanes)
        ray.o = mi.Point3f(lens_x + start[0], lens_y + start[1], start[2])
        ray.d = dr.normalize(mi.Vector3f(*direction))
        ray.maxt = dr.largest(mi.Float)
        return Rays(ray, weight, samples)


def _tables(camera: Camera, types: tuple[LensType, ...]) -> list[FloatArray]:
    """Return rows of (pixels,): x, y, z of each pixel's corner from its lens, x and y of the lens, and the axes of the
    patch where patches are tilted or rotated."""
    turned = camera.tolerance is not None or any(lens_type.is_rotated for lens_type in camera.types)
    parts: list[FloatArray] = []
    for sub, pose in zip(camera.sub_imagers, poses(camera), strict=True):
        if sub.type not in types:
            continue
        row, column = (index.ravel() for index in np.indices(sub.type.pixels))
        u, v = corner_offset(camera, sub)
        corner = np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        constant = [*pose.lens, *(pose.axes.ravel() if turned else ())]
        constants = np.repeat(np.array(constant)[:, None], row.size, axis=1)
        parts.append(np.concatenate([pose.middle[:, None] + pose.axes @ corner, constants]))
    return list(np.concatenate(parts, axis=1))


def own_lenses(camera: Camera, types: tuple[LensType, ...]) -> IntArray:
    """Return the number of each pixel's sub-imager in the camera, (pixels,)."""
    numbers = [np.full(rows.stop - rows.start, number) for number, rows in enumerate(camera.slices())]
    chosen = zip(camera.sub_imagers, numbers, strict=True)
    return np.concatenate([number for sub, number in chosen if sub.type in types])


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
