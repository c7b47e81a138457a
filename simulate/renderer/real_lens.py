"""From a point of the sensor through the surfaces of a real lens into the world, on Mitsuba's fast backends."""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.optics.blur import Blur

from ..lenses.prescription import prescription_of
from ..lenses.ray_trace import Functions, exit_disk_of, path, trace
from .lens import LensModel, displaced


class RealLens(LensModel):
    """A lens of surfaces; where the light has a wavelength, its pupil diffracts as an open one of its f-number does."""

    weighs = True

    def __init__(self, camera: Camera, kind: LensType) -> None:
        """Of a lens type with surfaces. Raises InputError where they show no image, or let no light through."""
        super().__init__(camera, kind)
        import drjit as dr
        import mitsuba as mi

        lens = prescription_of(camera, kind)
        self._numbers = [dr.opaque(mi.Float, float(number)) for number in path(lens, exit_disk_of(camera, kind, lens))]
        self._functions = Functions(dr.sqrt, dr.select, dr.maximum)
        self._radii = None
        if camera.wavelength is not None:
            slope = camera.wavelength * lens.working_f_number(camera.depth(kind)) / np.pi / camera.depth(kind)
            blur = Blur(airy=slope * camera.distance / camera.target_pitch)
            self.tail = blur.reach
            self._radii = mi.Float((blur.radii * camera.target_pitch / camera.distance).astype(np.float32))

    def leave(self, x: Any, y: Any, depth: Any, sampler: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]:
        """Origin and direction (not normalised), from the lens's centre, of rays from (x, y, -depth), and weights."""
        import mitsuba as mi

        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        (at_x, at_y), (u, v, w), weight = trace(self._numbers, x, y, on_disk.x, on_disk.y, depth, self._functions)
        if self._radii is None:
            return (at_x, at_y, 0), (u, v, w), weight
        away = displaced(self._radii, sampler.next_2d())
        return (at_x, at_y, 0), (u / w + away[0], v / w + away[1], 1), weight
