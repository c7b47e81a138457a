"""Optical and sensor effects that are negligible in a scene, found before anything is rendered.

An effect is skipped if it is small in itself and small compared to the noise: if it would change images drawn from the
prior, on average, by less than a tenth of the noise variance. Each skipped effect comes with a bound on the change for
any target of values from 0 to 255. `render.complete` skips nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, hypot
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from ..camera import Camera
from ..constants import AIRY_FIRST_ZERO, WHITE
from ..lens_type import LensOptics, LensType
from ..scene import Scene

if TYPE_CHECKING:
    from .blur import Blur

MOST_DISK = 1 / 20  # pixels of f, diameter of a negligible disk of defocus
MOST_AIRY = 1 / 5  # sensor pixels, diameter of a negligible Airy disk, to its first dark ring
MOST_OF_NOISE = 0.1  # of the noise variance: change by a negligible effect
MOST_SHOT = 0.1  # of the variance of read noise: negligible shot noise
BOUND_DEVIATIONS = 5.0  # standard deviations in a bound on noise


@dataclass(frozen=True)
class SkippedEffect:
    """An effect that is not simulated, why, and the largest change of a measurement, in units of f.

    bound : 0 if nothing changes at all
    """

    what: str
    why: str
    bound: float = 0.0

    def describe(self) -> dict[str, Any]:
        """The effect in JSON's types, without a bound of 0."""
        return {"what": self.what, "why": self.why, **({"bound": self.bound} if self.bound else {})}


def without_negligible_effects(scene: Scene, camera: Camera) -> tuple[Camera, tuple[SkippedEffect, ...]]:
    """The camera without the effects that are negligible in this scene, and what was skipped."""
    if (
        scene.render.complete
        or scene.world is not None
        or all(lens_type.optics.aperture is None for lens_type in camera.types)
    ):
        return camera, ()
    allowed = MOST_OF_NOISE * noise_variance(scene, camera)
    skipped: list[SkippedEffect] = []
    if camera.wavelength is not None:
        diffraction = _negligible_diffraction(camera, camera.wavelength, scene.prior.variance, allowed)
        if diffraction is not None:
            camera = replace(camera, wavelength=None)
            skipped.append(diffraction)
    types: list[LensType] = []
    for lens_type in camera.types:
        aperture = _negligible_aperture(camera, lens_type, scene.prior.variance, allowed)
        if aperture is None:
            types.append(lens_type)
        else:
            types.append(replace(lens_type, optics=LensOptics(distortion=lens_type.optics.distortion)))
            skipped.append(aperture)
    return replace(camera, types=tuple(types)), tuple(skipped)


def noise_variance(scene: Scene, camera: Camera) -> float:
    """Sensor noise variance of the pixel with the least noise, for a target at the prior's mean."""
    if scene.noise is not None:
        return scene.noise.variance + scene.noise.quantisation_variance
    if scene.sensor is None:
        return 0.0
    from . import radiometry

    # Lenses with surfaces are always simulated in full; a solid angle of 0 takes their pixels out of the minimum.
    without = {lens_type.name: 0.0 for lens_type in camera.types if lens_type.optics.surfaces is not None}
    variances = radiometry.expected_noise(scene, camera, radiometry.electrons(scene, camera, without))
    return float(np.nanmin(variances, initial=np.inf))


def negligible_shot_noise(scene: Scene, camera: Camera) -> SkippedEffect | None:
    """The skipped shot noise, or None if it exceeds a tenth of the read noise or if the light cannot be computed.

    The bound is five standard deviations of the shot noise at a value of 255.
    """
    sensor = scene.sensor
    if sensor is None or scene.render.complete or any(lens_type.optics.aperture is None for lens_type in camera.types):
        return None
    from . import radiometry

    response = radiometry.electrons(scene, camera)
    dark = sensor.dark_current * sensor.exposure
    if WHITE * float(response.max()) + dark >= MOST_SHOT * sensor.read_noise**2:
        return None
    counted = WHITE * response + dark
    most = f"{float(counted.max()):.3g} electrons at most"
    why = f"{most}, whose shot noise is far below the read noise of {sensor.read_noise:g}"
    return SkippedEffect("shot noise", why, BOUND_DEVIATIONS * float(np.max(np.sqrt(counted) / response)))


