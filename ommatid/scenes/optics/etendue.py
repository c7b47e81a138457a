"""Light that the surfaces of a real lens bring to the sensor, as projected solid angles, sr.

The irradiance of a sensor point over the radiance of a uniform world, from the rays of `field`.
`ommatid.scenes.optics.radiometry` computes electrons from it, and from the share of light that surfaces transmit: each
reflects ((n - n') / (n + n'))^2 at normal incidence (Fresnel). For the rays of the gallery's lenses, unpolarised, that
is right to 4e-5; light that is reflected twice is left out.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..camera import Camera
from ..pose import corner_offset, poses
from .field import LensField, field_of, prescription_of
from .prescription import Prescription


def solid_angles(camera: Camera) -> dict[str, float]:
    """Return the projected solid angle on the axis of each lens type with surfaces, by name.

    Raises InputError for a lens that forms no image.
    """
    return {name: float(field.brightness(np.zeros(1))[0]) for name, field in _fields(camera).items()}


def transmissions(camera: Camera) -> dict[str, float]:
    """Return the share of light that the surfaces of each lens type transmit, by name; 1 less reflection losses.

    A coating's reflectance takes the place of Fresnel's at surfaces between glass and air.
    """
    return {
        lens_type.name: transmission(prescription_of(camera, lens_type), lens_type.optics.coating)
        for lens_type in camera.types
        if lens_type.optics.surfaces is not None
    }


def transmission(prescription: Prescription, coating: float | None = None) -> float:
    """Return the share of light that the surfaces of a lens transmit along the axis."""
    before, behind = prescription.index_before, prescription.index
    reflected = np.square((behind - before) / (behind + before))
    if coating is not None:
        reflected = np.where((before == 1) != (behind == 1), coating, reflected)
    return float(np.prod(1 - reflected))


def relative_illumination(camera: Camera) -> FloatArray:
    """Return the light in the middle of each sensor pixel relative to its lens's axis, (M,); 1 without surfaces.

    Patches count as upright and at their designed depth.
    """
    illumination = np.ones(camera.measurements)
    fields = _fields(camera)
    for sub, rows, pose in zip(camera.sub_imagers, camera.slices(), poses(camera), strict=True):
        if sub.type.name not in fields:
            continue
        row, column = (index.ravel() + 0.5 for index in np.indices(sub.type.pixels))
        u, v = corner_offset(camera, sub)
        points = pose.axes @ np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        x, y, _ = pose.middle[:, None] + points
        light = fields[sub.type.name].brightness(np.append(0.0, np.hypot(x, y)))
        illumination[rows] = light[1:] / light[0]
    return illumination


def _fields(camera: Camera) -> dict[str, LensField]:
    """Return the rays of each lens type with surfaces, by its name."""
    return {lens.name: field_of(camera, lens, None) for lens in camera.types if lens.optics.surfaces is not None}
