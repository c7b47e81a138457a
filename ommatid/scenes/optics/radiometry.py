"""Electrons that the target's light frees in a sensor pixel, by photometry, radiometry and the lens's geometry.

A pixel of the target of value f reflects f / 255 of the illuminance E equally into all directions (Lambert), so that
its luminance is E / pi f / 255. Lux are converted to photons by the eye's sensitivity V(lambda), integrated over the
spectrum of the light (`spectrum`). Lengths are millimetres.

Surfaces bring to the sensor what rays show (`field`), less what they reflect: ((n - n') / (n + n'))^2 at normal
incidence (Fresnel). For the rays of the gallery's lenses, unpolarised, that is right to 4e-5; light that is reflected
twice is left out.
"""

from __future__ import annotations

from dataclasses import replace
from math import degrees, pi
from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..constants import WHITE
from ..lens_type import SubImager
from ..pose import Pose, pixel_middles, poses
from ..recording import clips_dark_noise, dark_electrons, expected_recording, saturation_electrons
from ..scene import Scene
from ..tables.sensor import SensorTable
from .spectrum import efficacy, electrons_per_lumen

if TYPE_CHECKING:
    from .prescription import Prescription

METRES = 1e-3  # per millimetre


def electrons_per_steradian(scene: Scene, sensor: SensorTable) -> float:
    """Electrons per unit of f and per steradian of projected solid angle in one pixel."""
    luminance = sensor.illuminance / pi / WHITE  # lm / (m^2 sr) per unit of f
    area = (scene.camera.pixel_pitch * METRES) ** 2
    return luminance * area * sensor.exposure * electrons_per_lumen(scene)


def solid_angle(aperture: float, depth: float) -> float:
    """Projected solid angle, sr, of a thin lens at `depth` in front of a pixel on its axis: pi sin^2(half its cone)."""
    return pi * aperture**2 / (4 * depth**2 + aperture**2)


