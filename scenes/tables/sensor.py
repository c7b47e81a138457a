"""The tables of the sensor in the scene file: [noise] of an ideal one, or [sensor] in the terms of EMVA 1288."""

from __future__ import annotations

from pydantic import Field, model_validator

from .table import LARGEST, Table
from .units import Illuminance, Time

FULL_SCALE = 256.0


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
    quantum_efficiency: float = Field(default=1.0, gt=0, le=1, description="electrons per photon")
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

    @property
    def full(self) -> float:
        """DN from which on a pixel is saturated: the least of the range of its bits, its full well and `saturation`."""
        largest = min(2.0**self.bits - 1, float(int(self.full_well * self.gain + self.black_level)))
        return largest if self.saturation is None else min(largest, float(self.saturation))
