"""A camera in the terms of optics: magnification, f-number, field of view, Airy disk, and the area of its sensor.

Lengths are millimetres. Fields of view are in degrees, because they are only printed. A lens of focal length f, in
focus at the distance F, has its sensor at depth d behind it, 1/f = 1/F + 1/d, and images a target at distance Z with
the optical magnification d / Z. An aperture D is the f-number N = f / D, works at the sensor at d / D = N (1 + d / F),
and has an Airy disk of diameter 2.44 wavelength d / D.

Warnings name the effects that matter and are left out, and quantities that no camera has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from math import atan, degrees, sqrt
from typing import Any

from ommatid.runtime.arrays import FloatArray

from ..camera import Camera
from ..constants import GREEN, WHITE
from ..layout import sensor_extent
from ..lens_type import LensType
from ..scene import Scene


@dataclass(frozen=True)
class LensTerms:
    """One lens type in the terms of optics.

    grid_magnification : 1 over the pixels of f that a sensor pixel spans;  magnification : image size over object size
    aperture, f_number, airy_diameter : None for a pinhole, and for a lens of surfaces, whose pupil is traced elsewhere
    field_of_view : degrees from edge to edge of a sub-image, along its rows' direction (height) and across (width)
    airy_diameter : of the first dark ring, in sensor pixels, at `OpticalTerms.wavelength`
    total_track : from the plane of the lens to the sensor
    sub_image : height and width of a sub-image on the sensor
    """

    name: str
    grid_magnification: Fraction
    magnification: float
    focal_length: float
    aperture: float | None
    f_number: float | None
    field_of_view: tuple[float, float]
    airy_diameter: float | None
    total_track: float
    sub_image: tuple[float, float]
    lenses: int

    def describe(self) -> dict[str, Any]:
        """The terms in JSON's types, without the lens type's name and array."""
        return {
            "optical_magnification": self.magnification,
            "focal_length": self.focal_length,
            "f_number": self.f_number,
            "field_of_view": list(self.field_of_view),
            "airy_pixels": self.airy_diameter,
            "total_track": self.total_track,
        }


@dataclass(frozen=True)
class OpticalTerms:
    """A camera in the terms of optics.

    wavelength : of the Airy disks: the mean of the light's, 550 nm if the scene names none
    lenses : number of sub-imagers of all types;  total_track : of the longest lens type
    sensor_extent : height and width of the smallest upright rectangle that holds all sub-images
    sensor_area : of all recorded pixels, mm^2
    sensor_size : rows and columns direction of the sensor, mm;  sensor_share : sensor_area over its area;
        both None if the scene gives no size
    """

    types: tuple[LensTerms, ...]
    wavelength: float
    lenses: int
    total_track: float
    sensor_extent: tuple[float, float]
    sensor_area: float
    sensor_size: tuple[float, float] | None = None
    sensor_share: float | None = None

    def describe(self) -> dict[str, Any]:
        """The terms of the camera in JSON's types, without those of single lens types."""
        size = None if self.sensor_size is None else list(self.sensor_size)
        return {
            "lenses": self.lenses,
            "wavelength": self.wavelength,
            "total_track": self.total_track,
            "sensor_extent": list(self.sensor_extent),
            "sensor_area": self.sensor_area,
            "sensor_size": size,
            "sensor_share": self.sensor_share,
        }


@dataclass(frozen=True)
class ThroughFocus:
    """Contrast of a lens type at half the sensor's Nyquist frequency against the place of the sensor.

    shifts : (n,) of the sensor away from the lens, mm
    axis, rim : (n,) contrast on the lens's axis and at the sensor point farthest from it, of the worse direction
    """

    name: str
    shifts: FloatArray
    axis: FloatArray
    rim: FloatArray


def optical_terms(scene: Scene, camera: Camera) -> OpticalTerms:
    """Return the camera of a scene in the terms of optics."""
    wavelength = camera.wavelength or GREEN
    types = tuple(_lens_terms(camera, lens_type, wavelength) for lens_type in camera.types)
    area = camera.measurements * camera.pixel_pitch**2
    size = None if scene.camera.sensor is None else scene.camera.sensor.size
    return OpticalTerms(
        types=types,
        wavelength=wavelength,
        lenses=sum(lens.lenses for lens in types),
        total_track=max(lens.total_track for lens in types),
        sensor_extent=sensor_extent(camera.sub_imagers, camera.pixel_pitch),
        sensor_area=area,
        sensor_size=size,
        sensor_share=None if size is None else area / (size[0] * size[1]),
    )


def _lens_terms(camera: Camera, lens_type: LensType, wavelength: float) -> LensTerms:
    depth, focal_length = camera.depth(lens_type), camera.focal_length(lens_type)
    aperture = lens_type.optics.aperture
    height, width = (count * camera.pixel_pitch for count in lens_type.pixels)
    return LensTerms(
        name=lens_type.name,
        grid_magnification=1 / lens_type.ratio,
        magnification=camera.optical_magnification(lens_type),
        focal_length=focal_length,
        aperture=aperture,
        f_number=None if aperture is None else focal_length / aperture,
        field_of_view=(degrees(2 * atan(height / 2 / depth)), degrees(2 * atan(width / 2 / depth))),
        airy_diameter=None if aperture is None else camera.airy_pixels(lens_type, aperture, wavelength),
        total_track=depth,
        sub_image=(height, width),
        lenses=lens_type.count,
    )


