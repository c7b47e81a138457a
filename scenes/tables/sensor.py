"""What the scene file says of the sensor: what it adds to the light, and in which numbers it tells it."""

from __future__ import annotations

from pydantic import Field, model_validator

from .table import LARGEST, Table
from .units import Illuminance, Time

FULL_SCALE = 256.0


class NoiseTable(Table):
    """What the sensor adds to the light."""

    variance: float = Field(
        default=0.0, ge=0, le=LARGEST**2, description="Gaussian, in squared units of the target's values"
    )
    bits: int | None = Field(default=None, ge=1, le=24, description="of the recorded values; absent: no quantisation")
    saturation: float | None = Field(
        default=None,
        ge=-LARGEST,
        le=LARGEST,
        description="recorded values stop here; pixels that reach it are left out; absent: none does",
    )

    @property
    def level(self) -> float:
        """Height of a quantisation level, full scale / 2^bits; 0 without quantisation."""
        return 0.0 if self.bits is None else FULL_SCALE / 2**self.bits

    @property
    def quantisation_variance(self) -> float:
        """Variance that rounding to levels adds, level^2 / 12 (Wood et al., section 5)."""
        return self.level**2 / 12


class SensorTable(Table):
    """A real sensor in the terms of EMVA 1288; electrons and digital numbers (DN) are counts."""

    illuminance: Illuminance = Field(description="of the target, whose pixels of value 255 reflect all of it (Lambert)")
    exposure: Time = Field(description="time that light is collected")
    quantum_efficiency: float = Field(default=1.0, gt=0, le=1, description="electrons a photon")
    full_well: float = Field(default=10000.0, gt=0, le=1e9, description="electrons that a pixel holds at most")
    dark_current: float = Field(default=0.0, ge=0, le=1e9, description="electrons a second without light")
    read_noise: float = Field(default=0.0, ge=0, le=1e6, description="electrons, standard deviation of every reading")
    dsnu: float = Field(default=0.0, ge=0, le=1e6, description="electrons, dark signals from pixel to pixel (DSNU1288)")
    prnu: float = Field(default=0.0, ge=0, lt=0.5, description="relative, responses from pixel to pixel (PRNU1288)")
    gain: float = Field(default=1.0, gt=0, le=1e6, description="DN an electron, the system gain K")
    black_level: float = Field(default=0.0, ge=0, le=1e6, description="DN without light")
    bits: int = Field(default=12, ge=1, le=24, description="of a digital number")
    saturation: int | None = Field(
        default=None, ge=1, le=2**24, description="DN at which a pixel counts as full; absent: the largest there is"
    )
    frames: int = Field(default=64, ge=2, le=2**20, description="dark frames, and flat frames, that are averaged")

    @model_validator(mode="after")
    def _black_is_not_full(self) -> SensorTable:
        if self.black_level >= self.full:
            raise ValueError(f"black_level {self.black_level:g} leaves nothing, got saturation at {self.full:g} DN")
        return self

    @property
    def full(self) -> float:
        """DN from which on a pixel counts as full: what its bits hold, or its well, or what is said."""
        largest = min(2.0**self.bits - 1, float(int(self.full_well * self.gain + self.black_level)))
        return largest if self.saturation is None else min(largest, float(self.saturation))