def relative_illumination(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """Illumination of a sub-imager's pixels relative to that on the axis of its design: (pixels of the sub-imager,).

    Light of a lens of area A at the distance r is cos(at the lens) cos(at the sensor) A / r^2; the two angles differ
    where the patch is tilted, and otherwise this is the cos^4 law of the chief ray.
    """
    points, normal = pixel_middles(camera, sub, pose), np.cross(pose.axes[:, 0], pose.axes[:, 1])
    squared = np.square(points).sum(axis=-1)
    return (np.abs(points[..., 2] * (points @ normal)) * sub.depth**2 / squared**2).ravel()


def chief_ray_angles(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """Angles, rad, at which a sub-imager's pixels receive the rays through the middle of its lens: (its pixels,)."""
    points, normal = pixel_middles(camera, sub, pose), np.cross(pose.axes[:, 0], pose.axes[:, 1])
    return np.arctan2(np.linalg.norm(np.cross(points, normal), axis=-1), np.abs(points @ normal)).ravel()


def _acceptance(scene: Scene, camera: Camera, sub: SubImager, pose: Pose) -> FloatArray | float:
    """Return the response of a sub-imager's pixels to light at the angle of its chief ray, (its pixels,), 1 at 0."""
    rows = None if scene.sensor is None else scene.sensor.acceptance
    if rows is None:
        return 1.0
    angles, (known, shares) = chief_ray_angles(camera, sub, pose), np.transpose([(0.0, 1.0), *rows])
    if angles.max() > known[-1]:
        raise InputError(
            f"{scene.source}: sensor.acceptance ends at {degrees(known[-1]):.4g} deg, and chief rays of lens type"
            f" '{sub.type.name}' reach {degrees(angles.max()):.4g} deg; add a row, or make the sub-images smaller"
        )
    return np.asarray(np.interp(angles, known, shares), dtype=np.float64)


def electrons(scene: Scene, camera: Camera) -> FloatArray:
    """Electrons per unit of f in every pixel during the exposure: (M,).

    Thin lenses lose no light and follow cos^4. Patches behind surfaces count as upright and at their designed depth.
    Raises ValueError without a sensor or for a pinhole, InputError for chief rays at larger angles than those of
    `sensor.acceptance`, and for surfaces that form no image.
    """
    if scene.sensor is None:
        raise ValueError("numbers of electrons need a scene with a [sensor], got one without")
    unit = electrons_per_steradian(scene, scene.sensor)
    response, passed = np.empty(camera.measurements), transmissions(camera)
    places = zip(camera.sub_imagers, poses(camera), strict=True)
    lenses = np.array([(*pose.lens, sub.type.optics.aperture or 0.0) for sub, pose in places])
    for sub, pixels, pose in zip(camera.sub_imagers, camera.slices(), poses(camera), strict=True):
        if not camera.walls:
            response[pixels] = unit * _through_all_lenses(camera, sub, pose, lenses)
            continue
        if sub.type.optics.aperture is not None:
            angle = solid_angle(sub.type.optics.aperture, sub.depth) * relative_illumination(camera, sub, pose)
        elif sub.type.name in passed:
            angle = passed[sub.type.name] * _through_surfaces(camera, sub, pose)
        else:
            raise ValueError(f"lens type '{sub.type.name}' is a pinhole, expected an aperture or surfaces")
        response[pixels] = unit * angle * _acceptance(scene, camera, sub, pose)
    return response


def _through_surfaces(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """Projected solid angle, sr, of a lens with surfaces at each pixel of a sub-imager, (its pixels,), by its rays."""
    from .field import optics_of

    points = pixel_middles(camera, sub, pose)
    return optics_of(camera, sub.type, None).weight(np.hypot(points[..., 0], points[..., 1]).ravel())


def transmissions(camera: Camera) -> dict[str, float]:
    """Return the share of light that the surfaces of each lens type transmit, by name; 1 less reflection losses.

    A coating's reflectance takes the place of Fresnel's at surfaces between glass and air. Raises InputError for
    surfaces that form no image.
    """
    if not camera.has_surfaces:
        return {}
    from .field import prescription_of

    found = [lens_type for lens_type in camera.types if lens_type.optics.surfaces is not None]
    return {each.name: transmission(prescription_of(camera, each), each.optics.coating) for each in found}


def transmission(prescription: Prescription, coating: float | None = None) -> float:
    """Return the share of light that the surfaces of a lens transmit along the axis."""
    before, behind = prescription.index_before, prescription.index
    reflected = np.square((behind - before) / (behind + before))
    if coating is not None:
        reflected = np.where((before == 1) != (behind == 1), coating, reflected)
    return float(np.prod(1 - reflected))


def _through_all_lenses(camera: Camera, sub: SubImager, pose: Pose, lenses: FloatArray) -> FloatArray:
    """Projected solid angle, sr, of all lenses together at each pixel of a sub-imager: (its pixels,).

    lenses : (lenses, 3), x, y and aperture of each
    """
    shift = np.column_stack([np.array(pose.lens) - lenses[:, :2], np.zeros(len(lenses))])
    seen = relative_illumination(camera, sub, replace(pose, middle=(pose.middle + shift)[:, None, None]))
    angles = np.array([solid_angle(float(aperture), sub.depth) for aperture in lenses[:, 2]])
    return angles @ seen.reshape(len(lenses), -1)


def expected_noise(scene: Scene, camera: Camera, response: FloatArray) -> FloatArray:
    """Variance of every pixel's value for a target at the prior's mean, (M,); NaN where no light arrives.

    response : (M,) electrons per unit of f
    """
    if scene.sensor is None:
        raise ValueError("the noise of a sensor needs a scene with a [sensor], got one without")
    values = camera.received * max(scene.prior.mean, 0.0)
    return expected_recording(scene.sensor, camera, response, values).noise_variance(values)


def predicted_noise(scene: Scene, camera: Camera, response: FloatArray) -> FloatArray:
    """`expected_noise` for a prediction, (M,): NaN also for pixels that this light saturates.

    Raises InputError if every pixel is NaN.
    """
    noise = expected_noise(scene, camera, response)
    if scene.sensor is not None:
        noise[camera.received * scene.prior.mean * response >= saturation_electrons(scene.sensor)] = np.nan
    if np.isnan(noise).all():
        raise InputError(
            f"{scene.source}: sensor: at the prior's mean, {scene.prior.mean:g}, every pixel is full, or none exceeds"
            " the dark; change sensor.exposure or sensor.illuminance"
        )
    return noise


def summary(scene: Scene, camera: Camera, response: FloatArray) -> dict[str, Any]:
    """The light that each lens type's pixels collect from a uniform target, in JSON's types.

    white : electrons at 255, averaged over the type's pixels;  mean : electrons at the prior's mean
    saturation : value that saturates the brightest pixel;  saturates : True if that is below 255
    noise : standard deviation of a value for a target at the prior's mean, in units of f, rms over the pixels
    efficacy : of the light, lm/W;  wavelengths : in mm, which stand for a spectrum, and the share of each
    accepted : least response of a pixel to the angle of its chief ray, relative to 0, of a sensor with an acceptance
    cut_off : True if noise of the dark reaches below a digital number of 0 (EMVA 1288 asks for a higher black level)
    """
    if scene.sensor is None:
        raise ValueError("numbers of electrons need a scene with a [sensor], got one without")
    sensor, noise = scene.sensor, expected_noise(scene, camera, response)
    lens_types: list[dict[str, Any]] = []
    places = [*zip(camera.sub_imagers, poses(camera), strict=True)] if sensor.acceptance else []
    for lens_type, pixels in zip(camera.types, camera.type_slices(), strict=True):
        of_open = float(lens_type.light) * response[pixels]
        average, brightest = float(of_open.mean()), float(of_open.max())
        saturation = saturation_electrons(sensor) / brightest if brightest > 0 else None
        accepted = [float(np.min(_acceptance(scene, camera, *place))) for place in places if place[0].type == lens_type]
        alive = noise[pixels][np.isfinite(noise[pixels])]
        lens_types.append(
            {
                "name": lens_type.name,
                "white": WHITE * average,
                "mean": max(scene.prior.mean, 0.0) * average,
                "saturation": saturation,
                "saturates": saturation is not None and saturation < WHITE,
                "noise": float(np.sqrt(alive.mean())) if alive.size else None,
                **({"accepted": min(accepted)} if accepted else {}),
            }
        )
    return {
        "efficacy": efficacy(scene),
        "wavelengths": [list(band) for band in camera.bands],
        "lens_types": lens_types,
        "dark": dark_electrons(sensor),
        "cut_off": clips_dark_noise(sensor),
    }
