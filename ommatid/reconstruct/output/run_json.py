"""The content of run.json: its types, and the one function that writes it and the one that reads it.

The keys of the file are a contract, explained in docs/files.md. A key whose field was not set is absent from the file;
None is null. Readers ignore keys that they do not know.
"""

from __future__ import annotations

import json
from math import log10
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, computed_field, field_validator, model_validator

from ommatid.runtime.errors import InputError, named, shortened
from ommatid.runtime.files import write_text
from ommatid.runtime.input_files import read_record
from ommatid.scenes.formats.provenance import FitRecord
from ommatid.scenes.tables.estimation import StudyModel

from ..prior import SpectralTerm

INDEPENDENT = 1.0  # variance of independent samples falls as 1 / samples
STRATIFIED = 1.5  # that of all other samplers as samples^-1.5, for pinholes
MORE = (2, 4, 16)  # factors on the number of samples
FILES, PAGE = "files", "page"  # stages beside those that compute: reading, checking and writing files; report.html
STAGES = {"render": "rendering", "calibrate": "calibration"}  # to their parts of the error budget
RUN = "run.json"
EPS = 2.0**-52  # of float64

Amount = Annotated[float, Field(ge=0, le=1e100)]  # a squared error, or a time in seconds
Index = Annotated[int, Field(ge=0, lt=2**31)]
BaselineMethod = Literal["single", "rearranged", "shift_and_add", "total_variation"]


