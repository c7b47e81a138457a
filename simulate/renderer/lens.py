"""From a point of the sensor through its lens into the world, on Mitsuba's fast backends.

A lens type has one `Lens`, composed of what it is: a pinhole, a thin lens with its distortion and diffraction, or the
surfaces of a real one. What it is not costs nothing.
"""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import poses

from ..lenses import thin_lens


class LensModel:
    """A pinhole, perhaps with distortion."""

    weighs = False  # whether rays stand for different amounts of light
    tail = 0.0  # pixels of f by which rare rays land beside the others

    def __init__(self, camera: Camera, kind: LensType) -> None:
        """Of a lens type."""
        self._distortion = kind.optics.distortion
        self._corner = camera.distance / camera.half_diagonal
        if self._distortion is not None:
            from ommatid.scenes.optics.distortion import field

            seen = zip(camera.sub_imagers, poses(camera), strict=True)
            self._limit = max(field(camera, sub, pose) for sub, pose in seen if sub.type == kind)

    def leave(self, x: Any, y: Any, depth: Any, sampler: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]:
        """Origin and direction (not normalised), from the lens's centre, of rays from (x, y, -depth), and weights."""
        del sampler
        return (0, 0, 0), (*self.chief(x, y, depth), 1), None

    def chief(self, x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
        """Slopes of the ray through the lens's centre, behind it."""
        slopes = thin_lens.through_centre(x, y, depth)
        if self._distortion is None:
            return slopes
        from ommatid.scenes.optics.distortion import undistort

        return undistort(*slopes, *self._distortion, self._corner, self._limit)


class ThinLens(LensModel):
    """A thin lens with an aperture, in focus or not, that diffracts where the light has a wavelength."""

    weighs = True

    def __init__(self, camera: Camera, kind: LensType, aperture: float) -> None:
        """Of a lens type with an aperture of this diameter."""
        super().__init__(camera, kind)
        import drjit as dr
        import mitsuba as mi

        self._radius = dr.opaque(mi.Float, aperture / 2)
        self._focal = dr.opaque(mi.Float, camera.focal_length(kind))
        self._radii = None
        if camera.wavelength is not None:
            from ommatid.scenes.optics.blur import blur_of

            blur = blur_of(camera, kind)
            self.tail = blur.reach
            self._radii = mi.Float((blur.radii * camera.target_pitch / camera.distance).astype(np.float32))

    def leave(self, x: Any, y: Any, depth: Any, sampler: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]:
        """Origin and direction (not normalised), from the lens's centre, of rays from (x, y, -depth), and weights."""
        import mitsuba as mi

        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * self._radius
        weight = thin_lens.falloff(x, y, on_disk.x, on_disk.y, depth)
        slopes = self.chief(x, y, depth)
        if self._radii is not None:
            away = displaced(self._radii, sampler.next_2d())
            slopes = slopes[0] + away[0], slopes[1] + away[1]
        way = [
            thin_lens.through_thin_lens(slope, place, depth, self._focal)
            for slope, place in zip(slopes, (on_disk.x, on_disk.y), strict=True)
        ]
        return (on_disk.x, on_disk.y, 0), (*way, 1), weight


def displaced(radii: Any, sample: Any) -> tuple[Any, Any]:
    """Slopes by which a ray is displaced: the radius from a table by the square root of its share, any direction."""
    import drjit as dr
    import mitsuba as mi

    last = dr.width(radii) - 1
    place = dr.sqrt(sample.x) * last
    lower = dr.minimum(mi.UInt32(place), last - 1)
    share = place - mi.Float(lower)
    radius = dr.lerp(dr.gather(mi.Float, radii, lower), dr.gather(mi.Float, radii, lower + 1), share)
    sine, cosine = dr.sincos(2 * dr.pi * sample.y)
    return radius * cosine, radius * sine
