"""The part of the sensor that the sub-images take up, and whether it fits a sensor of a given size."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

from ommatid.runtime.errors import InputError

from ..lens_type import SubImager
from ..scene import Scene

ROUNDING = 1 + 1e-9


def sensor_extent(sub_imagers: Sequence[SubImager], pixel_pitch: float) -> tuple[float, float]:
    """Return height and width of the smallest upright rectangle that holds all patches, in mm."""
    boxes = [_box(sub, pixel_pitch) for sub in sub_imagers]
    left, right, bottom, top = (list(ends) for ends in zip(*boxes, strict=True))
    return max(top) - min(bottom), max(right) - min(left)


def check_sensor(scene: Scene, sub_imagers: Sequence[SubImager]) -> None:
    """Raise InputError, which names the scene file, if the sub-images do not fit the sensor that the scene gives."""
    if scene.camera.sensor is None:
        return
    (height, width), size = sensor_extent(sub_imagers, scene.camera.pixel_pitch), scene.camera.sensor.size
    if height <= size[0] * ROUNDING and width <= size[1] * ROUNDING:
        return
    remedy = "use fewer sub-imagers, a smaller camera.lens_pitch or a larger sensor"
    if height <= size[1] and width <= size[0]:
        remedy = "they fit if the sensor is turned: its height comes first"
    raise InputError(
        f"{scene.source}: camera.sensor.size: the sub-images of all arrays, side by side, take {height:.4g} x"
        f" {width:.4g} mm (height x width), but the sensor has {size[0]:.4g} x {size[1]:.4g} mm; {remedy}"
    )


def _box(sub: SubImager, pitch: float) -> tuple[float, float, float, float]:
    """Ends of the upright box around a patch: left, right, bottom, top."""
    (rows, columns), (x, y) = sub.type.pixels, sub.patch
    along, aside = abs(cos(sub.rotation)) * pitch / 2, abs(sin(sub.rotation)) * pitch / 2
    wide, tall = along * columns + aside * rows, along * rows + aside * columns
    return x - wide, x + wide, y - tall, y + tall
