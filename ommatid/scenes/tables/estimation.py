"""The tables of computations in the scene file: [render] to [study], and [design]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, cast

from pydantic import BeforeValidator, Field, model_validator

from ..geometry.quantities import SensorSize
from .table import LARGEST, Table
from .units import AUTO, FillFactor, Length, Memory, Samples, Time, pair

Sampler = Literal["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
WITHOUT_NOISE = 256  # samples where there is no noise that "auto" could compare with
WITHDRAWN_FORMS = ("covariance", "information", "square-root-information", "square-root-covariance", "svd", "dual")
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


LEVEL = 64.0  # grey levels


class PriorTable(Table):
    """Mean and covariance of the image before any measurement."""

    kind: Literal["independent", "exponential", "power", "fit"] = Field(
        default="independent",
        description="correlation of pixels: none; exp(-distance / length); a power of frequency; fitted to the stack;"
        " absent: fitted in front of a camera with noise",
    )
    mean: float = Field(default=127.5, ge=-LARGEST, le=LARGEST)
    variance: float = Field(default=5461.25, gt=0, le=LARGEST**2, description="of every pixel; fitted by kind fit")
    level: Literal["known"] | Annotated[float, Field(gt=0, le=LARGEST)] | None = Field(
        default=None,
        description='standard deviation of the image\'s common level about `mean`; "known": none, as in the paper;'
        f" absent: {LEVEL:g}",
    )
    correlation_length: Length | None = Field(
        default=None, description="length on the target, for kind exponential; fitted by kind fit"
    )
    exponent: float | None = Field(
        default=None, ge=0, le=8, description="a of a power spectrum 1/frequency^a, for kind power; absent: 2"
    )

    @property
    def level_deviation(self) -> float:
        """Standard deviation of the image's common level about the mean, 0 where it is known."""
        return 0.0 if self.level == "known" else LEVEL if self.level is None else self.level

    @model_validator(mode="after")
    def _check_kind(self) -> PriorTable:
        if self.kind == "exponential" and self.correlation_length is None:
            raise ValueError('kind "exponential" needs a correlation_length, such as "10 mm"')
        if self.kind != "exponential" and self.correlation_length is not None:
            raise ValueError(f'correlation_length belongs to kind "exponential", got kind "{self.kind}"')
        if self.kind != "power" and self.exponent is not None:
            raise ValueError(f'exponent belongs to kind "power", got kind "{self.kind}"')
        return self


def _check_method(method: object) -> object:
    if method in WITHDRAWN_FORMS:
        raise ValueError(
            f"'{method}' is no longer a method: the solver chooses the algebraic form itself; take 'auto', which"
            " certifies its result, or remove the key"
        )
    return method


def _check_misalignment(misalignment: object) -> object:
    if misalignment == "robust":
        raise ValueError(
            "'robust' is withdrawn; take 'fit', which finds the misalignment in the stack itself, or 'trust' with a"
            " calibrated H"
        )
    return misalignment


class EstimatorTable(Table):
    """Settings of the estimate of the image."""

    noise_variance: Annotated[float, Field(ge=0, le=LARGEST**2)] | Literal["fit"] | None = Field(
        default=None,
        description='assumed noise variance; "fit": fitted to the stack; absent: all known noise',
    )
    prior_variance: float | None = Field(
        default=None,
        gt=0,
        le=LARGEST**2,
        description="assumed variance of every pixel, beside the actual prior.variance; absent: the same",
    )
    method: Annotated[Literal["auto", "tiles", "frame"], BeforeValidator(_check_method)] = Field(
        default="auto",
        description="tiles, or a whole frame; auto: one dense problem where it fits, else the cheapest accurate one",
    )
    tolerance: float = Field(default=1e-8, gt=0, le=1, description="maximum relative error of a dense problem")
    accuracy: float = Field(
        default=0.01, gt=0, le=1, description="largest numerical error of a frame, in posterior standard deviations"
    )
    misalignment: Annotated[Literal["trust", "fit"], BeforeValidator(_check_misalignment)] = Field(
        default="trust",
        description='misalignment within camera.tolerance is "trust": ignored, "fit": fitted to the stack',
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


StudyModel = Literal["ideal", "points", "transport", "fitted", "true"]


class StudyTable(Table):
    """One stack reconstructed several times, each time with another model H."""

    models: Annotated[
        tuple[StudyModel, ...],
        BeforeValidator(pair),
        Field(min_length=1),
    ] = Field(
        description="ideal: as designed; points, transport: calibrated; fitted: to the stack; true: with the"
        " misalignment that was drawn"
    )


class DesignTable(Table):
    """What `ommatid design` chooses a camera from, and for what: every magnification, aperture and fill factor."""

    goal: Literal["error", "information", "resolution"] = Field(
        default="error",
        description='"error": the least squared error; "information": most bits in the readings; "resolution": the'
        " least error of waves with a period below four pixels of f",
    )

    magnifications: str = Field(
        default="1/2,1/3,...,1/9",
        max_length=1000,
        description="of lens types; dots continue the step of the two 1/magnifications before them",
    )
    apertures: Annotated[tuple[Length, ...], BeforeValidator(pair)] = Field(
        default=(), max_length=20, description="diameters of the lenses; absent: that of the last lens type"
    )
    fill_factors: Annotated[tuple[FillFactor, ...], BeforeValidator(pair)] = Field(
        default=(), max_length=20, description="open parts of the pixels; absent: that of the last lens type"
    )
    readings: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description="readings per pixel of f, of all lens types together; absent: those of the camera",
    )
    sensor_area: SensorSize | None = Field(
        default=None,
        description='height and width of the sensor, or a format such as "1/2.3", in place of a number of readings;'
        " lenses stand as close as their apertures and patches allow",
    )
    thickness: Length | None = Field(
        default=None, description="largest distance from the lenses of a type to its sensor; absent: any"
    )
    bits: Annotated[tuple[Annotated[int, Field(ge=1, le=24)], ...], BeforeValidator(pair)] = Field(
        default=(), max_length=8, description="bits of recorded values, which are compared; absent: those of the scene"
    )
    error: float | None = Field(
        default=None, gt=0, description="squared error to be reached at the least cost; absent: the cost is given"
    )
    windows: int = Field(default=4, ge=1, le=100, description="windows to be placed, with --steer")
    window: Annotated[tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], BeforeValidator(pair)] = Field(
        default=(5, 5), description="rows and columns of sensor pixels of each of these windows"
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
