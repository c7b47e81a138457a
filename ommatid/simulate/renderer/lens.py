"""Rays from the sensor through a pinhole or a thin lens into the world, on Mitsuba's fast backends.

A lens type has one `LensModel`, composed of its properties: a pinhole, a thin lens with its distortion, one that
diffracts (`diffracting_lens`), or the surfaces of a real one (`real_lens`). Absent effects cost nothing.

Without walls between the channels half of a pixel's rays cross its own lens, and the others one that is drawn evenly
from all the others. A ray carries the light of its lens, aperture area times cos^4 at the sensor, over the probability
with which it was drawn.

Lengths are millimetres from the centre of the lens: the sensor at z = -depth, the target at z > 0. The image on the
sensor is upside down, sub-images are upright: pixel (0, 0) of a sub-image looks at the top left of its window and has
the smallest x and y.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import poses

from .loaded import dr, mi

Point = tuple[Any, Any]
Distance = Callable[[Any, Any], Any]  # along z to the first surface that rays meet, by their origins and directions
Emission = tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]
OWN = 0.5  # of a pixel's rays, through its own lens


def through_centre(x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
    """Return the slopes dx/dz and dy/dz of the ray from (x, y, -depth) through the lens's centre."""
    return -x / depth, -y / depth


def through_thin_lens(slope: Any, position: Any, depth: Any, focal_length: Any) -> Any:
    """Return the slope, along one axis, behind a thin lens of a ray that crosses it at `position`.

    `slope` is that of the ray through the lens's centre. All rays of one sensor point meet where that one has gone
    1/(1/focal_length - 1/depth) from the lens (the thin-lens equation).
    """
    return slope + position / depth - position / focal_length


def falloff(x: Any, y: Any, lens_x: Any, lens_y: Any, depth: Any) -> Any:
    """Return cos^4 of the angle, at the sensor, of the ray from (x, y, -depth) to the point (lens_x, lens_y, 0).

    The irradiance that an element of the lens contributes, relative to the axis: cos at the lens, cos at the sensor,
    and cos^2 for the distance.
    """
    square = ((x - lens_x) * (x - lens_x) + (y - lens_y) * (y - lens_y)) / (depth * depth)
    return 1 / ((1 + square) * (1 + square))


def drawn_bands(shares: Sequence[float], sampler: Any) -> list[Any]:
    """Draw the wavelength of each ray by its share of the light: for each, True for rays of it or of a later one."""
    if len(shares) == 1:
        return [True]
    drawn = sampler.next_1d()
    return [True, *(drawn >= limit for limit in accumulate(shares[:-1]))]


class LensModel:
    """A pinhole, with or without distortion."""

    has_weights = False  # True if rays carry different amounts of light
    captured = 1.0  # share of the light that the rays represent
    spreads = False  # True to send more rays to the faint parts of the point spread, with less weight

    def __init__(self, camera: Camera, lens_type: LensType) -> None:
        """Create the model of a lens type."""
        self._distortion = lens_type.optics.distortion
        self._corner = camera.distance_of(lens_type) / camera.half_diagonal
        if self._distortion is not None:
            from ommatid.scenes.optics.distortion import largest_field

            self._limit = largest_field(camera, lens_type)

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights.

        Directions are not normalised; the weights are None if all rays carry the same light.
        lens : (x, y) of the lens in the camera
        """
        del sampler, lens
        return (0, 0, 0), (*self.chief(x, y, depth), 1), None

    def follow(self, distance: Distance) -> None:
        """Tell the lens how far the surfaces of a world are; only light that is waves depends on it."""

    def chief(self, x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
        """Return the slopes, behind the lens, of the ray through its centre."""
        slopes = through_centre(x, y, depth)
        if self._distortion is None:
            return slopes
        from ommatid.scenes.optics.distortion import undistort

        return undistort(*slopes, *self._distortion, self._corner, self._limit)


class ThinLens(LensModel):
    """A thin lens with an aperture, in focus or not, for light that is rays."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType, aperture: float) -> None:
        """Create the model of a lens type with an aperture of this diameter."""
        super().__init__(camera, lens_type)
        self._radius = dr.opaque(mi.Float, aperture / 2)
        self._focal = dr.opaque(mi.Float, camera.focal_length(lens_type))

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        del lens
        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * self._radius
        weight = falloff(x, y, on_disk.x, on_disk.y, depth)
        slopes = self.chief(x, y, depth)
        direction = [
            through_thin_lens(slope, position, depth, self._focal)
            for slope, position in zip(slopes, (on_disk.x, on_disk.y), strict=True)
        ]
        return (on_disk.x, on_disk.y, 0), (*direction, 1), weight


