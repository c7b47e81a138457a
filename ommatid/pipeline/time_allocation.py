"""Allocation of a time to the stages of a run.

The expected mean squared error of a run with n samples per pixel for rendering and k for calibration is modelled as

    floor + R n^-a + C k^-b,

the floor set by the prior and the sensor's noise, plus the contribution of each stage. The time of a run is modelled as
fixed + r n + c k. R, C and the times come from runs with few samples, the exponents from the decrease of each part
between two such runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import TypeVar, cast

import numpy as np

from ommatid.runtime.arrays import FloatArray

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
