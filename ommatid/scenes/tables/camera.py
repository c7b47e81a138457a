"""The table [camera] of the scene file: pitches, lens types and tolerances."""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field, field_validator, model_validator

from ..geometry.quantities import FieldOfView, FNumber, SensorSize
from ..optics.dispersion import Dispersion
from .table import Table, allow_absent, at_most
from .units import (
    Angle,
    Corner,
    FileName,
    FillFactor,
    Length,
    Magnification,
    Pair,
    Radius,
    SignedAngle,
    Step,
    Window,
    counts,
    file_name,
    pair,
)

Distortion = Annotated[float, Field(ge=-1000, le=1000)]
RAYS = "none"  # wavelength of light that does not diffract
PIXEL_BLUR = 0.02, 2.0  # least and largest, in pixels
STEEPEST_TERM = 10.0  # sag at the rim over semi-diameter
LENS_NAME = r"^[A-Za-z0-9_-]+$"
MOST_TYPES, MOST_SUB_IMAGERS, MOST_SURFACES = 100, 1024, 200
SURFACES = at_most(MOST_SURFACES, "surfaces")


class Surface(Table):
    """One surface of a lens; surfaces are listed from the target to the sensor."""

    radius: Radius | None = Field(
        default=None, description="radius of curvature, positive if its centre lies towards the sensor; absent: flat"
    )
    thickness: Length | None = Field(default=None, description="distance to the next surface; absent for the last one")
    glass: str | None = Field(default=None, description="glass behind the surface, such as N-BK7; absent: air")
    index: float | None = Field(default=None, ge=1, le=5, description="refractive index, in place of a glass")
    dispersion: Dispersion | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="index of refraction of the glass as a function of the wavelength; absent: of a built-in glass",
    )
    semi_diameter: Length = Field(description="half the diameter of its clear aperture")
    conic: float = Field(default=0.0, ge=-100, le=100, description="0: a sphere, -1: a paraboloid")
    aspheric: Annotated[tuple[float, ...], BeforeValidator(pair), Field(min_length=1, max_length=7)] | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="a4, a6, ... to a16 of a sag a4 r^4 + a6 r^6 + ... beside the conic's, r and sag in mm",
    )
    stop: bool = Field(default=False, description="true for the aperture stop; for one surface only")

    @model_validator(mode="after")
    def _check_medium(self) -> Surface:
        if self.glass is not None and self.index is not None:
            raise ValueError("expected a glass or an index of refraction, got both")
        if self.dispersion is not None and self.index is not None:
            raise ValueError("expected a dispersion or an index of refraction, got both")
        return self

    @model_validator(mode="after")
    def _check_aspheric(self) -> Surface:
        for power, term in zip(range(4, 17, 2), self.aspheric or (), strict=False):
            if abs(term) * self.semi_diameter ** (power - 1) > STEEPEST_TERM:
                raise ValueError(
                    f"expected an aspheric term that adds at most {STEEPEST_TERM:g} semi-diameters at the rim,"
                    f" got a{power} = {term:g} mm^-{power - 1}; its unit is a power of mm"
                )
        return self


