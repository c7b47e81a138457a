"""The tables of light and sensor in the scene file.

[light], and [noise] of an ideal sensor, or [sensor] in the terms of EMVA 1288.
"""

from __future__ import annotations

import re
from itertools import pairwise
from math import degrees, pi
from typing import Annotated, cast

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from ommatid.runtime.errors import shortened_repr

from ..formats import curve
from .table import LARGEST, Table
from .units import LENGTH, Angle, Illuminance, Time, file_name

FULL_SCALE = 256.0
MILLIMETRE = 1e6  # nm
ILLUMINANTS = ("D65", "LED-B3")
INTERVAL = re.compile(r"\s*([0-9.]+)(?:\s*-\s*([0-9.]+))?\s*([^\W\d]+)\s*")
FILE = re.compile(r".+\.[A-Za-z]+\s*")
MOST_ANGLES = 100
_POINTS = {"type": "array", "items": {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}}
_CURVE = [{"type": "string"}, {**_POINTS, "minItems": 2}]


def _interval(text: str) -> tuple[float, float] | None:
    """Shortest and longest wavelength, mm, of a text such as "555 nm" or "450-650 nm"; None for another text."""
    match = INTERVAL.fullmatch(text)
    if match is None:
        return None
    first, last, unit = match.groups()
    shortest = LENGTH.read(f"{first} {unit}")
    longest = shortest if last is None else LENGTH.read(f"{last} {unit}")
    if last is not None and longest <= shortest:
        raise ValueError(f'expected the shorter wavelength first, as in "450-650 nm", got {shortened_repr(text)}')
    for end in (shortest, longest):
        if not curve.SHORTEST <= end * MILLIMETRE <= curve.LONGEST:
            raise ValueError(
                f"expected wavelengths from {curve.SHORTEST:g} to {curve.LONGEST:g} nm, got {shortened_repr(text)}"
            )
    return shortest, longest


def _spectrum(value: object) -> object:
    if not isinstance(value, str):
        if not isinstance(value, list | tuple):
            raise ValueError(f'expected a text such as "555 nm" or a curve, got {shortened_repr(value)}')
        return curve.checked(cast(object, value))
    if value in ILLUMINANTS or _interval(value) is not None:
        return value
    if FILE.fullmatch(value) is None:
        raise ValueError(
            f'expected "555 nm", "450-650 nm", {", ".join(f"{name!r}" for name in ILLUMINANTS)} or the name of a file,'
            f" got {shortened_repr(value)}"
        )
    return file_name(value)


