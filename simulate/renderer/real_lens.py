"""Rays from the sensor through the surfaces of a real lens into the world, on Mitsuba's fast backends."""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.skipped import reason_for_rays

from ..lenses.field import LensField, bands, field_of, sampling_tables
from ..lenses.prescription import prescription_of
from ..lenses.ray_trace import exit_disk_of, path, trace
from ..lenses.surface_shapes import Functions
from .lens import Emission, LensModel

SAMPLED_CELLS = 8  # of the grid that offsets are drawn from, per wavelength times f-number
HEIGHTS = 257  # off the axis, between which the middle and the amount of the light are interpolated linearly


class RealLens(LensModel):
    """A lens of surfaces, whose light is rays."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType) -> None:
        """Create the model of a lens type with surfaces. Raises InputError if these form no image or pass no light."""
        super().__init__(camera, lens_type)
        import drjit as dr
        import mitsuba as mi

        lens = prescription_of(camera, lens_type)
        numbers = path(lens, exit_disk_of(camera, lens_type, lens))
        self._numbers = numbers.converted(lambda number: dr.opaque(mi.Float, float(number)))
        self._functions = Functions(dr.sqrt, dr.select, dr.maximum)

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        import mitsuba as mi

        on_disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        (at_x, at_y), direction, weight = trace(self._numbers, x, y, on_disk.x, on_disk.y, depth, self._functions)
        return (at_x, at_y, 0), direction, weight


class WaveLens(LensModel):
    """A lens of surfaces before a flat target, whose light is waves.

    A ray goes from the middle of the lens to the point of the target that the light of the sensor point meets on
    average, displaced by an offset that is drawn from the point-spread function of that sensor point.
    """

    has_weights = True

    def __init__(self, camera: Camera, fields: list[tuple[LensField, float]]) -> None:
        """Create the model of a lens type with its fields at the wavelengths of the light, and their weights."""
        self._distance = camera.distance
        total = sum(weight for _, weight in fields)
        self._bands = [_Band(field, weight / total) for field, weight in fields]
        self.tail = max(field.grid[1] for field, _ in fields) / camera.target_pitch

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        import drjit as dr

        del depth  # that of the design: `real_lens` sees to it
        sample, begin = sampler.next_2d(), 0.0
        chosen = sampler.next_1d() if len(self._bands) > 1 else 0.0
        at_x, at_y, weight = self._bands[0].emit(x, y, sample)
        for before, band in zip(self._bands, self._bands[1:], strict=False):
            begin += before.weight
            after = chosen >= begin
            values = zip(band.emit(x, y, sample), (at_x, at_y, weight), strict=True)
            at_x, at_y, weight = (dr.select(after, new, old) for new, old in values)
        return (0, 0, 0), (at_x / self._distance, at_y / self._distance, 1), weight


class _Band:
    """The tables of a lens type at one wavelength, whose share of the light is `weight`."""

    def __init__(self, field: LensField, weight: float) -> None:
        import mitsuba as mi

        self.weight = weight
        self._last = field.field
        heights = np.linspace(0.0, field.field, HEIGHTS)
        # The ratio of heights on the target and on the sensor; that on the axis is the limit.
        near = np.maximum(heights, 1e-6 * field.field)
        self._scale = _table(field.centre(near, np.zeros(HEIGHTS))[0] / near)
        self._light = _table(field.brightness(heights) / field.brightness(np.zeros(1)))
        tables, self._width = sampling_tables(field, SAMPLED_CELLS)
        self._offsets: Any = mi.MarginalContinuous2D1(tables.astype(np.float32), [field.nodes[0].tolist()])

    def emit(self, x: Any, y: Any, sample: Any) -> tuple[Any, Any, Any]:
        """Return the point of the target that a ray meets, from the lens's axis, and its weight."""
        import drjit as dr

        height = dr.sqrt(x * x + y * y)
        scale, weight = self._interpolated(self._scale, height), self._interpolated(self._light, height)
        drawn, _ = self._offsets.sample(sample, [dr.minimum(height, self._last)])
        beside, along = (drawn.x - 0.5) * self._width, (drawn.y - 0.5) * self._width
        cosine = dr.select(height > 0, y / height, 1.0)
        sine = dr.select(height > 0, x / height, 0.0)
        return x * scale + along * sine + beside * cosine, y * scale + along * cosine - beside * sine, weight

    def _interpolated(self, table: Any, height: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        position = dr.minimum(height / self._last, 1.0) * (HEIGHTS - 1)
        lower = dr.minimum(mi.UInt32(position), HEIGHTS - 2)
        low, high = (dr.gather(mi.Float, table, index) for index in (lower, lower + 1))
        return dr.lerp(low, high, position - mi.Float(lower))


def _table(values: FloatArray) -> Any:
    import mitsuba as mi

    return mi.Float(values.astype(np.float32))


def real_lens(camera: Camera, lens_type: LensType, flat: bool = True) -> LensModel:
    """Return the model of a lens type with surfaces: of waves if the light has a wavelength and the target is flat.

    flat : False if there is a world, where the blur depends on what a ray meets
    Raises InputError if the surfaces form no image or pass no light.
    """
    if camera.wavelength is None or reason_for_rays(camera, not flat) is not None:
        return RealLens(camera, lens_type)
    fields = [(field_of(camera, lens_type, wavelength), weight) for wavelength, weight in bands(camera)]
    if any(field.rays_suffice for field, _ in fields):
        return RealLens(camera, lens_type)
    return WaveLens(camera, fields)
