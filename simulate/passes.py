"""Rendering in passes with seeds of their own, so that every mean comes with the variance of its own error."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isqrt

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

BATCHES = 4  # passes are also averaged in this many batches, whose scatter shows how errors go together
FEWEST_PASSES = 16
MOST_SAMPLES = 4096  # in one pass: the renderer's sums are float32
ROUNDING = 2.0**-24
OWN_SHARE = 0.5  # at most this much of a variance rests on a pixel's own few passes


@dataclass(frozen=True)
class Plan:
    """How many passes, and how many samples a pixel in each."""

    passes: int
    samples: int

    @property
    def total(self) -> int:
        """Samples a pixel of all passes."""
        return self.passes * self.samples


def plan(samples: int) -> Plan:
    """Divide `samples` a pixel over at least 16 passes, rounding up to a grid that a stratified sampler can fill."""
    passes = max(FEWEST_PASSES, BATCHES * ceil(samples / MOST_SAMPLES / BATCHES))
    each = ceil(samples / passes)
    side = isqrt(each)
    return Plan(passes, side * ceil(each / side))


class Tally:
    """Running mean and variance over passes of arrays of one shape (Welford), in float64."""

    def __init__(self, *shape: int) -> None:
        """Start empty."""
        self.count = 0
        self._mean = np.zeros(shape)
        self._squares = np.zeros(shape)

    def add(self, values: Vector) -> None:
        """Take in one more pass."""
        self.count += 1
        away = values - self._mean
        self._mean += away / self.count
        self._squares += away * (values - self._mean)

    @property
    def mean(self) -> Vector:
        """Mean over the passes."""
        return self._mean

    @property
    def variance(self) -> Vector:
        """Unbiased variance of that mean, from the scatter of the passes alone."""
        return self._squares / (self.count * (self.count - 1))


def rounding_variance(values: Vector, samples: int) -> Vector:
    """Variance that float32 leaves in a mean of `samples` values: of its storage, and of the sums it came from."""
    return (values * ROUNDING * (1 + samples / 8)) ** 2 + np.finfo(np.float32).tiny


def shrink(variance: Vector, passes: int) -> Vector:
    """Draw the variances of one sub-image's pixels towards their mean, by as much as their own scatter tells.

    A variance from n passes scatters by 2 / (n - 1) of its square. What they scatter beyond that is real; its share
    is the weight of a pixel's own variance in the best linear estimate, and at most a half: weights by noisier
    variances make the predicted error too small.
    """
    if variance.size < 2:
        return variance
    pooled = float(variance.mean())
    scatter = float(variance.var(ddof=1))
    expected = 2 / (passes + 1) * float((variance**2).mean())
    own = min(OWN_SHARE, max(0.0, 1 - expected / scatter)) if scatter > 0 else 0.0
    return pooled + own * (variance - pooled)
