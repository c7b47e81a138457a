"""Which effects of its lenses and its sensor a scene needs, decided before anything is rendered.

An effect is left out where it is small in itself and small beside the noise: where images drawn from the prior would
change by it, on average, less than a tenth of the noise's variance. With it goes a bound on what any target of values
from 0 to 255 would show of it. `render.complete` leaves nothing out.
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
from ..tables.sensor import SensorTable

if TYPE_CHECKING:
    from .blur import Blur

MOST_DISK = 1 / 20  # of a pixel of f: a disk of defocus that may be left out
MOST_AIRY = 1 / 5  # of a sensor pixel: an Airy disk, to its first dark ring, that may be left out
MOST_OF_NOISE = 0.1  # of the noise's variance: what leaving out may change
MOST_SHOT = 0.1  # of the variance of read noise: shot noise that hides below it
SURE = 5.0  # standard deviations


@dataclass(frozen=True)
class SkippedEffect:
    """An effect that is not simulated, why, and by how much a measurement changes at most, in units of f.

    bound : 0 where nothing changes at all
    """

    what: str
    why: str
    bound: float = 0.0

    def describe(self) -> dict[str, Any]:
        """In JSON's types; the bound only where there is one."""
        return {"what": self.what, "why": self.why, **({"bound": self.bound} if self.bound else {})}


@dataclass(frozen=True)
class BlurChange:
    """What leaving out a blur changes in H: at most, for values from 0 to 255; and the mean square for the prior."""

    most: float
    mean_square: float


def without_negligible_effects(scene: Scene, camera: Camera) -> tuple[Camera, tuple[SkippedEffect, ...]]:
    """The camera with those effects alone that this scene needs, and what was left out."""
    if scene.render.complete or scene.world is not None or all(kind.optics.aperture is None for kind in camera.types):
        return camera, ()
    allowed = MOST_OF_NOISE * noise_variance(scene, camera)
    found: list[SkippedEffect] = []
    if camera.wavelength is not None:
        airy = _without_diffraction(camera, camera.wavelength, scene.prior.variance, allowed)
        if airy is not None:
            camera = replace(camera, wavelength=None)
            found.append(airy)
    types: list[LensType] = []
    for kind in camera.types:
        open_lens = _without_aperture(camera, kind, scene.prior.variance, allowed)
        types.append(kind if open_lens is None else replace(kind, optics=_as_pinhole(kind.optics)))
        found += [] if open_lens is None else [open_lens]
    return replace(camera, types=tuple(types)), tuple(found)


def noise_variance(scene: Scene, camera: Camera) -> float:
    """Variance of a measurement by the sensor, of its quietest lens type where the target is the prior's mean."""
    if scene.noise is not None:
        return scene.noise.variance + scene.noise.quantisation_variance
    if scene.sensor is None:
        return 0.0
    from . import radiometry

    dark = {kind.name: 0.0 for kind in camera.types if kind.optics.surfaces is not None}  # of them nothing is left out
    variances = radiometry.expected_noise(scene, camera, radiometry.electrons(scene, camera, dark))
    return float(np.nanmin(variances, initial=np.inf))


def shot_noise_hides(sensor: SensorTable, white: float) -> bool:
    """Whether the counting of `white` electrons, those of a value of 255, shows below the noise of reading them."""
    return white + sensor.dark_current * sensor.exposure < MOST_SHOT * sensor.read_noise**2


def negligible_shot_noise(scene: Scene, camera: Camera) -> SkippedEffect | None:
    """None where the counting of electrons shows, or where it is not known how many there are.

    The bound is five standard deviations of what is left out, at a value of 255.
    """
    if scene.sensor is None or scene.render.complete or any(kind.optics.aperture is None for kind in camera.types):
        return None
    from . import radiometry

    response, sensor = radiometry.electrons(scene, camera), scene.sensor
    counted = WHITE * response + sensor.dark_current * sensor.exposure
    if not shot_noise_hides(sensor, WHITE * float(response.max())):
        return None
    most = f"{float(counted.max()):.3g} electrons at most"
    why = f"{most}, whose shot noise hides below the read noise of {sensor.read_noise:g}"
    return SkippedEffect("shot noise", why, SURE * float(np.max(np.sqrt(counted) / response)))


