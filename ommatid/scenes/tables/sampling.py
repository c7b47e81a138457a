"""The tables [render] and [calibration] of the scene file: samples, seeds, backends and methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, cast

from pydantic import Field, model_validator

from .table import Table
from .units import AUTO, Samples, Time

Sampler = Literal["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
WITHOUT_NOISE = 256  # samples where there is no noise that "auto" could compare with
IN_PLACE_OF_AUTO = 1024  # samples of what has no adaptive number of them, where render.samples is "auto"


class RenderTable(Table):
    """Settings of the rendering of the sub-images."""

    samples: Samples = Field(
        default=AUTO,
        description='rays per sensor pixel, in 16 passes or more; "auto": until their variance is 0.1 of the sensor\'s;'
        f" absent from a scene without noise: {WITHOUT_NOISE}",
    )
    time: Time | None = Field(
        default=None, description='time limit of samples = "auto", at whatever variance; absent: no limit'
    )
    seed: int = Field(default=0, ge=0, lt=2**63)
    variant: Literal["auto", "scalar_rgb", "llvm_ad_mono", "cuda_ad_mono"] = "auto"
    sampler: Sampler = Field(
        default="multijitter", description="how rays are distributed; stratified ones round samples up to a valid count"
    )
    complete: bool = Field(default=False, description="simulate every effect, however small")

    @property
    def sample_count(self) -> int:
        """Number of samples for computations that need it in advance."""
        return IN_PLACE_OF_AUTO if self.samples == "auto" else self.samples

    @model_validator(mode="after")
    def _check_time(self) -> RenderTable:
        if self.time is not None and self.samples != "auto":
            raise ValueError(f'time ends samples = "auto", got samples = {self.samples}; remove one of the two keys')
        return self


class CalibrationTable(Table):
    """Settings of the calibration, which determines the observation matrix H."""

    method: Literal["points", "transport", "ideal"] = "points"
    samples: Samples = Field(
        default=AUTO,
        description='rays per sensor pixel, in 16 passes or more; "auto": until H adds less than 10 % to the error;'
        f" absent from a scene without noise: {WITHOUT_NOISE}",
    )
    fit: Literal["auto", "geometry", "none"] | None = Field(
        default=None,
        description='"auto": H by few numbers where they explain it; "geometry": by views alone; "none": entries',
    )

    @property
    def sample_count(self) -> int:
        """Number of samples. Raises ValueError for "auto"."""
        if self.samples == "auto":
            raise ValueError("expected a number of samples, got 'auto'")
        return self.samples

    @model_validator(mode="after")
    def _check_fit(self) -> CalibrationTable:
        if self.fit in ("auto", "geometry") and self.method == "ideal":
            raise ValueError("fit belongs to a calibrated H, got method 'ideal'; take 'points' or 'transport'")
        return self


def with_samples_without_noise(data: object) -> object:
    """Return a scene's raw data with a stated number of samples where no noise tells how many are needed."""
    if not isinstance(data, dict) or adds_noise(cast(dict[str, object], data)):
        return cast(object, data)
    tables = dict(cast(dict[str, object], data))
    for name in ("render", "calibration"):
        table = tables.get(name, {})
        if isinstance(table, dict) and "samples" not in table:
            tables[name] = {"samples": WITHOUT_NOISE} | cast(dict[str, object], table)
    return tables


def adds_noise(tables: Mapping[str, object]) -> bool:
    """Return True if the sensor of a scene's raw tables adds noise."""
    noise = tables.get("noise")
    if not isinstance(noise, dict):
        return "sensor" in tables
    noise = cast(dict[str, object], noise)
    return bool(noise.get("variance")) or "bits" in noise