class Record(BaseModel):
    """A part of run.json; frozen, and built from keywords, from JSON or from an object with these attributes."""

    model_config = ConfigDict(frozen=True, from_attributes=True, allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """Return the fields that were set, in JSON's types."""
        return self.model_dump(mode="json", exclude_unset=True)


class StageReport(Record):
    """Method and settings of a stage, and its duration when it ran."""

    method: str | None = None
    seconds: Amount = 0.0
    samples: int | None = None
    fewest_samples: int | None = None
    passes: int | None = None
    sampler: str | None = None
    variant: str | None = None
    rays: int | None = None
    reached: bool | None = None
    not_reached: dict[str, str] = Field(default_factory=dict[str, str])
    auto: dict[str, Any] = Field(default_factory=dict[str, Any])


class IntervalReport(Record):
    """Expected mean squared error of this image, and the interval that holds it in 99 of 100 cases."""

    mse: Amount
    low: float
    high: Amount


class MethodReport(Record):
    """Error of a baseline against the truth, and its seconds, which `--baselines` measures.

    sub_imager : of the best single sub-image, enlarged to f's grid
    weight : of total variation, per grey level, the one of least error
    """

    method: BaselineMethod
    mse: Amount
    psnr: float | None
    ssim: float | None
    seconds: Amount | None = None
    sub_imager: str | None = None
    weight: float | None = None


class ErrorReport(Record):
    """Measured and predicted error; `budget` holds the parts of `predicted_mse` by cause.

    gain : dB of `psnr` over that of the best single sub-image, None if one of them is exact
    predicted_mse : for images of the prior;  expected_given_truth, expected_given_estimate : if the image is this one,
        the latter where the truth is not known
    """

    mse: Amount | None = None
    trimmed_mse: Amount | None = None
    psnr: float | None = None
    ssim: float | None = None
    gain: float | None = None
    predicted_mse: Amount
    predicted_trimmed_mse: Amount | None = None
    budget: dict[str, float]
    expected_given_truth: IntervalReport | None = None
    expected_given_estimate: Amount | None = None

    @model_validator(mode="after")
    def _check_parts(self) -> ErrorReport:
        if (self.predicted_mse > 0) != any(part > 0 for part in self.budget.values()):
            raise ValueError("expected parts above 0 in the budget of a predicted_mse above 0, and of no other")
        return self


class ResidualReport(Record):
    """Chi-squared of the residual g - H f^ of all measurements, its expectation and standard deviation.

    They are those of the verdict's first part.
    """

    chi_squared: float
    expected: Amount
    deviation: Amount


class ResidualPart(Record):
    """Chi-squared of the measurements of a part, its expectation and standard deviation.

    kind : "all", "lens type", "sub-imager" or "region"
    prior : expectation for images of the prior;  expected : the larger of that and of the true image's, if known
    p_value : probability of a larger value by chance
    """

    kind: str
    name: str
    measurements: int
    chi_squared: float
    prior: float
    expected: Amount
    deviation: Amount
    p_value: float

    @property
    def ratio(self) -> float:
        """Chi-squared over its expectation."""
        return self.chi_squared / self.expected if self.expected > 0 else float("inf")


class VerdictReport(Record):
    """Whether the error bars of a run can be trusted: reasons why not, checks that found nothing wrong, and notes.

    doubts : why the result is of little use although its error bars can be trusted
    p_value : of the residual in all and by part together, None if it was not checked
    """

    trusted: bool
    reasons: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    passed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    p_value: float | None = None
    parts: tuple[ResidualPart, ...] = ()

    @computed_field
    @property
    def level(self) -> Literal["green", "amber", "red"]:
        """Red for error bars that are not to be trusted, amber for doubts."""
        return "red" if not self.trusted else "amber" if self.doubts else "green"


class FittedNumber(Record):
    """A fitted value and the standard deviation of its logarithm."""

    value: float
    log_deviation: float


class DiagnosticsReport(Record):
    """Numbers that assess an estimate.

    fit_terms : density, exponent and length in millimetres of each term of the fitted spectrum

    noise_difference : largest relative difference of the noise variances from those of the frame whose error bars
        these are; absent where they were computed for this one
    """

    pixels_used: int
    pixels_dead: int
    pixels_saturated: int
    degrees_of_freedom: float
    resolution: float | None
    chi_squared: ResidualReport | None
    fit: dict[str, FittedNumber] = Field(default_factory=dict[str, FittedNumber])
    fit_terms: tuple[SpectralTerm, ...] = ()
    fit_measurements: int | None = None
    fit_doubtful: bool = False
    noise_difference: float | None = None


class ModelReport(Record):
    """Agreement of H with the ideal one, spurious information, and the fit of the geometry if there was one."""

    rms_difference_from_ideal: float | None
    max_z: float | None
    p_value: float | None
    spurious_information: float
    fit: FitRecord | None = None


class SkippedReport(Record):
    """An effect that was left out, the reason, and the largest change of a measurement that it would bring."""

    what: str
    why: str
    bound: float | None = None


class MoreTime(NamedTuple):
    """Seconds and expected error of `times` as many samples."""

    times: int
    seconds: float
    predicted_mse: float


class RequestedTime(Record):
    """Seconds that a number of scenes were given together."""

    seconds: Amount
    scenes: int


class TimeReport(Record):
    """Seconds beside those of the stages.

    start_up : from the start of the process to the first stage, where the process ran this scene alone
    within, asked, seconds, chosen : of --within: its share and the request, the time of all trials, and the samples
    """

    start_up: float | None = None
    within: float | None = None
    asked: RequestedTime | None = None
    seconds: Amount | None = None
    chosen: dict[str, int | Literal["auto"]] = Field(default_factory=dict[str, int | Literal["auto"]])


class SeedReport(Record):
    """Seed of the scene, and the first seeds of rendering and calibration; None where nothing was drawn."""

    scene: int | None
    data: int | None
    calibration: int | None


class RegionReport(Record):
    """Mean over a region of the estimate and its standard deviation (Eq. 5); corner and size are (row, column)."""

    corner: tuple[int, int]
    size: tuple[int, int]
    mean: float
    deviation: Amount


class DepthBin(Record):
    """Error of the pixels within a range of distances (mm); None where there is no surface."""

    nearest: float | None
    farthest: float | None
    pixels: int
    rms_error: float
    expected_deviation: float
    rms_disparity: float
    rms_disparity_by_type: dict[str, float]


class StudyCase(Record):
    """Mean squared errors with one model of H.

    predicted : Eq. 5;  expected : of this image, `low` and `high` holding it in 99 of 100 cases
    Measured and expected errors are None without the truth, the latter also where it is not known.
    """

    model: StudyModel
    mse: Amount | None
    predicted: Amount
    expected: Amount | None
    low: float | None
    high: Amount | None
    seconds: Amount


class RejectedForm(Record):
    """A form of the estimator that was given up, with the reason."""

    method: str
    why_not: str


class SolverReport(Record):
    """The method and form that ran, the reason for them, and their numerical error.

    way : the method, "" until it is chosen;  method : the form;  condition : None where it is infinite
    bound : on the error of the estimate, in `unit`; None if nothing was estimated
    variance_bound : on the relative error of posterior variances, from a sample of pixels
    tried : forms that were tried or skipped before, each with the reason
    """

    model_config = ConfigDict(allow_inf_nan=True)  # of forms that are given up

    way: str
    method: str
    why: str
    condition: float | None
    bound: float | None
    unit: str
    variance_bound: float
    refinements: int
    tried: tuple[RejectedForm, ...] = ()

    @computed_field
    @property
    def digits(self) -> float:
        """Correct decimal digits of the estimate according to the bound."""
        bound = self.variance_bound if self.bound is None else self.bound
        return -log10(max(bound, EPS)) if bound >= 0 else 0.0


class HeldOutVerdict(Record):
    """Whether the sub-imagers agree; None if none could be predicted from others."""

    trusted: bool | None
    reasons: tuple[str, ...]


class HeldOutPrior(Record):
    """The prior that predictions assumed, its length in millimetres, and whether it was fitted to the stack."""

    kind: str
    mean: float
    variance: float
    correlation_length: float | None
    fitted: bool


class HeldOutWindows(Record):
    """Number of the windows that were checked, and of those that cover the target."""

    checked: int
    total: int


class HeldOutEntry(Record):
    """A sub-imager predicted from all others; named ones are left out of the predictions of the others.

    chi_squared : of `pixels` whitened errors, `expected` is its expectation;  z : normal deviate of the same p_value
    rms_error, expected_rms : in grey levels, weighted by the precision of the prediction
    disagrees : before any was left out
    """

    name: str
    type: str
    k: Index
    l: Index  # noqa: E741  (the paper's letter)
    pixels: int
    chi_squared: float
    expected: float
    z: float | None
    p_value: float | None
    rms_error: float | None
    expected_rms: float | None
    disagrees: bool
    named: bool


class HeldOutReport(Record):
    """Every sub-imager predicted from all others.

    p_value : of the largest deviation (Sidak), before any sub-imager was left out; None if none can be predicted
    explained : True if the others agree once the named sub-imagers are left out
    """

    verdict: HeldOutVerdict
    p_value: float | None
    explained: bool
    prior: HeldOutPrior
    windows: HeldOutWindows
    sub_imagers: tuple[HeldOutEntry, ...]

    def __repr__(self) -> str:
        """Return the numbers of sub-imagers in one line."""
        disagreeing = named(entry.name for entry in self.sub_imagers if entry.named)
        return f"<HeldOutReport: {self.judged} sub-imagers predicted, disagreeing: {disagreeing}>"

    __str__ = __repr__

    @property
    def judged(self) -> int:
        """Number of sub-imagers that were predicted."""
        return sum(entry.pixels > 0 for entry in self.sub_imagers)

    def worst(self) -> list[HeldOutEntry]:
        """Return the predicted sub-imagers: those named first, then by z, the largest first."""
        judged = [entry for entry in self.sub_imagers if entry.z is not None]
        return sorted(judged, key=lambda entry: (not entry.named, -(entry.z or 0.0)))


class RunReport(Record):
    """Everything that run.json holds.

    command : words of the command line, absent for results of the Python interface
    date : UTC, ISO 8601;  host : name of the machine that reconstructed
    """

    fingerprint: str = ""
    title: str
    command: tuple[str, ...] = ()
    date: str | None = None
    host: str | None = None
    verdict: VerdictReport
    measurements: int
    unknowns: int
    stages: dict[str, StageReport]
    error: ErrorReport
    solver: SolverReport
    diagnostics: DiagnosticsReport
    model: ModelReport
    skipped: tuple[SkippedReport, ...]
    assumes: tuple[str, ...] = ()
    versions: dict[str, str]
    seeds: SeedReport
    spent: TimeReport = TimeReport()
    held_out: HeldOutReport | None = None
    regions: tuple[RegionReport, ...] = ()
    depth: tuple[DepthBin, ...] = ()
    study: tuple[StudyCase, ...] = ()
    baselines: tuple[MethodReport, ...] = ()

    def __repr__(self) -> str:
        """Return title, size and error in one line."""
        error = f"expected error {self.error.predicted_mse**0.5:.3g} rms"
        return f"<RunReport '{shortened(self.title)}': {self.unknowns} pixels, {error}>"

    __str__ = __repr__

    @field_validator("stages")
    @classmethod
    def _complete(cls, stages: dict[str, StageReport]) -> dict[str, StageReport]:
        missing = [name for name in ("render", "calibrate", "reconstruct") if name not in stages]
        if missing:
            raise ValueError(f"expected the stage {missing[0]}")
        return stages

    def with_changes(self, **fields: object) -> RunReport:
        """Return a copy with some fields replaced."""
        return self.model_copy(update=fields)

    def with_stage(self, name: str, seconds: float) -> RunReport:
        """Return a copy with the time of one more stage."""
        return self.with_changes(stages={**self.stages, name: StageReport(seconds=seconds)})

    def with_times(self, files: float, start_up: float | None) -> RunReport:
        """Return a copy with the seconds for reading, checking and writing files, and those before the first stage.

        start_up : None where the process ran other scenes, too
        """
        known = {} if start_up is None else {"start_up": start_up}
        return self.with_stage(FILES, files).with_changes(spent=self.spent.model_copy(update=known))

    def of_stages(self) -> RunReport:
        """Return a copy without the times of what surrounds the stages."""
        spent = self.spent.plain()
        spent.pop("start_up", None)
        return self.with_changes(stages=self._computing, spent=TimeReport.model_validate(spent))

    @property
    def single(self) -> MethodReport | None:
        """The best single sub-image among the baselines, None where the truth is not known."""
        return next((each for each in self.baselines if each.method == "single"), None)

    @property
    def seconds(self) -> float:
        """Seconds of all stages."""
        return sum(stage.seconds for stage in self.stages.values())

    @property
    def noise_alone(self) -> float:
        """Expected error without noise of rendering and calibration."""
        return max(self.error.predicted_mse - sum(self.error.budget.get(part, 0.0) for part in STAGES.values()), 0.0)

    @property
    def more_samples(self) -> tuple[MoreTime, ...]:
        """What more samples would cost and bring; nothing for recorded frames.

        Errors with more samples are those of the estimator as it is. An estimator that expects the smaller noise does
        better, most of all where much of its error is in components that the lens types hardly measure.
        """
        render, calibrate = self.stages["render"], self.stages["calibrate"]
        if render.sampler is None:
            return ()
        parts = sum(self.error.budget.get(part, 0.0) for part in STAGES.values())
        total = sum(stage.seconds for stage in self._computing.values())
        growing = render.seconds + (calibrate.seconds if calibrate.method != "ideal" else 0.0)
        return tuple(
            MoreTime(times, total + (times - 1) * growing, self.noise_alone + parts * times**-self.fall)
            for times in MORE
        )

    @property
    def fall(self) -> float:
        """The exponent with which the parts of rendering and calibration fall with their samples."""
        return INDEPENDENT if self.stages["render"].sampler == "independent" else STRATIFIED

    @property
    def _computing(self) -> dict[str, StageReport]:
        return {name: stage for name, stage in self.stages.items() if name not in (FILES, PAGE)}


def write(folder: Path, report: RunReport) -> None:
    """Write run.json of a folder."""
    write_text(folder / RUN, json.dumps(report.plain(), indent=2, allow_nan=False) + "\n")


def read(folder: Path) -> RunReport:
    """Read run.json of a folder. Raises InputError where there is none, or where a key is missing or wrong."""
    path = folder / RUN
    report: RunReport = read_record(path, RunReport, "the results of a run", "run the scene again")
    if not report.fingerprint:
        raise InputError(f"{path}: expected the results of a run, got a file without fingerprint; run the scene again")
    return report
