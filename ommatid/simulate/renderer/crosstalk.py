"""Rays of a camera without walls between its channels: from every sensor pixel through any of its lenses.

Half of a pixel's rays cross its own lens, and the others one that is drawn evenly from all the others. A ray carries
the light of its lens, aperture area times cos^4 at the sensor, over the probability with which it was drawn.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import poses

from .lens import Distance, Emission, LensModel, Point
from .loaded import dr, mi

OWN = 0.5  # of a pixel's rays, through its own lens


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
