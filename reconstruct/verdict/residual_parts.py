"""Chi-squared of the residual in all, by lens type, by sub-imager and by region of the target, with its p-values.

The whitened residual r of a part has the covariance W, whose eigenvalues are at most 1 where the actual noise is the
expected one. |r|^2 then has the mean tr W and a variance of 2 tr W^2 <= 2 tr W; the certain part b of a known image
adds |b|^2 to the mean and 4 b^T W b <= 4 |b|^2 to the variance. The p-value takes |r|^2 for a gamma variate of that
mean and variance. Where the estimate is not optimal, tr W^2 is the mean of (r^T s)^2 over pairs of draws r and s.
Noise variances that are themselves estimates make the tails heavier; `spread` holds their relative variances.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy import special

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.scenes.camera import Camera

from .residual_power import ResidualPower

Kind = Literal["all", "lens type", "sub-imager", "region"]

REGIONS = 3  # along each axis of the target
LEAST_IN_REGION = 40  # measurements per region, on average, below which there are no regions
PLACES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


@dataclass(frozen=True)
class ResidualPart:
    """Chi-squared of the measurements of a part, its expectation and standard deviation.

    prior : expectation for images of the prior;  expected : the larger of that and of the true image's, if known
    p_value : probability of a larger value by chance
    """

    kind: Kind
    name: str
    measurements: int
    chi_squared: float
    prior: float
    expected: float
    deviation: float
    p_value: float

    @property
    def ratio(self) -> float:
        """Chi-squared over its expectation."""
        return self.chi_squared / self.expected if self.expected > 0 else float("inf")


@dataclass(frozen=True)
class WhitenedResidual:
    """Squares of the whitened residual, (measurements used,), and what they are compared with.

    used : (M,) True for measurements that are used
    spread : (measurements used,) relative variance of the expected noise, where that is an estimate
    shared : (measurements used,) share of the expected noise whose errors few parameters per sub-imager determine
    largest : largest ratio of the actual to the expected noise variance, at least 1; bounds the eigenvalues of W
    """

    squares: FloatArray
    power: ResidualPower
    used: BoolArray
    spread: FloatArray
    shared: FloatArray
    largest: float = 1.0


SAMPLES_MARGIN = 2.0  # on a variance from few draws
SHARED_FREEDOMS = 2  # of such errors in a sub-imager


def residual_parts(residual: WhitenedResidual, camera: Camera) -> list[ResidualPart]:
    """Return all parts: the whole, then lens types, sub-imagers and regions, without those that have no measurement.

    Lens types are left out where there is one, and sub-imagers where each is a lens type.
    """
    sums = _Sums(residual, camera)
    parts = sums.parts("all", ["all"], np.zeros(camera.measurements, dtype=np.intp))
    if len(camera.types) > 1:
        parts += sums.parts("lens type", [lens_type.name for lens_type in camera.types], _numbers(camera.type_slices()))
    if len(camera.sub_imagers) > len(camera.types):
        parts += sums.parts("sub-imager", [sub.name for sub in camera.sub_imagers], _numbers(camera.slices()))
    if camera.measurements >= LEAST_IN_REGION * REGIONS**2:
        parts += sums.parts("region", [name for row in PLACES for name in row], regions(camera))
    return parts


def regions(camera: Camera) -> IntArray:
    """Return the region of the target in which each measurement is centred, by rows from 0: (M,)."""
    numbers = np.empty(camera.measurements, dtype=np.int64)
    for sub, part in zip(camera.sub_imagers, camera.slices(), strict=True):
        thirds = [
            np.clip((float(start) + float(sub.type.ratio) * (np.arange(count) + 0.5)) * REGIONS / size, 0, REGIONS - 1)
            for start, count, size in zip(sub.window, sub.type.pixels, camera.shape, strict=True)
        ]
        rows, columns = (third.astype(np.int64) for third in thirds)
        numbers[part] = np.add.outer(REGIONS * rows, columns).ravel()
    return numbers


def _numbers(parts: list[slice]) -> IntArray:
    """Return the number of the part that holds each measurement: (M,)."""
    return np.repeat(np.arange(len(parts)), [part.stop - part.start for part in parts])


class _Sums:
    """Sums over the measurements of any part."""

    def __init__(self, residual: WhitenedResidual, camera: Camera) -> None:
        self.residual, self.camera = residual, camera
        self.complete, self.has_shared = bool(residual.used.all()), bool(residual.shared.any())

    def parts(self, kind: Kind, names: list[str], labels: IntArray) -> list[ResidualPart]:
        """Return the parts with these names from the (M,) index of each measurement's name."""
        labels = self._used(labels)
        residual, count = self.residual, len(names)
        power = residual.power
        sizes = np.bincount(labels, minlength=count)
        squares, prior = _sums(labels, residual.squares, count), _sums(labels, power.prior, count)
        expected, variance = prior, self._variance(power.prior, labels, count)
        if power.samples is not None:
            variance = np.maximum(variance, self._variance_of_samples(power.samples, labels, count))
        if power.bias is not None and power.noise is not None:
            bias = _sums(labels, power.bias, count)
            given = bias + _sums(labels, power.noise, count)
            variance_given = self._variance(power.noise, labels, count) + 4 * residual.largest * bias
            expected, variance = np.where(given > prior, [given, variance_given], [prior, variance])
        variance *= 1 + (1 / power.draws if power.draws else 0.0)
        p_values = _p_values(squares, expected, variance)
        return [
            ResidualPart(
                kind,
                name,
                int(sizes[number]),
                float(squares[number]),
                float(prior[number]),
                float(expected[number]),
                float(variance[number]) ** 0.5,
                float(p_values[number]),
            )
            for number, name in enumerate(names)
            if sizes[number]
        ]

    def _used(self, labels: IntArray) -> IntArray:
        return labels if self.complete else labels[self.residual.used]

    def _variance(self, power: FloatArray, labels: IntArray, count: int) -> FloatArray:
        """Return the variance of the sums of squares with these means."""
        residual = self.residual
        variance = 2 * residual.largest * _sums(labels, power, count)
        variance += 3 * _sums(labels, residual.spread * power**2, count)
        if self.has_shared:
            of_sub = self._used(_numbers(self.camera.slices()))
            subs = int(of_sub.max()) + 1
            shared = _sums(of_sub + subs * labels, residual.shared * power, subs * count).reshape(count, subs)
            variance += 2 / SHARED_FREEDOMS * np.square(shared).sum(axis=1)
        return variance

    def _variance_of_samples(self, samples: Float32Array, labels: IntArray, count: int) -> FloatArray:
        """Return 2 tr W^2 of each part from pairs of draws, with a margin since they are few."""
        pairs = list(combinations(samples, 2))
        squares = sum((np.square(_sums(labels, one * other, count)) for one, other in pairs), np.zeros(count))
        return SAMPLES_MARGIN * 2 * squares / len(pairs)


def _sums(labels: IntArray, values: FloatArray | Float32Array, count: int) -> FloatArray:
    """Return the sum of the values with each label from 0 to `count` - 1."""
    return np.bincount(labels, values, count).astype(np.float64)


def _p_values(values: FloatArray, means: FloatArray, variances: FloatArray) -> FloatArray:
    """Return the probabilities of larger gamma variates of these means and variances; 1 where one of them is 0."""
    known = (means > 0) & (variances > 0)
    means, variances = np.where(known, means, 1.0), np.where(known, variances, 1.0)
    return np.where(known, special.gammaincc(means**2 / variances, values * means / variances), 1.0)


def sidak(p_values: list[float]) -> float:
    """Return the probability that the least of independent p-values is as small as it is."""
    return float(-np.expm1(len(p_values) * np.log1p(-min(p_values)))) if p_values and min(p_values) < 1 else 1.0
