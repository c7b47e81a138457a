"""Chi-squared of the residual in all, by lens type, by sub-imager and by region of the target, with its p-values.

The whitened residual r of a part has the covariance W, whose eigenvalues are at most 1 where the actual noise is the
expected one. |r|^2 then has the mean tr W and a variance of 2 tr W^2 <= 2 tr W; the certain part b of a known image
adds |b|^2 to the mean and 4 b^T W b <= 4 |b|^2 to the variance. The p-value takes |r|^2 for a gamma variate of that
mean and variance. Where the estimate is not optimal, tr W^2 is the mean of (r^T s)^2 over pairs of draws r and s.
Noise variances that are themselves estimates make the tails heavier; `spread` holds their relative variances.

Expected squares of the whitened residual R^-1/2 (g - H f^) belong to each measurement.

With g = H f + v and f^ = f0 + A (g - H f0), the residual is (I - H A) (H (f - f0) + v). Over draws of the prior and of
the expected noise its square has the mean 1 - (H A)_ii, in units of R_ii. Without A as a matrix, or with another noise
than the expected one, the mean comes from random images and noise that pass through the same estimator. For a known
image the first term is certain, and only the noise is random.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera

from ..output.run_json import ResidualPart

REGIONS = 3  # along each axis of the target
LEAST_IN_REGION = 40  # measurements per region, on average, below which there are no regions
PLACES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


@dataclass(frozen=True)
class SharedResidual:
    """Whitened residuals that few numbers cause in all measurements together, as a sum of `columns` times normal xi.

    columns : (K, measurements used);  exact : False if they are random combinations, whose squares have the right mean
    """

    columns: Float32Array
    exact: bool

    @cached_property
    def power(self) -> FloatArray:
        """Mean squares, (measurements used,)."""
        return np.square(self.columns, dtype=np.float64).sum(axis=0)

    def squared_traces(self, labels: NDArray[np.integer], count: int) -> FloatArray:
        """Return tr W^2 of the covariance W of the measurements with each label from 0 to `count` - 1."""
        traces = np.zeros(count)
        for label in range(count):
            part = self.columns[:, labels == label].astype(np.float64)
            traces[label] = squared_trace(part @ part.T, self.exact)
        return traces


def squared_trace(gram: FloatArray, exact: bool) -> float:
    """Return tr W^2 from the Gram matrix of vectors whose squares add up to W.

    exact : False if W is only the mean over such random vectors: those are independent, and a product of two has the
        right mean, but not a vector's square
    """
    whole = float(np.square(gram).sum())
    if exact:
        return whole
    own, count = float(np.square(np.diagonal(gram)).sum()), len(gram)
    return (whole - own) * count / (count - 1)


@dataclass(frozen=True)
class ResidualPower:
    """Expected squares of the whitened residual, (measurements used,).

    prior : for images drawn from the prior
    bias, noise : for the true image, the square that is certain and the mean square that noise adds; None without it
    draws : number of random draws of which these are means, 0 where nothing was drawn
    samples : (draws, measurements used) whitened residuals of images drawn from the prior, by an estimate that is not
        optimal, such as that of tiles; None of one whose residual varies by no more than its measurements' noise
    shared, shared_given : what few numbers cause, for images of the prior and for the true image; part of the squares
    """

    prior: FloatArray
    bias: FloatArray | None
    noise: FloatArray | None
    draws: int
    samples: Float32Array | None = None
    shared: SharedResidual | None = None
    shared_given: SharedResidual | None = None

    def multiplied(self, ratio: float) -> ResidualPower:
        """Return the expected squares of residuals that are larger by the root of `ratio`."""
        bias, noise, samples = self.bias, self.noise, self.samples
        return ResidualPower(
            ratio * self.prior,
            None if bias is None else ratio * bias,
            None if noise is None else ratio * noise,
            self.draws,
            None if samples is None else np.float32(ratio**0.5) * samples,
        )


@dataclass(frozen=True)
class ResidualInputs:
    """What the measurements deviate by from H f0, as the estimator's random or given inputs.

    observe : image, (N,), to measurements used, (M,), or to itself where the solver takes it so
    draw_image : a random image of the prior less its mean, (N,);  actual : (M,) actual noise variances
    deviation : (N,) f - f0 of the true image, None without it
    leverage : (M,) exact (H A)_ii where the noise is as expected, None where it is not known
    optimal : True if the estimate is that of minimum variance
    total : sum of the expected squares where the noise is as expected, None where it is not known better than by draws
    """

    observe: Callable[[FloatArray], FloatArray]
    draw_image: Callable[[np.random.Generator], FloatArray]
    actual: FloatArray
    deviation: FloatArray | None
    draws: int
    leverage: FloatArray | None = None
    optimal: bool = True
    total: float | None = None

    @property
    def count(self) -> int:
        """Number of columns."""
        noise = 0 if self.deviation is None and self.leverage is not None else self.draws
        return noise + (self.deviation is not None) + (self.draws if self.leverage is None else 0)

    def columns(self) -> Iterator[FloatArray]:
        """Yield the inputs, (M,) each: the known image, noises, then images; those that are needed."""
        rng = probe(Purpose.RESIDUAL)
        if self.deviation is not None:
            yield self.observe(self.deviation)
        if self.deviation is not None or self.leverage is None:
            for _ in range(self.draws):
                yield self._noise(rng)
        if self.leverage is None:
            for _ in range(self.draws):
                yield self.observe(self.draw_image(rng))

    def _noise(self, rng: np.random.Generator) -> FloatArray:
        noise = rng.normal(size=self.actual.size)
        noise *= np.sqrt(self.actual)
        return noise

    def block(self) -> FloatArray:
        """All columns together: (M, count)."""
        block = np.empty((self.actual.size, self.count))
        for number, column in enumerate(self.columns()):
            block[:, number] = column
        return block

    def power(self, residuals: Iterator[FloatArray], expected_noise: FloatArray) -> ResidualPower:
        """Return the expected squares from the residuals, (M,) each, of the columns in their order."""
        white = 1 / np.sqrt(expected_noise)
        bias = None if self.deviation is None else np.square(_scaled(next(residuals), white))
        if self.leverage is not None:
            noise = None if bias is None else self._mean_square(white, residuals)
            return ResidualPower(np.clip(1 - self.leverage, 0.0, 1.0), bias, noise, 0 if bias is None else self.draws)
        samples = None if self.optimal else np.zeros((self.draws, white.size), np.float32)
        noise, image = (self._mean_square(white, residuals, samples) for _ in range(2))
        if self.total is not None:
            scale = self.total / float((noise + image).sum())
            noise, image = scale * noise, scale * image
        return ResidualPower(noise + image, bias, None if bias is None else noise, self.draws, samples)

    def _mean_square(
        self, white: FloatArray, residuals: Iterator[FloatArray], samples: Float32Array | None = None
    ) -> FloatArray:
        """Return the mean square of the next residuals, whitened, and add these to `samples`, (draws, M)."""
        total = np.zeros(white.size)
        for number in range(self.draws):
            residual = _scaled(next(residuals), white)
            if samples is not None:
                samples[number] += residual
            total += np.square(residual, out=residual)
        return total / self.draws


def _scaled(values: FloatArray, factors: FloatArray) -> FloatArray:
    """Multiply values that nothing else needs by factors, without a copy: a large frame has none to spare."""
    values *= factors
    return values


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
    used, subs = residual.used, _numbered(camera.slices())
    sums = _Sums(residual, _Parts.of(subs, used, len(camera.sub_imagers)))
    found = sums.parts("all", ["all"], _Parts.of(np.zeros_like(subs), used, 1))
    if len(camera.types) > 1:
        names = [lens_type.name for lens_type in camera.types]
        found += sums.parts("lens type", names, _Parts.of(_numbered(camera.type_slices()), used, len(names)))
    if len(camera.sub_imagers) > len(camera.types):
        found += sums.parts("sub-imager", [sub.name for sub in camera.sub_imagers], sums.subs)
    if camera.measurements >= LEAST_IN_REGION * REGIONS**2:
        names = [name for row in PLACES for name in row]
        found += sums.parts("region", names, _Parts.of(regions(camera), used, len(names)))
    return found


def _numbered(slices: Sequence[slice]) -> NDArray[np.uint32]:
    """Return the number of the slice in which each measurement lies: (M,)."""
    return np.repeat(np.arange(len(slices), dtype=np.uint32), [part.stop - part.start for part in slices])


@lru_cache(maxsize=1)  # for the next frame of the same camera
def regions(camera: Camera) -> NDArray[np.uint8]:
    """Return the region of the target in which each measurement is centred, by rows from 0: (M,), not to be changed."""
    numbers = np.empty(camera.measurements, dtype=np.uint8)
    for sub, part in zip(camera.sub_imagers, camera.slices(), strict=True):
        thirds = [
            np.clip((float(start) + float(sub.type.ratio) * (np.arange(count) + 0.5)) * REGIONS / size, 0, REGIONS - 1)
            for start, count, size in zip(sub.window, sub.type.pixels, camera.shape, strict=True)
        ]
        rows, columns = (third.astype(np.uint8) for third in thirds)
        numbers[part] = np.add.outer(REGIONS * rows, columns).ravel()
    return numbers


@dataclass(frozen=True)
class _Parts:
    """Parts of the measurements used, by the index of the part of each: (measurements used,)."""

    labels: NDArray[np.integer]
    count: int

    @classmethod
    def of(cls, labels: NDArray[np.integer], used: BoolArray, count: int) -> _Parts:
        """Return the parts by the index of each of all measurements, (M,)."""
        return cls(labels if used.all() else labels[used], count)

    def sums(self, values: FloatArray | Float32Array) -> FloatArray:
        """Return the sum of the values of each part: (count,)."""
        return np.bincount(self.labels, values, self.count).astype(np.float64)

    @property
    def sizes(self) -> IntArray:
        """Number of measurements of each part: (count,)."""
        return np.bincount(self.labels, minlength=self.count)


@dataclass(frozen=True)
class _Sums:
    """Sums over the measurements of any part; subs : by sub-imager."""

    residual: WhitenedResidual
    subs: _Parts

    def parts(self, kind: str, names: list[str], of: _Parts) -> list[ResidualPart]:
        """Return the parts with these names."""
        residual, power = self.residual, self.residual.power
        sizes = of.sizes
        squares, prior = of.sums(residual.squares), of.sums(power.prior)
        expected, variance = prior, self._variance(power.prior, of, prior)
        if power.samples is not None:
            variance = np.maximum(variance, self._variance_of_samples(power.samples, of))
        if power.shared is not None:
            variance = variance + self._variance_of_shared(power.shared, of)
        if power.bias is not None and power.noise is not None:
            bias, noise = of.sums(power.bias), of.sums(power.noise)
            given = bias + noise
            variance_given = self._variance(power.noise, of, noise) + 4 * residual.largest * bias
            if power.shared_given is not None:
                variance_given = variance_given + self._variance_of_shared(power.shared_given, of, bias)
            expected, variance = np.where(given > prior, [given, variance_given], [prior, variance])
        variance *= 1 + (1 / power.draws if power.draws else 0.0)
        p_values = _p_values(squares, expected, variance)
        return [
            ResidualPart(
                kind=kind,
                name=name,
                measurements=int(sizes[number]),
                chi_squared=float(squares[number]),
                prior=float(prior[number]),
                expected=float(expected[number]),
                deviation=float(variance[number]) ** 0.5,
                p_value=float(p_values[number]),
            )
            for number, name in enumerate(names)
            if sizes[number]
        ]

    def _variance(self, power: FloatArray, of: _Parts, sums: FloatArray) -> FloatArray:
        """Return the variance of the sums of squares with these means, and `sums` of them."""
        residual = self.residual
        variance = 2 * residual.largest * sums
        if residual.spread.any():
            variance += 3 * of.sums(_scaled(np.square(power), residual.spread))
        if residual.shared.any():
            subs = self.subs.count
            both = _Parts(self.subs.labels + subs * of.labels.astype(np.intp), subs * of.count)
            shared = both.sums(residual.shared * power).reshape(of.count, subs)
            variance += 2 / SHARED_FREEDOMS * np.square(shared).sum(axis=1)
        return variance

    def _variance_of_shared(self, shared: SharedResidual, of: _Parts, bias: FloatArray | float = 0.0) -> FloatArray:
        """Return what errors with the covariance W, of few degrees of freedom, add to the variance of the sums.

        That is 2 tr W^2 and the products with the noise, 4 tr(W W'), and with the certain part, 4 b^T W b; half of the
        former is counted as noise already. No eigenvalue of W is above the root of tr W^2.
        """
        squared = shared.squared_traces(of.labels, of.count)
        products = self.residual.largest * of.sums(shared.power)
        return 2 * squared + 2 * products + 4 * bias * np.sqrt(squared)

    def _variance_of_samples(self, samples: Float32Array, of: _Parts) -> FloatArray:
        """Return 2 tr W^2 of each part from pairs of draws, with a margin since they are few."""
        pairs = list(combinations(samples, 2))
        squares = sum((np.square(of.sums(one * other)) for one, other in pairs), np.zeros(of.count))
        return SAMPLES_MARGIN * 2 * squares / len(pairs)


def _p_values(values: FloatArray, means: FloatArray, variances: FloatArray) -> FloatArray:
    """Return the probabilities of larger gamma variates of these means and variances; 1 where one of them is 0."""
    known = (means > 0) & (variances > 0)
    means, variances = np.where(known, means, 1.0), np.where(known, variances, 1.0)
    return np.where(known, special.gammaincc(means**2 / variances, values * means / variances), 1.0)


def sidak(p_values: list[float]) -> float:
    """Return the probability that the least of independent p-values is as small as it is."""
    return float(-np.expm1(len(p_values) * np.log1p(-min(p_values)))) if p_values and min(p_values) < 1 else 1.0
