"""Rays from the sensor through the surfaces of a real lens into the world, on Mitsuba's fast backends."""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.optics.diffraction import QUANTILES, end_of

from ..lenses.prescription import prescription_of
from ..lenses.ray_trace import exit_disk_of, path, trace
from ..lenses.surface_shapes import Functions
from .lens import Emission, LensModel, Point


class RealLens(LensModel):
    """A lens of surfaces; if the light has a wavelength, its pupil diffracts as an open one of its f-number does."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType) -> None:
        """Create the model of a lens type with surfaces. Raises InputError if these form no image or pass no light."""
        super().__init__(camera, lens_type)
        import drjit as dr
        import mitsuba as mi

        lens, depth = prescription_of(camera, lens_type), camera.depth(lens_type)
        numbers = path(lens, exit_disk_of(camera, lens_type, lens))
        self._numbers = numbers.converted(lambda number: dr.opaque(mi.Float, float(number)))
        self._functions = Functions(dr.sqrt, dr.select, dr.maximum)
        self._table = None
        if camera.wavelength is not None:
            from .diffracting_lens import BandTable

            self._slope = camera.wavelength * lens.working_f_number(depth) / np.pi / depth
            self.tail = end_of(0.0) * self._slope * camera.distance / camera.target_pitch
            self._table = BandTable(np.zeros(2), 0.0, QUANTILES)
            self.captured = self._table.captured

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        import drjit as dr
        import mitsuba as mi

        del lens
        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        (at_x, at_y), (u, v, w), weight = trace(self._numbers, x, y, on_disk.x, on_disk.y, depth, self._functions)
        if self._table is None:
            return (at_x, at_y, 0), (u, v, w), weight
        sample = sampler.next_2d()
        radius = self._table.at(0.0, sample.x, all_light=False)[0] * self._slope
        sine, cosine = dr.sincos(2 * np.pi * sample.y)
        return (at_x, at_y, 0), (u / w + radius * cosine, v / w + radius * sine, 1), weight