class ToleranceTable(Table):
    """Standard deviations of the misalignment of each sub-imager, which is drawn once per camera."""

    position: Length | None = Field(default=None, description="displacement of a lens in its plane, in x and in y")
    tilt: Angle | None = Field(default=None, description="tilt of a sub-imager's sensor patch, about x and about y")
    rotation: Angle | None = Field(default=None, description="rotation of a sub-imager's sensor patch, about the axis")
    focal_length: float | None = Field(
        default=None,
        gt=0,
        lt=0.2,
        description="relative, of the distance from lens to sensor, and so of the magnification",
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of the random draw: another seed is another camera")

    @property
    def displaces(self) -> bool:
        """True if lenses are displaced and nothing else is misaligned."""
        return not (self.tilt or self.rotation or self.focal_length)


class SubImagerTable(Table):
    """One sub-imager of an array that looks at a window of its own."""

    at: Corner = Field(description="row and column of the sub-imager in its array, from 0")
    window: Window | None = Field(
        default=None, description="row and column of the target where its view begins; absent: on the grid"
    )
    rotation: SignedAngle | None = Field(
        default=None, description="rotation of its sensor patch about the axis, clockwise in its view; absent: none"
    )


class LensTable(Table):
    """One lens type: an array of equal sub-imagers."""

    model_config = ConfigDict(json_schema_extra=allow_absent("magnification", "pixels"))

    name: str = Field(pattern=LENS_NAME)
    magnification: Magnification = Field(
        description="1 over the number of target pixels that a sensor pixel spans along an axis, at most 1"
    )
    focal_length: Length | None = Field(
        default=None, exclude=True, description="focal length; with the other distances it gives the magnification"
    )
    f_number: FNumber | None = Field(
        default=None, exclude=True, description="focal length over aperture, in place of the aperture"
    )
    field_of_view: FieldOfView | None = Field(
        default=None,
        exclude=True,
        description="angle that the width of a sub-image sees, or height and width, in place of pixels or focal_length",
    )
    array: Pair = Field(description="rows and columns of sub-imagers")
    pixels: Literal["fit"] | Pair = Field(description='rows and columns of a sub-image, or "fit"')
    step: Step = Field(
        default=(Fraction(1), Fraction(1)),
        description="pixels of the target between windows of neighbours, or two numbers: down and across",
    )
    aperture: Length | None = Field(default=None, description="diameter of a thin lens; absent: a pinhole")
    focus: Length | None = Field(default=None, description="distance of sharp focus; absent: the target's")
    distortion: Annotated[tuple[Distortion, Distortion], BeforeValidator(pair)] | None = Field(
        default=None, description="k1, k2: magnification times 1 + k1 r^2 + k2 r^4, r = 1 at the target's corner"
    )
    surfaces: Annotated[tuple[Surface, ...], SURFACES, Field(min_length=1)] | str | None = Field(
        default=None,
        description="surfaces of a real lens, from the target to the sensor, or the file with them",
    )
    scale: Literal["fit"] | Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        default=None,
        description='scale of the surfaces; "fit": to the focal length that the magnification requires',
    )

    coating: float | None = Field(
        default=None,
        ge=0,
        lt=1,
        description="reflectance of each surface to air; absent: uncoated, by Fresnel's equations",
    )
    fill_factor: FillFactor | None = Field(
        default=None,
        description="side of the open part of a sensor pixel over its pitch, or height and width; absent: the camera's",
    )
    sub_imager: (
        Annotated[tuple[SubImagerTable, ...], at_most(MOST_SUB_IMAGERS, "sub_imager tables"), Field(min_length=1)]
        | None
    ) = Field(
        default=None, description="sub-imagers with a window or an orientation of their own; absent: all on the grid"
    )

    @property
    def is_sliding(self) -> bool:
        """True if all its sensor pixels see the same, one pixel of f apart: m x m sub-imagers of magnification 1/m."""
        whole = self.array[0] == self.array[1] and self.magnification * self.array[0] == 1
        return whole and self.step == (1, 1) and self.sub_imager is None

    @field_validator("pixels", mode="before")
    @classmethod
    def _check_pixels(cls, value: object) -> object:
        return value if value == "fit" else counts(value, also=', or "fit"')

    @field_validator("surfaces")
    @classmethod
    def _check_file_name(cls, value: object) -> object:
        return file_name(value) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _check_sub_imagers(self) -> LensTable:
        named: set[tuple[int, int]] = set()
        for table in self.sub_imager or ():
            (k, l), (rows, columns) = table.at, self.array  # noqa: E741
            if k >= rows or l >= columns:
                raise ValueError(f"sub_imager at [{k}, {l}] is not in an array of {rows} x {columns}, counted from 0")
            if table.at in named:
                raise ValueError(f"expected each sub_imager once, got the one at [{k}, {l}] twice")
            if table.window is None and table.rotation is None:
                raise ValueError(f"sub_imager at [{k}, {l}] needs a window, a rotation or both, got neither")
            named.add(table.at)
        return self

    @model_validator(mode="after")
    def _check_kind_of_lens(self) -> LensTable:
        if self.surfaces is not None:
            for name in ("aperture", "distortion", "f_number"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} belongs to a thin lens, and surfaces imply it; remove one, got both")
            for name in ("focus", "focal_length"):
                if getattr(self, name) is not None and isinstance(self.scale, float | int):
                    raise ValueError(f'a number as scale fixes the focus; take scale "fit", got {name} too')
        else:
            for name in ("scale", "coating"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} belongs to surfaces, got none")
        if self.focus is not None and self.aperture is None and self.surfaces is None:
            raise ValueError("focus belongs to a lens with an aperture or surfaces, got a pinhole")
        return self