def _as_pinhole(glass: LensOptics) -> LensOptics:
    return LensOptics(distortion=glass.distortion)


def _without_diffraction(camera: Camera, wavelength: float, contrast: float, allowed: float) -> SkippedEffect | None:
    """None where diffraction is needed, by one lens type at least."""
    from .blur import blur_of

    widest = most = 0.0
    for kind in camera.types:
        if kind.optics.surfaces is not None:
            return None
        if kind.optics.aperture is None:
            continue
        disk = 2 * AIRY_FIRST_ZERO * wavelength * camera.depth(kind) / kind.optics.aperture / camera.pixel_pitch
        if disk >= MOST_AIRY:
            return None
        change = _change(camera, kind, replace(blur_of(camera, kind), airy=0.0))
        if contrast * change.mean_square > allowed:
            return None
        widest, most = max(widest, disk), max(most, change.most)
    why = f"the Airy disk is {widest:.2g} of a sensor pixel wide, and the noise hides what it does"
    return SkippedEffect("diffraction", why, most)


def _without_aperture(camera: Camera, kind: LensType, contrast: float, allowed: float) -> SkippedEffect | None:
    """None where a type's aperture is needed, or where there is none."""
    if kind.optics.aperture is None or camera.wavelength is not None:
        return None
    if camera.tolerance is not None and (camera.tolerance.focal_length or camera.tolerance.tilt):
        return None  # which put sub-imagers out of focus
    from .blur import Blur, blur_of

    blur = blur_of(camera, kind)
    what = f"samples of the aperture of lens type {kind.name}"
    uneven = _unevenness(camera, kind)
    if blur.disk == 0:
        if contrast * (uneven / float(kind.ratio)) ** 2 > allowed:  # m^2 entries of 1/m^2, each changed by that share
            return None
        return SkippedEffect(what, "it is in focus: all rays of a sensor point meet on the target", WHITE / 2 * uneven)
    if blur.disk >= MOST_DISK:
        return None
    change = _change(camera, kind, Blur())
    if contrast * change.mean_square > allowed:
        return None
    why = f"the disk of defocus is {blur.disk:.2g} pixels of f wide, and the noise hides what it does"
    return SkippedEffect(what, why, change.most + WHITE / 2 * uneven)


def _change(camera: Camera, kind: LensType, less: Blur) -> BlurChange:
    """What another blur changes in a row of H, of a pixel far from the target's edges."""
    from .blur import blur_of, matrix

    blur = blur_of(camera, kind)
    margin = ceil(blur.reach) + 1
    side = ceil(kind.ratio) + 1 + 2 * margin
    alone = replace(kind, array=(1, 1), pixels=(1, 1), origin=(margin, margin), left=None)
    small = replace(camera, rows=side, columns=side, types=(alone,), lens_columns=None)
    row = sparse.csr_array(matrix(small, alone, blur) - matrix(small, alone, less)).data
    most = WHITE * max(float(row[row > 0].sum()), -float(row[row < 0].sum()))
    return BlurChange(most, float(np.square(row).sum()))


def _unevenness(camera: Camera, kind: LensType) -> float:
    """By how much more light than its middle a pixel's edge gets at most, relative: cos^4, at the patch's corner."""
    depth = camera.depth(kind)
    furthest = max(
        hypot(sub.patch[0] - sub.lens[0], sub.patch[1] - sub.lens[1]) for sub in camera.sub_imagers if sub.type == kind
    )
    corner = furthest + hypot(*kind.pixels) / 2 * camera.pixel_pitch
    slope = corner / depth
    return 4 * slope / (1 + slope**2) * camera.pixel_pitch / 2**0.5 / depth