LEAST_DITHER = 0.24  # quantisation steps of noise in the dark (EMVA 1288, release 4.0)
WIDEST = 1.0  # sensor pixels, of an Airy disk that may be left out
FASTEST = 0.5  # f-number of a sharp lens in air: 1 / (2 sin(angle)) of a cone of 90 degrees to the axis (Abbe)
FULL_WELL = 10000  # electrons of a common pixel, the default of [sensor]
WIDEST_VIEW = 120.0  # degrees: beyond, the cos^4 law leaves less than 1/16 of the light at the edge


def camera_warnings(scene: Scene, camera: Camera, terms: OpticalTerms) -> list[str]:
    """Return one sentence per warning, which names the keys to change."""
    return [*_without_noise(scene), *_coarse_steps(scene), *_left_out(camera, terms), *_absurd(camera, terms)]


def _without_noise(scene: Scene) -> list[str]:
    """The least noise that a sensor has is that of its electrons: the root of their number."""
    if scene.noise is not None or scene.sensor is not None:
        return []
    return [
        "sensor noise is not modelled: add [noise] or [sensor]; photons alone bring a deviation of"
        f" {WHITE / sqrt(FULL_WELL):.3g} of {WHITE:g} to a pixel of {FULL_WELL} electrons"
    ]


def _coarse_steps(scene: Scene) -> list[str]:
    """Rounding is no independent noise where the noise in the dark is below LEAST_DITHER steps."""
    sensor, noise = scene.sensor, scene.noise
    if sensor is not None:
        steps, cure = sensor.gain * (sensor.read_noise**2 + sensor.dark_current * sensor.exposure) ** 0.5, "sensor.gain"
    elif noise is not None and noise.level > 0:
        steps, cure = noise.variance**0.5 / noise.level, "noise.bits"
    else:
        return []
    if steps >= LEAST_DITHER:
        return []
    return [
        f"the noise in the dark is {steps:.2g} times the quantisation step, where EMVA 1288 asks for {LEAST_DITHER:g}:"
        f" smooth dark parts are rounded alike, and their mean may be off by up to half a step; raise {cure}"
    ]


def _left_out(camera: Camera, terms: OpticalTerms) -> list[str]:
    warnings: list[str] = []
    thin = [lens for lens in terms.types if lens.airy_diameter is not None]
    if not camera.wavelengths and thin:
        wide = [lens for lens in thin if (lens.airy_diameter or 0) > WIDEST]
        if wide:
            disks = _each(wide, lambda lens: f"{lens.airy_diameter:.2g}")
            warnings.append(
                f"diffraction is not modelled: set camera.wavelength; the Airy disk of {disks} sensor pixels wide at"
                f" {terms.wavelength * 1e6:.4g} nm"
            )
    if terms.lenses > 1:  # a single lens may be wider than the pitch
        warnings += _pinholes(camera, terms)
    return warnings


def _pinholes(camera: Camera, terms: OpticalTerms) -> list[str]:
    narrowest = {lens_type.name: camera.airy_pixels(lens_type, camera.lens_pitch, GREEN) for lens_type in camera.types}
    pinholes = [lens for lens, kind in zip(terms.types, camera.types, strict=True) if not kind.optics.has_width]
    wide = [lens for lens in pinholes if narrowest[lens.name] > WIDEST]
    if not wide:
        return []
    disks = _each(wide, lambda lens: f"{narrowest[lens.name]:.2g}")
    return [
        f"diffraction is not modelled: set camera.lens.{wide[0].name}.aperture or f_number; even behind an aperture of"
        f" the lens pitch, the Airy disk of {disks} sensor pixels wide at 550 nm"
    ]


def _absurd(camera: Camera, terms: OpticalTerms) -> list[str]:
    warnings: list[str] = []
    for lens in terms.types:
        name = f"lens type {lens.name}"
        if lens.f_number is not None and lens.f_number < FASTEST:
            warnings.append(f"{name} is f/{lens.f_number:.2g}: no lens in air is faster than f/0.5; make it narrower")
        if lens.airy_diameter is not None and lens.airy_diameter * camera.pixel_pitch > min(lens.sub_image):
            warnings.append(
                f"the Airy disk of {name} is {lens.airy_diameter:.3g} sensor pixels wide, wider than its sub-image;"
                " make its aperture wider"
            )
        if lens.magnification > 1:
            warnings.append(
                f"{name} enlarges the target {lens.magnification:.3g} times, with the sensor behind it farther away"
                " than the target; check target.pixel_pitch and camera.pixel_pitch"
            )
        if max(lens.field_of_view) > WIDEST_VIEW:
            warnings.append(
                f"{name} has a field of view of {max(lens.field_of_view):.0f} degrees, where a flat sensor gets less"
                " than 1/16 of the light at the edge; make target.distance longer or the sub-images smaller"
            )
    if camera.pixel_pitch < terms.wavelength / 2:
        warnings.append(
            f"camera.pixel_pitch is {camera.pixel_pitch * 1e3:.3g} um, less than half of the wavelength,"
            f" {terms.wavelength * 1e6:.4g} nm: no image has such detail"
        )
    return warnings


def _each(lenses: list[LensTerms], number: Callable[[LensTerms], str]) -> str:
    """Lens types with a number each, as the subject of a sentence and its verb: "lens I is 3.5, of lens II 2.1"."""
    first, *others = lenses
    return ", ".join([f"lens {first.name} is {number(first)}", *(f"of lens {x.name} {number(x)}" for x in others)])
