"""Dividing a time over the stages of a run.

The expected error of a run with n samples a pixel for rendering and k for calibration is taken as

    floor + R n^-a + C k^-b,

what the sensor's noise and the prior leave, and what each stage adds; the time as fixed + n r + k c. R, C and the times
come from runs with few samples, the exponents from how the parts fall between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Number = TypeVar("Number", float, NDArray[np.float64])

FALLS = (0.5, 2.0)  # what is believed of a measured one
NEGLIGIBLE = 0.005  # of the expected error: what is not worth any time
STEPS = 16  # sample numbers tried, for every factor of 2


@dataclass(frozen=True)
class ErrorCurve:
    """One stage: it adds `part` to the expected error at `samples` a pixel, and takes fixed + each * samples s."""

    part: float
    samples: int
    exponent: float
    fixed: float
    each: float

    def error(self, samples: Number) -> Number:
        """What it adds to the expected error."""
        return cast(Number, self.part * (self.samples / samples) ** self.exponent)

    def seconds(self, samples: Number) -> Number:
        """What it takes."""
        return cast(Number, self.fixed + self.each * samples)

    def from_on(self, samples: int) -> ErrorCurve:
        """The same, which begins at so many samples at least."""
        first = max(self.samples, samples)
        return replace(self, part=float(self.error(first)), samples=first)


@dataclass(frozen=True)
class TimeAllocation:
    """Samples a pixel for rendering and calibration, and the error and the seconds that they are expected to bring."""

    render: int
    calibrate: int
    predicted_mse: float
    seconds: float


def allocate_time(
    render: ErrorCurve, calibrate: ErrorCurve, floor: float, seconds: float, most: tuple[int, int]
) -> TimeAllocation | None:
    """The samples of the least expected error within `seconds`, none more than `most`; None where nothing fits.

    Of those whose error is as good as the least, to within 0.5 %, the cheapest. No less is tried than was measured.
    """
    n, k = _numbers(render.samples, most[0])[:, None], _numbers(calibrate.samples, most[1])[None, :]
    error = floor + render.error(n) + calibrate.error(k)
    taken = render.seconds(n) + calibrate.seconds(k)
    fits = taken <= seconds
    if not fits.any():
        return None
    good = fits & (error <= error[fits].min() * (1 + NEGLIGIBLE))
    row, column = np.unravel_index(np.argmin(np.where(good, taken, np.inf)), taken.shape)
    place = int(row), int(column)
    return TimeAllocation(int(n[place[0], 0]), int(k[0, place[1]]), float(error[place]), float(taken[place]))


def _numbers(first: int, most: int) -> Numbers:
    """Sample numbers that rise by the same factor from `first` to `most`."""
    count = int(STEPS * log(max(most / first, 1.0), 2)) + 1
    rising = np.rint(first * 2 ** (np.arange(count) / STEPS))
    return np.unique(np.append(rising, max(most, first)))


def error_curve(
    few: tuple[int, float, float], more: tuple[int, float, float], part: float, exponent: float | None = None
) -> ErrorCurve:
    """From two runs of a stage: samples, seconds, and a variance that its part of the error is proportional to.

    part : of the error in the second;  exponent : where it is known
    Where the second took less time than the first, all its time counts as that of its samples.
    """
    (n, before, wide), (m, after, narrow) = few, more
    each = (after - before) / (m - n)
    if each <= 0:
        each = after / m
    if exponent is None:
        measured = log(wide / narrow) / log(m / n) if wide > 0 and narrow > 0 else FALLS[1]
        exponent = min(max(measured, FALLS[0]), FALLS[1])
    return ErrorCurve(part, m, exponent, max(after - each * m, 0.0), each)
