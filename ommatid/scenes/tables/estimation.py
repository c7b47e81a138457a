"""The tables of the estimate in the scene file: [prior], [estimator], [tiles] and [study]."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from .table import LARGEST, Table
from .units import ExpectedNoise, Length, Memory, pair


class PriorTable(Table):
    """Mean and covariance of the image before any measurement."""

    kind: Literal["independent", "exponential", "power", "fit"] = Field(
        default="independent",
        description="correlation of pixels: none; exp(-distance / length); a power of frequency; fitted to the stack",
    )
    mean: float = Field(default=127.5, ge=-LARGEST, le=LARGEST)
    variance: float = Field(default=5461.25, gt=0, le=LARGEST**2, description="of every pixel; fitted by kind fit")
    correlation_length: Length | None = Field(
        default=None, description="length on the target, for kind exponential; fitted by kind fit"
    )
    exponent: float | None = Field(
        default=None, ge=0, le=8, description="a of a power spectrum 1/frequency^a, for kind power; absent: 2"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> PriorTable:
        if self.kind == "exponential" and self.correlation_length is None:
            raise ValueError('kind "exponential" needs a correlation_length, such as "10 mm"')
        if self.kind != "exponential" and self.correlation_length is not None:
            raise ValueError(f'correlation_length belongs to kind "exponential", got kind "{self.kind}"')
        if self.kind != "power" and self.exponent is not None:
            raise ValueError(f'exponent belongs to kind "power", got kind "{self.kind}"')
        return self


class EstimatorTable(Table):
    """Settings of the estimate of the image."""

    noise_variance: ExpectedNoise | None = Field(
        default=None,
        description='assumed noise variance; "fit": fitted to the stack; absent: all known noise',
    )
    prior_variance: float | None = Field(
        default=None,
        gt=0,
        le=LARGEST**2,
        description="assumed variance of every pixel, beside the actual prior.variance; absent: the same",
    )
    method: Literal[
        "auto",
        "covariance",
        "information",
        "square-root-information",
        "square-root-covariance",
        "svd",
        "dual",
        "tiles",
        "frame",
    ] = Field(
        default="auto",
        description="a dense form, tiles, or a whole frame; auto: the cheapest accurate one",
    )
    tolerance: float = Field(default=1e-8, gt=0, le=1, description="maximum relative error of a dense form")
    accuracy: float = Field(
        default=0.01, gt=0, le=1, description="largest numerical error of a frame, in posterior standard deviations"
    )
    misalignment: Literal["trust", "robust", "fit"] = Field(
        default="trust",
        description='camera.tolerance is "trust": ignored, "robust": treated as noise, "fit": fitted to the stack',
    )
    memory: Memory | None = Field(default=None, description='limit, such as "4 GB"; absent: half of the free memory')

    @model_validator(mode="after")
    def _check_prior_variance(self) -> EstimatorTable:
        if self.prior_variance is not None and self.misalignment != "trust":
            raise ValueError(
                f"prior_variance takes misalignment 'trust', got '{self.misalignment}', which needs the actual prior;"
                " remove one of the two keys"
            )
        return self


class StudyTable(Table):
    """One stack reconstructed several times, each time with another model H."""

    models: Annotated[
        tuple[Literal["ideal", "robust", "points", "transport", "fitted", "true"], ...],
        BeforeValidator(pair),
        Field(min_length=1),
    ] = Field(
        description="ideal: as designed; robust: that, and misalignment as more noise; points, transport: calibrated;"
        " fitted: to the stack; true: with the misalignment that was drawn"
    )


class TilesTable(Table):
    """Division of a frame that is reconstructed tile by tile."""

    size: int = Field(default=35, ge=4, le=200, description="rows and columns of a tile, in pixels of the target")
    overlap: int = Field(default=8, ge=0, description="border of a tile that is discarded for its neighbours' pixels")

    @model_validator(mode="after")
    def _check_core(self) -> TilesTable:
        if 2 * self.overlap >= self.size:
            raise ValueError(
                f"tiles.overlap {self.overlap} leaves nothing of tiles of {self.size}; expected below half"
            )
        return self
