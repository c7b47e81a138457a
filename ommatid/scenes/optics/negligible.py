"""Optical and sensor effects that are negligible in a scene, found before anything is rendered.

An effect is skipped if it is small in itself and small compared to the noise: if it would change images drawn from the
prior, on average, by less than 1/200 of the noise variance in any pixel, those at the target's corners included,
whose rays may miss the target. The error that is expected without the effect is then at most 2 % below the one with
it. Each skipped effect comes with a bound on the change for
any target of values from 0 to 255. `render.complete` skips nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import ceil, floor, hypot
from typing import Any

import numpy as np
from scipy import sparse, special

from ..camera import Camera
from ..constants import GREEN, WHITE
from ..lens_type import LensType
from ..scene import Scene
from ..tables.estimation import PriorTable

MOST_DISK = 1 / 20  # pixels of f, diameter of a negligible disk of defocus
MOST_AIRY = 1 / 5  # sensor pixels, diameter of a negligible Airy disk, to its first dark ring
MOST_OF_NOISE = 1 / 200  # of the noise variance: change by a negligible effect
MOST_SHOT = 0.02  # of the variance of read noise: negligible shot noise, at a value of 255
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
        or not camera.walls
        or all(lens_type.optics.aperture is None for lens_type in camera.types)
    ):
        return camera, ()
    allowed = MOST_OF_NOISE * noise_variance(scene, camera)
    skipped: list[SkippedEffect] = []
    if camera.wavelength is not None:
        diffraction = _negligible_diffraction(camera, camera.wavelength, scene.prior, allowed)
        if diffraction is not None:
            camera = replace(camera, wavelength=None)
            skipped.append(diffraction)
    types: list[LensType] = []
    for lens_type in camera.types:
        aperture = _negligible_aperture(camera, lens_type, scene.prior, allowed)
        if aperture is None:
            types.append(lens_type)
        else:
            types.append(replace(lens_type, optics=replace(lens_type.optics, aperture=None, focus=None)))
            skipped.append(aperture)
    return replace(camera, types=tuple(types)), tuple(skipped)


def noise_variance(scene: Scene, camera: Camera) -> float:
    """Sensor noise variance of the pixel with the least noise, for a target at the prior's mean."""
    if scene.noise is not None:
        return scene.noise.variance + scene.noise.quantisation_variance
    if scene.sensor is None:
        return 0.0
    from . import radiometry

    variances = radiometry.expected_noise(scene, camera, radiometry.electrons(scene, camera))
    return float(np.nanmin(variances, initial=np.inf))


