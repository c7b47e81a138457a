"""The rays of a compound eye on Mitsuba's fast backends: as many as asked for of every sensor pixel, all at once.

Lane after lane the samples of one pixel stand side by side, so that a pixel's sum is the sum of a block, in float64 and
the same on any number of threads. A random number is drawn for an effect only where the lenses have it: two for the
place in the pixel, two more for an aperture, two more for diffraction. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import corner_offset, poses
from ommatid.scenes.scene import Sampler

from ..sampling.samplers import fitting
from .lens import LensModel, ThinLens

MOST_RAYS = 2**24  # that start together: some hundred bytes each


@dataclass(frozen=True)
class Rays:
    """`samples` rays a pixel: Mitsuba's, and how much light each stands for; None where all stand for the same."""

    ray: Any
    weight: Any | None
    samples: int

    def sums(self, *values: Any) -> tuple[NDArray[np.float64], ...]:
        """Of each pixel's lanes, (pixels,) for each of what is given; all are computed in one go."""
        import drjit as dr
        import mitsuba as mi

        found = [mi.Float64(one) for one in values]
        dr.eval(found)
        return tuple(np.array(dr.block_sum(one, self.samples)) for one in found)


class RayGenerator:
    """All sub-imagers of some lens types: one type, or several that are all pinholes."""

    def __init__(self, camera: Camera, types: tuple[LensType, ...], sampler: Sampler) -> None:
        """Put the tables of its pixels where the renderer finds them; a variant of the fast kind has to be active."""
        import drjit as dr
        import mitsuba as mi

        self._spread: Sampler = sampler
        self.sampler: Any = mi.load_dict({"type": sampler, "sample_count": fitting(sampler, 16)})
        self.pixels = sum(kind.measurements for kind in types)
        self.lens = lens_of(camera, types[0])
        rows = _tables(camera, types)
        self._tables = [mi.Float(np.ascontiguousarray(row, dtype=np.float32)) for row in rows]
        dr.make_opaque(self._tables)
        self._pitch = float(camera.pixel_pitch)

    @property
    def even(self) -> bool:
        """Whether every ray stands for the same light."""
        return not self.lens.weighs

    def blocks(self, samples: int, pixels: int | None = None) -> list[slice]:
        """Its pixels, or so many of them, in their order, in blocks whose rays start together and fit into memory."""
        several, count = max(1, MOST_RAYS // samples), self.pixels if pixels is None else pixels
        return [slice(first, min(first + several, count)) for first in range(0, count, several)]

    def rays(
        self, samples: int, seed: int, block: slice, passes: int = 1, which: NDArray[np.int64] | None = None
    ) -> Rays:
        """`samples` rays of each pixel of a block in each pass, or as many more as fit the sampler, which stays ready
        for what they meet. Every pixel has its own stream of every sampler, as every pass of it has: Mitsuba seeds by
        the first lane of each wavefront.

        Several passes start together, those of one pixel side by side.
        which : pixels among which the block is one; absent: all
        """
        import drjit as dr
        import mitsuba as mi

        samples = fitting(self._spread, samples)
        self.sampler.set_sample_count(samples)
        self.sampler.set_samples_per_wavefront(samples)
        lanes = (block.stop - block.start) * passes * samples
        self.sampler.seed(seed, lanes)
        each = dr.opaque(mi.UInt32, passes * samples)
        index = dr.arange(mi.UInt32, lanes) // each + dr.opaque(mi.UInt32, block.start)
        if which is not None:
            index = dr.gather(mi.UInt32, mi.UInt32(which.astype(np.uint32)), index)
        corner_x, corner_y, corner_z, lens_x, lens_y, *axes = (dr.gather(mi.Float, row, index) for row in self._tables)
        at = self.sampler.next_2d() * self._pitch
        if axes:
            x = corner_x + axes[0] * at.x + axes[1] * at.y
            y = corner_y + axes[2] * at.x + axes[3] * at.y
            z = corner_z + axes[4] * at.x + axes[5] * at.y
        else:
            x, y, z = corner_x + at.x, corner_y + at.y, corner_z
        start, way, weight = self.lens.leave(x, y, -z, self.sampler)
        ray = dr.zeros(mi.RayDifferential3f, lanes)
        ray.o = mi.Point3f(lens_x + start[0], lens_y + start[1], start[2])
        ray.d = dr.normalize(mi.Vector3f(*way))
        ray.maxt = dr.largest(mi.Float)
        return Rays(ray, weight, samples)


def _tables(camera: Camera, types: tuple[LensType, ...]) -> list[NDArray[np.float64]]:
    """x, y and z of each pixel's corner from its lens, the lens's x and y, and, where sub-imagers are turned, the axes
    of their patches: rows of (pixels,)."""
    found: list[NDArray[np.float64]] = []
    for sub, pose in zip(camera.sub_imagers, poses(camera), strict=True):
        if sub.type not in types:
            continue
        row, column = (place.ravel() for place in np.indices(sub.type.pixels))
        u, v = corner_offset(camera, sub)
        corner = np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        fixed = [*pose.lens, *(pose.axes.ravel() if camera.tolerance is not None else ())]
        fixed_rows = np.repeat(np.array(fixed)[:, None], row.size, axis=1)
        found.append(np.concatenate([pose.middle[:, None] + pose.axes @ corner, fixed_rows]))
    return list(np.concatenate(found, axis=1))


def lens_of(camera: Camera, kind: LensType) -> LensModel:
    """The lens of a lens type as it is described."""
    if kind.optics.surfaces is not None:
        from .real_lens import RealLens

        return RealLens(camera, kind)
    aperture = kind.optics.aperture
    return LensModel(camera, kind) if aperture is None else ThinLens(camera, kind, aperture)