def _efficiency(value: object) -> object:
    if isinstance(value, str):
        return file_name(value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        if not 0 < value <= 1:
            raise ValueError(f"expected a quantum efficiency above 0 and at most 1, got {value:g}")
        return float(value)
    if not isinstance(value, list | tuple):
        raise ValueError(f"expected a number, the name of a file or a curve, got {shortened_repr(value)}")
    return curve.checked(cast(object, value), 1.0)


def _rows(value: object) -> object:
    """Return the rows of a list as tuples."""
    if not isinstance(value, list | tuple):
        raise ValueError(
            f'expected rows of an angle above 0 and a share, [["15 deg", 0.9], ...], got {shortened_repr(value)}'
        )
    rows = cast(list[object], value)
    return tuple(tuple(cast(list[object], row)) if isinstance(row, list) else row for row in rows)


Acceptance = Annotated[
    tuple[tuple[Angle, Annotated[float, Field(gt=0, le=2)]], ...],
    Field(min_length=1, max_length=MOST_ANGLES),
    BeforeValidator(_rows),
]


class LightTable(Table):
    """The light that falls onto the target."""

    spectrum: Annotated[str | curve.Curve, BeforeValidator(_spectrum), WithJsonSchema({"anyOf": _CURVE})] = Field(
        description='"555 nm", "450-650 nm" (flat radiant power), "D65", "LED-B3", or a curve of wavelength and power'
    )

    @property
    def interval(self) -> tuple[float, float] | None:
        """Shortest and longest wavelength, mm, of a flat spectrum, equal for one wavelength; None for a curve."""
        return _interval(self.spectrum) if isinstance(self.spectrum, str) else None

    @property
    def file(self) -> str | None:
        """Name of the file that holds the spectrum, until it is read."""
        text = self.spectrum
        return text if isinstance(text, str) and text not in ILLUMINANTS and self.interval is None else None


class NoiseTable(Table):
    """Noise and range of an ideal sensor, which measures in units of f."""

    variance: float = Field(
        default=0.0,
        ge=0,
        le=LARGEST**2,
        description="variance of Gaussian noise, squared units of the target's values",
    )
    bits: int | None = Field(default=None, ge=1, le=24, description="bits of recorded values; absent: no quantisation")
    saturation: float | None = Field(
        default=None,
        ge=-LARGEST,
        le=LARGEST,
        description="largest recorded value; a saturated pixel counts as at least that; absent: no limit",
    )

    @property
    def level(self) -> float:
        """Quantisation step, full scale / 2^bits; 0 without quantisation."""
        return 0.0 if self.bits is None else FULL_SCALE / 2**self.bits

    @property
    def quantisation_variance(self) -> float:
        """Variance of rounding to levels, level^2 / 12 (Wood et al., section 5)."""
        return self.level**2 / 12


class SensorTable(Table):
    """A real sensor in the terms of EMVA 1288; electrons and digital numbers (DN) are counts."""

    illuminance: Illuminance = Field(
        description="of the target, whose pixels of value 255 reflect all light (Lambertian)"
    )
    exposure: Time = Field(description="exposure time")
    quantum_efficiency: Annotated[
        float | str | curve.Curve,
        BeforeValidator(_efficiency),
        WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0, "maximum": 1}, *_CURVE]}),
    ] = Field(default=1.0, description="electrons per photon: a number, or a curve of wavelength and value")
    full_well: float = Field(default=10000.0, gt=0, le=1e9, description="largest number of electrons in a pixel")
    dark_current: float = Field(default=0.0, ge=0, le=1e9, description="electrons per second without light")
    read_noise: float = Field(default=0.0, ge=0, le=1e6, description="standard deviation of a reading, in electrons")
    dsnu: float = Field(
        default=0.0,
        ge=0,
        le=1e6,
        description="deviation between dark signals of pixels, electrons (DSNU1288)",
    )
    prnu: float = Field(
        default=0.0, ge=0, lt=0.5, description="relative standard deviation between the responses of pixels (PRNU1288)"
    )
    acceptance: Acceptance | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="response against the angle of the chief ray, rows of angle and share, 1 at 0; absent: 1",
    )
    gain: float = Field(default=1.0, gt=0, le=1e6, description="DN per electron, the system gain K")
    black_level: float = Field(default=0.0, ge=0, le=1e6, description="DN without light")
    bits: int = Field(default=12, ge=1, le=24, description="of a digital number")
    saturation: int | None = Field(
        default=None, ge=1, le=2**24, description="DN at which a pixel is saturated; absent: the largest possible"
    )
    frames: int = Field(
        default=64, ge=2, le=2**20, description="number of dark frames, and of flat frames, that are averaged"
    )

    @model_validator(mode="after")
    def _check_range(self) -> SensorTable:
        if self.black_level >= self.full:
            raise ValueError(f"expected a black_level below saturation at {self.full:g} DN, got {self.black_level:g}")
        return self

    @model_validator(mode="after")
    def _check_acceptance(self) -> SensorTable:
        for (angle, _), (following, _) in pairwise(((0.0, 1.0), *(self.acceptance or ()))):
            if not angle < following < pi / 2:
                raise ValueError(
                    f"acceptance: expected angles that rise to less than 90 deg, got {degrees(following):.6g} deg after"
                    f" {degrees(angle):.6g} deg"
                )
        return self

    @property
    def full(self) -> float:
        """DN from which on a pixel is saturated: the least of the range of its bits, its full well and `saturation`."""
        largest = min(2.0**self.bits - 1, float(int(self.full_well * self.gain + self.black_level)))
        return largest if self.saturation is None else min(largest, float(self.saturation))