class CameraSensorTable(Table):
    """The outline of the sensor, which all sub-images must fit."""

    size: SensorSize = Field(description='height and width, or a format such as "1/2.3"')


class CameraTable(Table):
    """A flat sensor behind arrays of micro-lenses."""

    model_config = ConfigDict(json_schema_extra=allow_absent("pixel_pitch"))

    pixel_pitch: Length = Field(description="side of one sensor pixel")
    lens_pitch: Length = Field(description="distance between the centres of neighbouring lenses")
    wavelength: Literal["none"] | Length | None = Field(
        default=None,
        description='wavelength of the light, 550 nm if absent; "none": light is rays, which do not diffract',
    )
    walls: bool = Field(
        default=True, description="light of a lens reaches its own patch of the sensor only; false: those of all lenses"
    )
    common: Literal["lenses", "sensor"] = Field(
        default="lenses",
        exclude_if=lambda value: value == "lenses",
        description='what all types share: "lenses": their plane, with sensors of several depths; "sensor": one chip,'
        " before which each type stands at the height that keeps its magnification",
    )
    glass_catalogue: FileName | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="glass catalogue (AGF) with glasses of surfaces beside the built-in ones",
    )
    tolerance: ToleranceTable | None = Field(default=None, description="misalignment of the sub-imagers; absent: none")
    fill_factor: FillFactor = Field(
        default=(Fraction(1), Fraction(1)),
        exclude_if=lambda value: value == (1, 1),
        description="side of the open part of every sensor pixel, in its middle, over the pitch; or height and width",
    )
    fill_light: Literal["lost", "kept"] = Field(
        default="lost",
        exclude_if=lambda value: value == "lost",
        description='light beside the open parts; "kept": micro-lenses on the pixels gather the light of the whole',
    )
    binning: Literal["average", "sum"] = Field(
        default="average",
        exclude_if=lambda value: value == "average",
        description='what a pixel of magnification 1/m reads of its m x m pixels of f: the "average", or the "sum", of'
        " m x m pixels of a sensor whose charges are added before a reading's noise comes on top",
    )
    pixel_blur: Length | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="standard deviation, along an axis, by which charges diffuse across the sensor before a pixel"
        " collects them; absent: not at all",
    )
    sensor: CameraSensorTable | None = Field(
        default=None, description="outline of the sensor; absent: as large as needed"
    )
    lens: Annotated[tuple[LensTable, ...], at_most(MOST_TYPES, "lens types"), Field(min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> CameraTable:
        names = [lens.name for lens in self.lens]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"expected a different name for every lens type, got {name!r} twice")
        return self

    @model_validator(mode="after")
    def _check_pixel_blur(self) -> CameraTable:
        least, most = (factor * self.pixel_pitch for factor in PIXEL_BLUR)
        if self.pixel_blur is not None and not least <= self.pixel_blur <= most * (1 + 1e-9):
            raise ValueError(
                f"expected a pixel_blur from {1e3 * least:.3g} um to {1e3 * most:.3g} um, {PIXEL_BLUR[0]:g} to"
                f" {PIXEL_BLUR[1]:g} times the pixel_pitch, got {1e3 * self.pixel_blur:.3g} um; leave out a smaller one"
            )
        return self

    @model_validator(mode="after")
    def _check_walls(self) -> CameraTable:
        for lens in self.lens:
            if not self.walls and (lens.aperture is None or lens.distortion is not None):
                raise ValueError(
                    f"walls = false needs thin lenses with an aperture and without distortion, which weigh their light,"
                    f" got lens type '{lens.name}'; add an aperture or keep the walls"
                )
        if not self.walls and self.common == "sensor":
            raise ValueError(
                'walls = false needs all lenses in one plane, got common = "sensor"; remove one of the two keys'
            )
        return self

    @model_validator(mode="after")
    def _check_apertures(self) -> CameraTable:
        if sum(lens.array[0] * lens.array[1] for lens in self.lens) == 1:
            return self  # a single lens has no neighbour
        for lens in self.lens:
            if lens.aperture is not None and lens.aperture > self.lens_pitch * (1 + 1e-9):
                raise ValueError(
                    f"expected lens.{lens.name}.aperture of at most lens_pitch, {self.lens_pitch:g} mm, got"
                    f" {lens.aperture:g} mm; make the aperture smaller, or f_number or lens_pitch larger"
                )
        return self
