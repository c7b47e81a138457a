"""Results of `ommatid bench` on disk: bench.json, which other commands read, and bench.csv, one row per cell.

A cell is one setting of one stage: its cost in seconds and memory, and the error of its result.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_text
from ommatid.runtime.input_files import read_record, real_path
from ommatid.runtime.study import write_rows

JSON, CSV = "bench.json", "bench.csv"
DENSE = "dense"  # one dense problem, which estimator.method = "auto" takes where it fits
AUTO = "auto"  # the setting of a cell with an adaptive number of samples: a single point, not part of a curve

Value = TypeVar("Value")
OrAbsent = Annotated[Value | None, Field(exclude_if=lambda value: value is None)]  # no value: no key in the file
Stage = Literal["render", "calibrate", "reconstruct"]
STAGES: tuple[Stage, ...] = get_args(Stage)


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class Setting(_Record):
    """A setting of a stage.

    way : the sampler, the method of calibration and its sampler, "dense", "tiles" or "frame"
    samples : per pixel, None for those of an adaptive setting before it is measured
    setting : the remaining parameters
    """

    stage: Stage
    way: str
    variant: str | None = None
    samples: int | None = None
    setting: str

    @property
    def name(self) -> str:
        """Readable name."""
        samples = f"{self.samples} samples" if self.samples is not None and self.counted else None
        return ", ".join(part for part in (f"{self.stage} {self.way}", self.variant, samples, self.setting) if part)

    @property
    def counted(self) -> bool:
        """True if the number of samples was fixed beforehand, so that the setting can be part of a curve."""
        return self.setting != AUTO

    @property
    def sampler(self) -> str:
        """The sampler, of a rendering or a calibration."""
        return self.way.split(", ")[-1]


class Cell(Setting):
    """Medians over repeats with independent seeds, with 10 % and 90 % quantiles as `_low` and `_high`.

    samples : of an adaptive cell the largest number at any pixel in any repeat
    error : root mean square over sensor pixels, over the entries of H, or over pixels of f, in `error_unit`
    memory : peak memory of the process in bytes, None where the system does not report it
    mse : mean squared error of the image with this setting, the scene's noise, and the other stages exact
    scatter : standard deviation of the natural logarithm of the error over repeats, None for a single repeat
    spent : seconds of all repeats and their errors, which only the journal of a bench keeps
    """

    repeats: int
    error: float
    error_low: float
    error_high: float
    error_unit: str
    seconds: float
    seconds_low: float
    seconds_high: float
    memory: int | None
    mse: float | None
    mse_low: float | None
    mse_high: float | None
    scatter: float | None = None
    spent: float = Field(0.0, exclude=True)


class ConvergenceCurve(_Record):
    """Convergence rate of one method: the slope d log error / d log samples.

    slope_deviation : standard error of the slope, from the scatter over seeds
    theory : theoretical slope, None where theory gives no number
    why : source of the theoretical slope, or the reason why there is none
    """

    stage: Stage
    way: str
    variant: str | None
    slope: float | None
    slope_deviation: float | None
    theory: float | None
    why: str

    @property
    def words(self) -> str:
        """The slope with its standard error and the theoretical one; empty where too few cells are known."""
        if self.slope is None or self.slope_deviation is None:
            return ""
        theory = "" if self.theory is None else f" (theory {self.theory:g})"
        return f"{self.slope:.3f} ± {self.slope_deviation:.3f}{theory}"


class Skipped(_Record):
    """A cell that was not measured, and the reason; `late` if the only reason is the time limit."""

    what: str
    why: str
    late: bool = False


class Recommendation(_Record):
    """The cells of the cheapest settings that reach the noise floor; absent from the file if there are none.

    noise_floor : mean squared error of the image with exact light and exact H
    mse : expected mean squared error of the recommended settings
    reached : True if that is within 10 % of the noise floor
    """

    noise_floor: float
    mse: float | None = None
    reached: bool = False
    why: str
    render: OrAbsent[Cell] = None
    calibrate: OrAbsent[Cell] = None
    reconstruct: OrAbsent[Cell] = None

    @property
    def cells(self) -> list[Cell]:
        """The cells, in the order of the stages; none if none are recommended."""
        return [cell for cell in (self.render, self.calibrate, self.reconstruct) if cell is not None]


class BenchTable(_Record):
    """Content of bench.json.

    fingerprint : of the measured scene
    against : description of the reference for renderings and calibrations
    noise_deviation : standard deviation of the sensor's noise, in pixel values of f
    budget : time limit in seconds;  seconds : duration of all measurements
    """

    title: str
    fingerprint: str
    camera: dict[str, Any]
    machine: dict[str, Any]
    versions: dict[str, str]
    against: str
    noise_deviation: float
    budget: float
    seconds: float
    cells: tuple[Cell, ...]
    curves: tuple[ConvergenceCurve, ...]
    recommended: Recommendation
    left_out: tuple[Skipped, ...]

    def of(self, stage: Stage) -> list[Cell]:
        """Return the cells of a stage."""
        return [cell for cell in self.cells if cell.stage == stage]

    def describe(self) -> dict[str, Any]:
        """Return the table in JSON's types."""
        return self.model_dump(mode="json")


def write(folder: Path, table: BenchTable) -> None:
    """Write bench.csv, then bench.json, whose presence means that both are complete.

    Raises InputError or MachineError.
    """
    write_rows(folder / CSV, [cell.model_dump() for cell in table.cells], Cell.model_fields)
    write_text(folder / JSON, json.dumps(table.describe(), indent=2, allow_nan=False) + "\n")


def read(path: Path) -> BenchTable:
    """Read bench.json. Raises InputError if the file is missing, truncated or not written by `ommatid bench`."""
    table: BenchTable = read_record(
        path, BenchTable, "the output of `ommatid bench`", "run `ommatid bench` again", strict=True
    )
    return table


def bench_tables(folder: Path, camera: Mapping[str, Any]) -> Iterator[BenchTable]:
    """Yield the valid bench tables of a camera that apply to a run: from the run's folder, then from its parent.

    camera : description of the camera, as `Camera.describe` returns it
    """
    same_camera = json.loads(json.dumps(camera))
    for path in (folder / JSON, real_path(folder).parent / JSON):
        try:
            table = read(path)
        except InputError:
            continue
        if table.camera == same_camera:
            yield table
