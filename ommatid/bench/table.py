"""What `ommatid bench` found, on disk: bench.json, which others read again, and bench.csv, one row a cell.

A cell is one setting of one stage: what it costs in seconds and memory, and how far its result is from the right one.
Errors are in units of their stage: render, root mean square over sensor pixels in values of f; calibrate, over entries
of H; reconstruct, over pixels of f in posterior standard deviations of each.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_csv, write_text

JSON, CSV = "bench.json", "bench.csv"
ALONE = "alone"  # the setting of a dense form without refinement, which no scene can ask for
AUTO = "auto"  # the setting of a cell that takes as many samples as are needed: one point, and no part of a curve
LOW, HIGH = 0.1, 0.9  # the quantiles that go with a median

Stage = Literal["render", "calibrate", "reconstruct"]
STAGES: tuple[Stage, ...] = get_args(Stage)
UNITS: dict[Stage, str] = {
    "render": "values of f",
    "calibrate": "entries of H",
    "reconstruct": "posterior standard deviations",
}


@dataclass(frozen=True)
class Quantiles:
    """Median, 10 % and 90 % quantile over repeats with seeds of their own."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Quantiles:
        """Of at least one value; quantiles between two values are interpolated."""
        low, median, high = np.quantile(values, [LOW, 0.5, HIGH]).tolist()
        return cls(median, low, high)


@dataclass(frozen=True)
class Cell:
    """One setting of a stage, measured.

    way : the sampler, the method of calibration (and its sampler), a dense form, "tiles" or "frame"
    samples : a pixel, as many as were used; of AUTO the most on any pixel, in any repeat;  setting : what else was set
    scatter : standard deviation of the error's natural logarithm over repeats, None where it says nothing
    memory : bytes that the process held at its peak, None where the system does not tell
    mse : mean squared error of the image that this setting brings, with the scene's noise and all else exact
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
        """Whether its number of samples was given beforehand, so that it may lie on a curve."""
        return self.setting != AUTO


@dataclass(frozen=True)
class ConvergenceCurve:
    """How the error of one way falls with the number of samples: the slope d log error / d log samples.

    slope_deviation : its standard error, from the scatter over seeds
    theory : what it should be, None where theory says no number;  why : where that comes from, or why there is none
    agrees : whether the slope lies within 3 standard errors of theory, and of what theory of a limit leaves open at the
        counts that were fitted, which `why` tells
    """

    stage: Stage
    way: str
    variant: str | None
    slope: float | None
    slope_deviation: float | None
    theory: float | None
    why: str
    agrees: bool | None


@dataclass(frozen=True)
class SkippedJob:
    """A cell that was not measured, and why; `late` where there was only no time for it."""

    what: str
    why: str
    late: bool = False


@dataclass(frozen=True)
class BenchTable:
    """All of bench.json.

    scene : fingerprint of what is measured;  fingerprint : of that and of the versions it was measured with
    against : what renderings and calibrations were held against;  noise_deviation : of the sensor, in values of f
    budget : seconds that were allowed;  seconds : that all cells took
    recommended : the cheapest setting that reaches the noise floor, a table a stage; samples are a number or AUTO
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
    recommended: dict[str, Any]
    left_out: tuple[SkippedJob, ...]

    def of(self, stage: Stage) -> list[Cell]:
        """The cells of a stage."""
        return [cell for cell in self.cells if cell.stage == stage]

    def describe(self) -> dict[str, Any]:
        """In JSON's types."""
        return asdict(self)


def bench_files(folder: Path) -> tuple[Path, Path]:
    """Where bench.json is looked for that serves a run, in this order: the folder of the run, its parent."""
    return folder / JSON, folder.resolve().parent / JSON


def write(folder: Path, table: BenchTable) -> None:
    """Write bench.csv, then bench.json, which stands for both. Raises InputError or DeniedError."""
    rows = [row_of(cell) for cell in table.cells]
    columns = list(rows[0]) if rows else [field.name for field in fields(Cell)]
    write_csv(folder / CSV, columns, (row.values() for row in rows))
    write_text(folder / JSON, json.dumps(table.describe(), indent=2, allow_nan=False) + "\n")


def read(path: Path) -> BenchTable:
    """Read bench.json. Raises InputError where it is missing, cut short or something else."""
    try:
        return TypeAdapter(BenchTable).validate_json(path.read_bytes(), strict=True)
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror}); `ommatid bench` makes one") from error
    except ValidationError as error:
        raise InputError(f"{path}: expected what `ommatid bench` writes, got something else; make it again") from error


def cell_of(line: str) -> Cell:
    """A cell from JSON. Raises ValueError for what is none."""
    return TypeAdapter(Cell).validate_json(line, strict=True)


def row_of(cell: Cell) -> dict[str, Any]:
    """Columns by name; quantities with quantiles have three columns, absent ones stay empty."""
    row: dict[str, Any] = {}
    for field in fields(Cell):
        value = getattr(cell, field.name)
        if field.name not in ("error", "seconds", "mse"):
            row[field.name] = value
            continue
        found: dict[str, Any] = {} if value is None else asdict(value)
        for place in ("median", "low", "high"):
            row[field.name if place == "median" else f"{field.name}_{place}"] = found.get(place)
        if field.name == "error":
            row["error_unit"] = UNITS[cell.stage]
    return row