def _negligible_diffraction(
    camera: Camera, wavelength: float, prior_variance: float, allowed: float
) -> SkippedEffect | None:
    """The skipped diffraction, or None if at least one lens type needs it."""
    from .blur import blur_of

    widest = most = 0.0
    for lens_type in camera.types:
        if lens_type.optics.surfaces is not None:
            return None
        if lens_type.optics.aperture is None:
            continue
        disk = 2 * AIRY_FIRST_ZERO * wavelength * camera.depth(lens_type) / lens_type.optics.aperture
        disk = disk / camera.pixel_pitch
        if disk >= MOST_AIRY:
            return None
        change, mean_square = _change(camera, lens_type, replace(blur_of(camera, lens_type), airy=0.0))
        if prior_variance * mean_square > allowed:
            return None
        widest, most = max(widest, disk), max(most, change)
    why = f"the Airy disk is {widest:.2g} sensor pixels wide, and its effect is far below the noise"
    return SkippedEffect("diffraction", why, most)


def _negligible_aperture(
    camera: Camera, lens_type: LensType, prior_variance: float, allowed: float
) -> SkippedEffect | None:
    """The skipped aperture of a lens type, or None if it is needed or if there is none."""
    if lens_type.optics.aperture is None or camera.wavelength is not None:
        return None
    if camera.tolerance is not None and (camera.tolerance.focal_length or camera.tolerance.tilt):
        return None  # both defocus sub-imagers
    from .blur import Blur, blur_of

    blur = blur_of(camera, lens_type)
    what = f"samples of the aperture of lens type {lens_type.name}"
    falloff = _illumination_change(camera, lens_type)
    if blur.disk == 0:
        if prior_variance * (falloff / float(lens_type.ratio)) ** 2 > allowed:  # m^2 entries of 1/m^2 change by falloff
            return None
        return SkippedEffect(what, "it is in focus: all rays of a sensor point meet on the target", WHITE / 2 * falloff)
    if blur.disk >= MOST_DISK:
        return None
    change, mean_square = _change(camera, lens_type, Blur())
    if prior_variance * mean_square > allowed:
        return None
    why = f"the disk of defocus is {blur.disk:.2g} pixels of f wide, and its effect is far below the noise"
    return SkippedEffect(what, why, change + WHITE / 2 * falloff)


def _change(camera: Camera, lens_type: LensType, reduced: Blur) -> tuple[float, float]:
    """Change of a measurement, far from the target's edges, if the blur is reduced to `reduced`.

    Returns the largest change for values from 0 to 255, and the mean square for independent pixels of variance 1.
    """
    from .blur import blurs_of, matrix

    blurs = blurs_of(camera, lens_type)
    margin = ceil(max(blur.reach for blur, _ in blurs)) + 1
    side = ceil(lens_type.ratio) + 1 + 2 * margin
    single = replace(lens_type, array=(1, 1), pixels=(1, 1), origin=(margin, margin), left=None)
    small = replace(camera, rows=side, columns=side, types=(single,), lens_columns=None)
    row = sparse.csr_array(matrix(small, single, *blurs) - matrix(small, single, (reduced, 1.0))).data
    most = WHITE * max(float(row[row > 0].sum()), -float(row[row < 0].sum()))
    return most, float(np.square(row).sum())


def _illumination_change(camera: Camera, lens_type: LensType) -> float:
    """Largest relative change of illumination (cos^4) across a pixel, at the corner of the patch."""
    depth = camera.depth(lens_type)
    furthest = max(
        hypot(sub.patch[0] - sub.lens[0], sub.patch[1] - sub.lens[1])
        for sub in camera.sub_imagers
        if sub.type == lens_type
    )
    corner = furthest + hypot(*lens_type.pixels) / 2 * camera.pixel_pitch
    slope = corner / depth
    return 4 * slope / (1 + slope**2) * camera.pixel_pitch / 2**0.5 / depth
