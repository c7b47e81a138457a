"""Results of `ommatid bench` on disk: bench.json, which other commands read, and bench.csv, one row per cell.

A cell is one setting of one stage: its cost in seconds and memory, and the error of its result. The unit of the error
depends on the stage: `render`, root mean square over sensor pixels in pixel values of f; `calibrate`, over the entries
of H; `reconstruct`, over the pixels of f in units of each pixel's posterior standard deviation.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_csv, write_text
from ommatid.runtime.input_files import read_record, real_path

JSON, CSV = "bench.json", "bench.csv"
DENSE = "dense"  # one dense problem, which estimator.method = "auto" takes where it fits
AUTO = "auto"  # the setting of a cell with an adaptive number of samples: a single point, not part of a curve
QUANTILES = 0.1, 0.5, 0.9

Value = TypeVar("Value")
OrAbsent = Annotated[Value | None, Field(exclude_if=lambda value: value is None)]  # no value: no key in the file
Stage = Literal["render", "calibrate", "reconstruct"]
STAGES: tuple[Stage, ...] = get_args(Stage)
UNITS: dict[Stage, str] = {
    "render": "values of f",
    "calibrate": "entries of H",
    "reconstruct": "posterior standard deviations",
}


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class Quantiles(_Record):
    """Median, 10 % and 90 % quantile over repeats with independent seeds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Quantiles:
        """Return the quantiles of at least one value, interpolated linearly between values."""
        low, median, high = np.quantile(values, QUANTILES).tolist()
        return cls(median=median, low=low, high=high)


class Cell(_Record):
    """Measurements of one setting of a stage.

    way : the sampler, the method of calibration and its sampler, "dense", "tiles" or "frame"
    samples : per pixel; of an adaptive cell the largest number at any pixel in any repeat
    setting : the remaining parameters
    scatter : standard deviation of the natural logarithm of the error over repeats, None for a single repeat
    memory : peak memory of the process in bytes, None where the system does not report it
    mse : mean squared error of the image with this setting, the scene's noise, and the other stages exact
    """

    stage: Stage
    way: str
    variant: str | None
    samples: int | None
    setting: str
    repeats: int
    error: Quantiles
    seconds: Quantiles
    memory: int | None
    mse: Quantiles | None
    scatter: float | None = None

    @property
    def counted(self) -> bool:
        """True if the number of samples was fixed beforehand, so that the cell can be part of a curve."""
        return self.setting != AUTO


class ConvergenceCurve(_Record):
    """Convergence rate of one method: the slope d log error / d log samples.

    slope_deviation : standard error of the slope, from the scatter over seeds
    theory : theoretical slope, None where theory gives no number
    why : source of the theoretical slope, or the reason why there is none
    agrees : True if the slope is within 3 standard errors of theory, plus what an asymptotic theory leaves open at the
        numbers of samples of the fit, as `why` states
    """

    stage: Stage
    way: str
    variant: str | None
    slope: float | None
    slope_deviation: float | None
    theory: float | None
    why: str
    agrees: bool | None


class SkippedJob(_Record):
    """A cell that was not measured, and the reason; `late` if the only reason is the time limit."""

    what: str
    why: str
    late: bool = False


class RecommendedSetting(_Record):
    """Recommended setting of one stage; keys that do not apply to the stage are absent from the file."""

    seconds: float
    method: OrAbsent[str] = None
    setting: OrAbsent[str] = None
    sampler: OrAbsent[str] = None
    variant: OrAbsent[str] = None
    samples: OrAbsent[int | Literal["auto"]] = None


class Recommendation(_Record):
    """Cheapest settings that reach the noise floor; the stages are absent from the file if none was found.

    noise_floor : mean squared error of the image with exact light and exact H
    mse : expected mean squared error of the recommended settings
    reached : True if that is within 10 % of the noise floor
    """

    noise_floor: float
    mse: float | None
    reached: bool
    why: str
    render: OrAbsent[RecommendedSetting] = None
    calibrate: OrAbsent[RecommendedSetting] = None
    reconstruct: OrAbsent[RecommendedSetting] = None

    def of(self, stage: Stage) -> RecommendedSetting | None:
        """Return the recommended setting of a stage, None if there is none."""
        return {"render": self.render, "calibrate": self.calibrate, "reconstruct": self.reconstruct}[stage]


class BenchTable(_Record):
    """Content of bench.json.

    scene : fingerprint of the measured scene;  fingerprint : that of the scene and of the versions of the libraries
    against : description of the reference for renderings and calibrations
    noise_deviation : standard deviation of the sensor's noise, in pixel values of f
    budget : time limit in seconds;  seconds : duration of all measurements
    """

    title: str
    scene: str
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
    left_out: tuple[SkippedJob, ...]

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
    rows = [row_of(cell) for cell in table.cells]
    columns = list(rows[0]) if rows else list(Cell.model_fields)
    write_csv(folder / CSV, columns, (row.values() for row in rows))
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


def row_of(cell: Cell) -> dict[str, Any]:
    """Return a cell as a row of bench.csv by column; quantities with quantiles take three columns."""
    row: dict[str, Any] = {}
    for name, value in cell:
        if name not in ("error", "seconds", "mse"):
            row[name] = value
            continue
        for key in Quantiles.model_fields:
            row[name if key == "median" else f"{name}_{key}"] = None if value is None else getattr(value, key)
        if name == "error":
            row["error_unit"] = UNITS[cell.stage]
    return row