class Crosstalk:
    """The lenses of a camera, of which every ray crosses one."""

    def __init__(self, camera: Camera, models: Mapping[str, LensModel]) -> None:
        """Load the places of all lenses; `models` are those of the lens types, by name."""
        names = list(models)
        self._models = [models[name] for name in names]
        self._others = len(camera.sub_imagers) - 1
        places = np.array([pose.lens for pose in poses(camera)], dtype=np.float32).T
        self._x, self._y = (mi.Float(np.ascontiguousarray(row)) for row in places)
        types = [names.index(sub.type.name) for sub in camera.sub_imagers]
        self._kind = mi.UInt32(np.array(types, dtype=np.uint32))
        areas = np.array([(lens_type.optics.aperture or 0.0) ** 2 for lens_type in camera.types])
        self._area = mi.Float((areas / areas.max()).astype(np.float32))

    def follow(self, distance: Distance) -> None:
        """Tell all lenses how far the surfaces of a world are."""
        for model in self._models:
            model.follow(distance)

    def emit(self, own: Any, point: tuple[Any, Any, Any], sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the centre of the pixel's own lens, and weights.

        own : number of that lens in the camera, which is at `lens`
        point : x, y from its centre, and depth behind the lenses
        """
        drawn = sampler.next_1d()
        through_other = drawn >= OWN
        number = mi.UInt32((drawn - OWN) / (1 - OWN) * self._others)
        number = dr.minimum(number, max(self._others - 1, 0))
        number += dr.select(number >= own, mi.UInt32(1), mi.UInt32(0))
        through_other &= self._others > 0
        number = dr.select(through_other, number, own)
        shift_x = dr.gather(mi.Float, self._x, number) - dr.gather(mi.Float, self._x, own)
        shift_y = dr.gather(mi.Float, self._y, number) - dr.gather(mi.Float, self._y, own)
        kind = dr.gather(mi.UInt32, self._kind, number)
        x, y, depth = point
        place = lens[0] + shift_x, lens[1] + shift_y
        emission = self._through(kind, (x - shift_x, y - shift_y, depth), sampler, place)
        (start_x, start_y, start_z), direction, weight = emission
        probability = dr.select(through_other, (1 - OWN) / max(self._others, 1), OWN if self._others else 1.0)
        weight = weight * dr.gather(mi.Float, self._area, kind) / probability
        return (start_x + shift_x, start_y + shift_y, start_z), direction, weight

    def _through(self, kind: Any, point: tuple[Any, Any, Any], sampler: Any, lens: Point) -> Emission:
        """Return the rays through lenses of the given types, relative to their centres."""
        start, direction, weight = self._models[0].emit(*point, sampler, lens)
        for number, model in enumerate(self._models[1:], 1):
            other = model.emit(*point, sampler, lens)
            start = tuple(dr.select(kind == number, new, old) for new, old in zip(other[0], start, strict=True))
            direction = tuple(dr.select(kind == number, new, old) for new, old in zip(other[1], direction, strict=True))
            weight = dr.select(kind == number, other[2], weight)
        return start, direction, weight
