"""How many electrons the light of the target frees in a sensor pixel: photometry, radiometry, the lens's geometry.

A pixel of the target of value f reflects f / 255 of the illuminance E alike into all directions (Lambert), so that its
luminance is E / pi f / 255. The light has one wavelength and is counted at the eye's peak: 683 lm are a watt whatever
that wavelength is. (Lux of a colour that the eye sees less of would bring more photons.) Lengths are millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..constants import GREEN, WHITE
from ..lens_type import LensType, SubImager
from ..pose import Pose, corner_offset, poses
from ..recording import clips_dark_noise, dark_electrons, expected_recording, saturation_electrons
from ..scene import Scene
from ..tables.sensor import SensorTable

Vector = NDArray[np.float64]

PLANCK, LIGHT_SPEED, EFFICACY = 6.62607015e-34, 299792458.0, 683.0  # J s, m/s, lm/W: exact in the SI
METRES = 1e-3  # a millimetre


def electrons_a_steradian(scene: Scene, sensor: SensorTable) -> float:
    """Electrons that each unit of f frees in a pixel for every steradian of projected solid angle."""
    wavelength = (scene.camera.wavelength or GREEN) * METRES
    radiance = sensor.illuminance / pi / WHITE / EFFICACY  # W / (m^2 sr) for each unit of f
    photons = radiance * wavelength / (PLANCK * LIGHT_SPEED)
    area = (scene.camera.pixel_pitch * METRES) ** 2
    return photons * area * sensor.exposure * sensor.quantum_efficiency


def solid_angle(aperture: float, depth: float) -> float:
    """Projected solid angle, sr, of a thin lens seen from the axis `depth` behind it: pi sin^2 of half its cone."""
    return pi * aperture**2 / (4 * depth**2 + aperture**2)


def relative_illumination(camera: Camera, sub: SubImager, stand: Pose) -> Vector:
    """Light on each pixel of a sub-imager against that on the axis of its design: cos^4 of the chief ray.

    From a lens of area A at the distance r comes cos(at the lens) cos(at the sensor) A / r^2: where the patch is
    tilted the two angles differ. (pixels of the sub-imager,)
    """
    rows, columns = sub.type.pixels
    left, top = corner_offset(camera, sub)
    u = (left + (np.arange(columns) + 0.5) * camera.pixel_pitch)[None, :, None]
    v = (top + (np.arange(rows) + 0.5) * camera.pixel_pitch)[:, None, None]
    points = stand.middle + u * stand.axes[:, 0] + v * stand.axes[:, 1]
    along_normal = points @ np.cross(stand.axes[:, 0], stand.axes[:, 1])
    squared = np.square(points).sum(axis=-1)
    return (np.abs(points[..., 2] * along_normal) * sub.depth**2 / squared**2).ravel()


def electrons(
    scene: Scene,
    camera: Camera,
    solid_angles: Mapping[str, float] | None = None,
    illumination: Vector | None = None,
) -> Vector:
    """Electrons that each unit of f frees in every pixel during the exposure: (M,).

    solid_angles : sr by the name of the lens type, projected and on the axis, of those with surfaces
    illumination : (M,) relative to the axis, of pixels behind surfaces; thin lenses have cos^4. Absent: 1
    Raises ValueError without a sensor, or where the solid angle of surfaces is wanting.
    """
    if scene.sensor is None:
        raise ValueError("electrons are counted by a scene's [sensor], and it has none")
    each = electrons_a_steradian(scene, scene.sensor)
    response = np.empty(camera.measurements)
    for sub, place, stand in zip(camera.sub_imagers, camera.slices(), poses(camera), strict=True):
        angle = _solid_angle(sub.type, sub.depth, solid_angles or {})
        if sub.type.optics.surfaces is None:
            response[place] = each * angle * relative_illumination(camera, sub, stand)
        else:
            response[place] = each * angle * (1.0 if illumination is None else illumination[place])
    return response


def _solid_angle(kind: LensType, depth: float, known: Mapping[str, float]) -> float:
    if kind.optics.aperture is not None:
        return solid_angle(kind.optics.aperture, depth)
    if kind.name not in known:
        raise ValueError(f"lens type '{kind.name}' has no aperture, so its solid angle has to be told")
    return known[kind.name]


def expected_noise(scene: Scene, camera: Camera, response: Vector) -> Vector:
    """Variance of every pixel's value where the target is the prior's mean, (M,); NaN where no light arrives."""
    if scene.sensor is None:
        raise ValueError("this noise is a scene's [sensor]'s, and it has none")
    values = np.full(camera.measurements, max(scene.prior.mean, 0.0))
    return expected_recording(scene.sensor, camera, response, values).noise_variance(values)


def predicted_noise(scene: Scene, camera: Camera, response: Vector) -> Vector:
    """The same for a prediction, (M,): NaN also for pixels that this light fills, as they tell nothing of it.

    Raises InputError where that is every pixel.
    """
    noise = expected_noise(scene, camera, response)
    if scene.sensor is not None:
        noise[scene.prior.mean * response >= saturation_electrons(scene.sensor)] = np.nan
    if np.isnan(noise).all():
        raise InputError(
            f"{scene.source}: sensor: at the prior's mean, {scene.prior.mean:g}, every pixel is full, or nothing stands"
            " out from the dark; change sensor.exposure or sensor.illuminance"
        )
    return noise


def summary(scene: Scene, camera: Camera, response: Vector) -> dict[str, Any]:
    """What every lens type's pixels collect, in JSON's types: electrons of light from a target of one value.

    white : of 255, on average over the type's pixels;  mean : of the prior's mean
    saturation : the value from which on the brightest pixel is full;  saturates : whether that is less than 255
    noise : standard deviation of a value where the target is the prior's mean, in units of f, rms over the pixels
    cut_off : whether noise of the dark reaches below a digital number of 0 (EMVA 1288 asks for a higher black level)
    """
    if scene.sensor is None:
        raise ValueError("electrons are counted by a scene's [sensor], and it has none")
    sensor, noise = scene.sensor, expected_noise(scene, camera, response)
    kinds: list[dict[str, Any]] = []
    for kind, place in zip(camera.types, camera.type_slices(), strict=True):
        average, brightest = float(response[place].mean()), float(response[place].max())
        full = saturation_electrons(sensor) / brightest if brightest > 0 else None
        alive = noise[place][np.isfinite(noise[place])]
        kinds.append(
            {
                "name": kind.name,
                "white": WHITE * average,
                "mean": max(scene.prior.mean, 0.0) * average,
                "saturation": full,
                "saturates": full is not None and full < WHITE,
                "noise": float(np.sqrt(alive.mean())) if alive.size else None,
            }
        )
    return {"lens_types": kinds, "dark": dark_electrons(sensor), "cut_off": clips_dark_noise(sensor)}
