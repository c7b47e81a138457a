"""A camera in the terms of optics: magnification, f-number, field of view, Airy disk, and the area of its sensor.

Lengths are millimetres. Fields of view are in degrees, because they are only printed. A lens of focal length f, in
focus at the distance F, has its sensor at depth d behind it, 1/f = 1/F + 1/d, and images a target at distance Z with
the optical magnification d / Z. An aperture D is the f-number N = f / D, works at the sensor at d / D = N (1 + d / F),
and has an Airy disk of diameter 2.44 wavelength d / D.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import atan, degrees
from typing import Any

from ..camera import Camera
from ..constants import AIRY_FIRST_ZERO, GREEN
from ..layout.sensor_extent import sensor_extent
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
    airy = None if aperture is None else 2 * AIRY_FIRST_ZERO * wavelength * depth / aperture / camera.pixel_pitch
    return LensTerms(
        name=lens_type.name,
        grid_magnification=1 / lens_type.ratio,
        magnification=depth / camera.distance,
        focal_length=focal_length,
        aperture=aperture,
        f_number=None if aperture is None else focal_length / aperture,
        field_of_view=(degrees(2 * atan(height / 2 / depth)), degrees(2 * atan(width / 2 / depth))),
        airy_diameter=airy,
        total_track=depth,
        sub_image=(height, width),
        lenses=lens_type.count,
    )
