"""Allocation of a time to the stages of a run.

The expected mean squared error of a run with n samples per pixel for rendering and k for calibration is modelled as

    floor + R n^-a + C k^-b,

the floor set by the prior and the sensor's noise, plus the contribution of each stage. The time of a run is modelled as
fixed + r n + c k. R, C and the times come from runs with few samples, the exponents from the decrease of each part
between two such runs; or all of them from the results of `ommatid bench`, if they are beside the run's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from ommatid.bench.table import BenchTable, Stage, bench_tables
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.setup import Setup
from ommatid.simulate.renderer.variant import choose

Number = TypeVar("Number", float, FloatArray)

EXPONENTS = (0.5, 2.0)  # to which a measured exponent is clipped
NEGLIGIBLE = 0.005  # increase of the expected error that is accepted to save time
STEPS = 16  # numbers of samples tried per factor of 2


@dataclass(frozen=True)
class ErrorCurve:
    """Model of one stage: it adds `part` to the expected error at `samples` samples per pixel.

    exponent : of the decrease with the number of samples
    fixed, each : seconds, independent of the number of samples and per sample
    """

    part: float
    samples: int
    exponent: float
    fixed: float
    each: float

    def error(self, samples: Number) -> Number:
        """Return the contribution of the stage to the expected error."""
        return cast(Number, self.part * (self.samples / samples) ** self.exponent)

    def seconds(self, samples: Number) -> Number:
        """Return the time of the stage."""
        return cast(Number, self.fixed + self.each * samples)

    def starting_at(self, samples: int) -> ErrorCurve:
        """Return the same curve with its first point at `samples` or later."""
        first = max(self.samples, samples)
        return replace(self, part=float(self.error(first)), samples=first)


@dataclass(frozen=True)
class TimeAllocation:
    """Samples per pixel for rendering and calibration, and the expected error and time of a run with them."""

    render: int
    calibrate: int
    predicted_mse: float
    seconds: float


def allocate_time(
    render: ErrorCurve, calibrate: ErrorCurve, floor: float, seconds: float, most: tuple[int, int]
) -> TimeAllocation | None:
    """Choose the samples with the least expected error within `seconds`, from the curves' first points to `most`.

    Among those within 0.5 % of the least error, the fastest is taken. Returns None if nothing fits.
    """
    n, k = _sample_counts(render.samples, most[0])[:, None], _sample_counts(calibrate.samples, most[1])[None, :]
    error = floor + render.error(n) + calibrate.error(k)
    time = render.seconds(n) + calibrate.seconds(k)
    fits = time <= seconds
    if not fits.any():
        return None
    good = fits & (error <= error[fits].min() * (1 + NEGLIGIBLE))
    row, column = map(int, np.unravel_index(np.argmin(np.where(good, time, np.inf)), time.shape))
    return TimeAllocation(int(n[row, 0]), int(k[0, column]), float(error[row, column]), float(time[row, column]))


def _sample_counts(first: int, most: int) -> FloatArray:
    """Return whole numbers from `first` to `most` with constant ratios, up to rounding."""
    count = int(STEPS * log(max(most / first, 1.0), 2)) + 1
    rising = np.rint(first * 2 ** (np.arange(count) / STEPS))
    return np.unique(np.append(rising, max(most, first)))


def error_curve(few: tuple[int, float, float], more: tuple[int, float, float], part: float) -> ErrorCurve:
    """Fit a curve to two runs of a stage.

    few, more : number of samples, seconds, and a variance proportional to the stage's part of the error
    part : part of the error in the second run
    If the second run was not slower, all of its time is attributed to its samples.
    """
    (few_samples, few_seconds, few_variance), (samples, seconds, variance) = few, more
    each = (seconds - few_seconds) / (samples - few_samples)
    if each <= 0:
        each = seconds / samples
    exponent = EXPONENTS[1]
    if few_variance > 0 and variance > 0:
        exponent = log(few_variance / variance) / log(samples / few_samples)
    exponent = min(max(exponent, EXPONENTS[0]), EXPONENTS[1])
    return ErrorCurve(part, samples, exponent, max(seconds - each * samples, 0.0), each)


def bench_error_curves(folder: Path, setup: Setup) -> tuple[ErrorCurve, ErrorCurve] | None:
    """Return the curves of rendering and calibration from bench.json in the run's folder or its parent.

    Returns None if there is none of the same camera, sampler, variant and calibration method.
    """
    sampler, variant = setup.scene.render.sampler, choose(setup.scene.render.variant)
    for table in bench_tables(folder, setup.camera.describe()):
        render = _curve(table, "render", sampler, variant)
        calibrate = _curve(table, "calibrate", f"{setup.scene.calibration.method}, {sampler}", variant)
        if render is not None and calibrate is not None:
            return render, calibrate
    return None


def _curve(table: BenchTable, stage: Stage, way: str, variant: str) -> ErrorCurve | None:
    """Return the curve of a stage; None if fewer than two cells of it were measured."""
    wanted = (stage, way, variant)
    counted = [cell for cell in table.cells if cell.counted]
    cells = sorted(
        (cell.samples, cell.seconds.median, cell.mse.median)
        for cell in counted
        if (cell.stage, cell.way, cell.variant) == wanted and cell.mse is not None and cell.samples is not None
    )
    curves = [curve for curve in table.curves if (curve.stage, curve.way, curve.variant) == wanted]
    slopes = [curve.slope for curve in curves if curve.slope is not None]
    if len(cells) < 2 or not slopes:
        return None
    (few, few_seconds, mse), (many, many_seconds, _) = cells[0], cells[-1]
    floor = min(cell.mse.median for cell in counted if cell.mse is not None)
    each = max((many_seconds - few_seconds) / (many - few), 0.0)
    # The slope is that of a standard deviation; a variance decreases twice as fast.
    return ErrorCurve(max(mse - floor, 0.0), few, -2 * slopes[0], max(few_seconds - each * few, 0.0), each)