def negligible_shot_noise(scene: Scene, camera: Camera) -> SkippedEffect | None:
    """The skipped shot noise, or None if it exceeds 2 % of the read noise, or if the light cannot be computed.

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
    camera: Camera, wavelength: float, prior: PriorTable, allowed: float
) -> SkippedEffect | None:
    """The skipped diffraction, or None if at least one lens type needs it."""
    widest = most = 0.0
    for lens_type in camera.types:
        if lens_type.optics.surfaces is not None:
            return None
        if lens_type.optics.aperture is None:
            continue
        disk = camera.airy_pixels(lens_type, lens_type.optics.aperture, wavelength)
        if disk >= MOST_AIRY:
            return None
        change, mean_square = _change(camera, replace(camera, wavelength=None), lens_type, lens_type, prior)
        if mean_square > allowed:
            return None
        widest, most = max(widest, disk), max(most, change)
    why = f"the Airy disk is {widest:.2g} sensor pixels wide, and its effect is far below the noise"
    return SkippedEffect("diffraction", why, most)


def _negligible_aperture(
    camera: Camera, lens_type: LensType, prior: PriorTable, allowed: float
) -> SkippedEffect | None:
    """The skipped aperture of a lens type, or None if it is needed or if there is none."""
    if lens_type.optics.aperture is None or camera.wavelength is not None:
        return None
    if camera.tolerance is not None and (camera.tolerance.focal_length or camera.tolerance.tilt):
        return None  # both defocus sub-imagers
    disk = lens_type.optics.aperture * abs(1 - camera.distance_of(lens_type) / camera.focus(lens_type))
    disk /= camera.target_pitch
    what = f"samples of the aperture of lens type {lens_type.name}"
    falloff = _illumination_change(camera, lens_type)
    if disk == 0:
        if prior.variance * (falloff / float(lens_type.ratio)) ** 2 > allowed:  # m^2 entries of 1/m^2 change by falloff
            return None
        return SkippedEffect(what, "it is in focus: all rays of a sensor point meet on the target", WHITE / 2 * falloff)
    if disk >= MOST_DISK:
        return None
    pinhole = replace(lens_type, optics=replace(lens_type.optics, aperture=None, focus=None))
    change, mean_square = _change(camera, camera, lens_type, pinhole, prior)
    if mean_square > allowed:
        return None
    why = f"the disk of defocus is {disk:.2g} pixels of f wide, and its effect is far below the noise"
    return SkippedEffect(what, why, change + WHITE / 2 * falloff)


def _change(
    camera: Camera, other_camera: Camera, lens_type: LensType, other_type: LensType, prior: PriorTable
) -> tuple[float, float]:
    """Change of a measurement, far from the target's edges and at its corner, in the other camera by the other type.

    Returns the largest change for values from 0 to 255, and the larger mean square for images of the prior. At the
    corner rays miss the target, so that a row of H changes its sum, and sees less of the prior's mean.
    """
    from .boxes import designed_box
    from .field import light_reach
    from .lens_kernels import blurred_matrix

    margin = ceil(light_reach(camera, lens_type)) + 1
    nearest = (floor(min(start, end)) for start, end in lens_type.gaps(camera.shape))
    largest = mean_square = 0.0
    for origin in ((margin, margin), tuple(min(max(gap, 0), margin) for gap in nearest)):
        rows, columns = (start + ceil(lens_type.ratio) + 1 + margin for start in origin)
        matrices: list[sparse.csr_array] = []
        for each, its_type in ((camera, lens_type), (other_camera, other_type)):
            single = replace(its_type, array=(1, 1), pixels=(1, 1), origin=origin, left=None)
            small = replace(each, rows=rows, columns=columns, types=(single,), lens_columns=None)
            blurred = small.is_blurred(single)
            matrices.append(blurred_matrix(small, single) if blurred else designed_box(small.shape, single).to_sparse())
        row = sparse.csr_array(matrices[0] - matrices[1]).data
        lost, squares = float(row.sum()) ** 2, float(np.square(row).sum())
        if prior.kind != "independent":
            squares = max(squares, lost)  # of neighbours that are all alike
        largest = max(largest, WHITE * float(row[row > 0].sum()), -WHITE * float(row[row < 0].sum()))
        mean_square = max(mean_square, prior.mean**2 * lost + prior.variance * squares)
    return largest, mean_square


@cache
def light_kept_in_focus(side: float) -> float:
    """Share of the light of a sensor pixel's square that stays in it behind a circular aperture in focus.

    side : of the square, in wavelengths times the f-number
    """
    # By Parseval: the square's autocorrelation, transformed, times the transfer function, in polar coordinates.
    nodes, weights = special.roots_legendre(200 + ceil(4 * side))
    q, turn = (1 + nodes[:, None]) / 2, np.pi / 8 * (1 + nodes)
    transfer = 2 / np.pi * (np.arccos(q) - q * np.sqrt(1 - q**2))
    square = np.sinc(side * q * np.cos(turn)) ** 2 * np.sinc(side * q * np.sin(turn)) ** 2
    return float(side**2 * np.pi / 2 * (weights[:, None] * weights * q * transfer * square).sum())


def change_by_diffraction(camera: Camera, lens_type: LensType) -> float:
    """Bound on the change of a measurement of values from 0 to 255 by 550 nm diffraction at a type's aperture.

    The light that leaves a sensor pixel's footprint with diffraction, and without it by defocus.
    """
    from .field import MOST_RINGS, optics_of
    from .lens_matrix import row_by_rays, row_by_waves
    from .point_spread import point_spread

    lens, footprint = optics_of(camera, lens_type, GREEN), float(lens_type.ratio) * camera.target_pitch
    rays, wave = lens.outline(0.0), lens.lit_wave(0.0)
    edges, shape, sharp = (np.array([0.0, 1.0]),) * 2, (1, 1), (0.0, 0.0)
    kept = [row_by_rays(rays, footprint, edges, sharp, shape)] * 2
    if rays.spot_radius < MOST_RINGS * wave.resolution:
        spread = point_spread(wave)
        kept[0] = row_by_waves(spread.values, spread.cell / footprint, edges, sharp, shape)
    return WHITE * min(1.0, sum(1 - float(share[0, 0]) for share in kept))


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


def skipped_effects(scene: Scene, camera: Camera) -> tuple[SkippedEffect, ...]:
    """Return the effects skipped in rendering and recording, from the scene alone."""
    return (*_in_rendering(scene, camera), *_in_recording(scene, camera))


def assumptions(scene: Scene, camera: Camera) -> tuple[str, ...]:
    """Return what the error bars take for granted and no measurement is asked about, a sentence each."""
    taken: list[str] = []
    if camera.has_width and not camera.wavelengths:
        taken.append("light is rays, which lenses do not diffract: remove camera.wavelength = 'none' for 550 nm")
    if ignores_detail(scene, camera):
        remedy = "set target.detail, with a correlated or fitted prior, to include finer detail"
        if camera.has_detail:
            remedy = "a prior of independent pixels says nothing of finer detail; take a correlated or fitted one"
        taken.append(f"the world is made of f's pixels: {remedy}")
    return tuple(taken)


def ignores_detail(scene: Scene, camera: Camera) -> bool:
    """True if the error depends on detail finer than f of which the scene says nothing."""
    return not (camera.covers_whole_pixels or (camera.has_detail and scene.prior.kind != "independent"))


def _in_rendering(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    skipped: list[SkippedEffect] = []
    pinholes = [lens for lens in camera.types if lens.optics.aperture is None and lens.optics.surfaces is None]
    if pinholes:
        skipped.append(_without_aperture(camera, pinholes))
    if camera.has_width and not camera.wavelengths:
        skipped.append(_without_waves(camera))
    if camera.has_width and camera.walls:
        why = "walls between the sub-imagers keep it out (camera.walls)"
        skipped.append(SkippedEffect("light through neighbouring lenses", why))
    if scene.world is None:
        why = "there is nothing but the luminous target: paths have one segment"
        skipped.append(SkippedEffect("interreflection", why))
    if camera.detail > 1 and camera.covers_whole_pixels:
        skipped.append(SkippedEffect("detail", "every sensor pixel covers whole pixels of f"))
    return skipped + list(without_negligible_effects(scene, camera.world)[1])


def _without_aperture(camera: Camera, pinholes: list[LensType]) -> SkippedEffect:
    """The optics that pinholes lack, with what diffraction at apertures of the lens pitch would change."""
    numbers, widths, bounds = zip(*(_at_lens_pitch(camera, lens_type) for lens_type in pinholes), strict=True)
    which = "every lens is a pinhole" if len(pinholes) == len(camera.types) else "some lenses are pinholes"
    why = (
        f"{which} in focus: the most that lenses can achieve. Apertures of the lens pitch, f/{min(numbers):.2g}"
        f" to f/{max(numbers):.2g}, have Airy disks of {min(widths):.2g} to {max(widths):.2g} sensor pixels at 550 nm,"
        " and a light budget"
    )
    return SkippedEffect("aperture and diffraction", why, max(bounds))


def _at_lens_pitch(camera: Camera, lens_type: LensType) -> tuple[float, float, float]:
    """The f-number of an aperture of the lens pitch, its Airy disk in sensor pixels, and a bound on its effect."""
    number = camera.depth(lens_type) / camera.lens_pitch
    width = camera.airy_pixels(lens_type, camera.lens_pitch, GREEN)
    return number, width, WHITE * (1 - light_kept_in_focus(camera.pixel_pitch / (GREEN * number)))


def _without_waves(camera: Camera) -> SkippedEffect:
    """The diffraction that rays lack. Its bound is that of thin lenses; lenses with surfaces have none here."""
    why = "camera.wavelength is 'none': light is rays"
    bounds = [
        change_by_diffraction(camera, lens_type) for lens_type in camera.types if lens_type.optics.aperture is not None
    ]
    if any(lens_type.optics.surfaces is not None for lens_type in camera.types):
        why += ", also behind surfaces, where diffraction has no bound"
        bounds = [WHITE]
    return SkippedEffect("diffraction", why, max(bounds))


def _in_recording(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    if scene.sensor is not None:
        shot = negligible_shot_noise(scene, camera)
        return [] if shot is None else [shot]
    why = "the scene has no [noise] and no [sensor]"
    return [SkippedEffect("sensor noise and quantisation", why)] if scene.noise is None else []
