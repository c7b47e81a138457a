"""Rays from the sensor through a pinhole or a thin lens into the world, on Mitsuba's fast backends.

A lens type has one `LensModel`, composed of its properties: a pinhole, a thin lens with its distortion and diffraction,
or (`real_lens`) the surfaces of a real one. Absent effects cost nothing.
"""

# pyright: basic
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import poses

from ..lenses import thin_lens

if TYPE_CHECKING:
    from ommatid.scenes.optics.blur import Blur

Emission = tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]


class LensModel:
    """A pinhole, with or without distortion."""

    has_weights = False  # True if rays carry different amounts of light
    tail = 0.0  # pixels of f by which rare rays land outside the footprint of the others

    def __init__(self, camera: Camera, lens_type: LensType) -> None:
        """Create the model of a lens type."""
        self._distortion = lens_type.optics.distortion
        self._corner = camera.distance / camera.half_diagonal
        if self._distortion is not None:
            from ommatid.scenes.optics.distortion import field

            pairs = zip(camera.sub_imagers, poses(camera), strict=True)
            self._limit = max(field(camera, sub, pose) for sub, pose in pairs if sub.type == lens_type)

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights.

        Directions are not normalised; the weights are None if all rays carry the same light.
        """
        del sampler
        return (0, 0, 0), (*self.chief(x, y, depth), 1), None

    def chief(self, x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
        """Return the slopes, behind the lens, of the ray through its centre."""
        slopes = thin_lens.through_centre(x, y, depth)
        if self._distortion is None:
            return slopes
        from ommatid.scenes.optics.distortion import undistort

        return undistort(*slopes, *self._distortion, self._corner, self._limit)


class ThinLens(LensModel):
    """A thin lens with an aperture, in focus or not, that diffracts if the light has a wavelength."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType, aperture: float) -> None:
        """Create the model of a lens type with an aperture of this diameter."""
        super().__init__(camera, lens_type)
        import drjit as dr
        import mitsuba as mi

        self._radius = dr.opaque(mi.Float, aperture / 2)
        self._focal = dr.opaque(mi.Float, camera.focal_length(lens_type))
        self._radii = None
        if camera.wavelength is not None:
            from ommatid.scenes.optics.blur import blur_of

            blur = blur_of(camera, lens_type)
            self.tail, self._radii = blur.reach, slope_table(blur, camera)

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        import mitsuba as mi

        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * self._radius
        weight = thin_lens.falloff(x, y, on_disk.x, on_disk.y, depth)
        slopes = self.chief(x, y, depth)
        if self._radii is not None:
            shift = sample_displacement(self._radii, sampler.next_2d())
            slopes = slopes[0] + shift[0], slopes[1] + shift[1]
        direction = [
            thin_lens.through_thin_lens(slope, position, depth, self._focal)
            for slope, position in zip(slopes, (on_disk.x, on_disk.y), strict=True)
        ]
        return (on_disk.x, on_disk.y, 0), (*direction, 1), weight


def slope_table(blur: Blur, camera: Camera) -> Any:
    """Return the radii of a blur as slopes of rays, in a table for `sample_displacement`."""
    import mitsuba as mi

    return mi.Float((blur.radii * camera.target_pitch / camera.distance).astype(np.float32))


def sample_displacement(radii: Any, sample: Any) -> tuple[Any, Any]:
    """Draw the slopes that diffraction adds to a ray: a radius from the table, at any angle."""
    import drjit as dr
    import mitsuba as mi

    last = dr.width(radii) - 1
    position = dr.sqrt(sample.x) * last
    lower = dr.minimum(mi.UInt32(position), last - 1)
    share = position - mi.Float(lower)
    radius = dr.lerp(dr.gather(mi.Float, radii, lower), dr.gather(mi.Float, radii, lower + 1), share)
    sine, cosine = dr.sincos(2 * dr.pi * sample.y)
    return radius * cosine, radius * sine
