"""Expected squares of the whitened residual R^-1/2 (g - H f^), one for each measurement.

With g = H f + v and f^ = f0 + A (g - H f0), the residual is (I - H A) (H (f - f0) + v). Over draws of the prior and of
the expected noise its square has the mean 1 - (H A)_ii, in units of R_ii. Without A as a matrix, or with another noise
than the expected one, the mean comes from random images and noise that pass through the same estimator. For a known
image the first term is certain, and only the noise is random.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ommatid.runtime.arrays import Float32Array, FloatArray, IntArray
from ommatid.runtime.streams import Purpose, probe


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

    def squared_traces(self, labels: IntArray, count: int) -> FloatArray:
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

    observe : image, (N,), to measurements used, (M,)
    draw_image : a random image of the prior less its mean, (N,);  actual : (M,) actual noise variances
    deviation : (N,) f - f0 of the true image, None without it
    leverage : (M,) exact (H A)_ii where the noise is as expected, None where it is not known
    optimal : True if the estimate is that of minimum variance
    whiten : applied to the noise where the estimator whitens correlated measurements, None where it does not
    total : sum of the expected squares where the noise is as expected, None where it is not known better than by draws
    """

    observe: Callable[[FloatArray], FloatArray]
    draw_image: Callable[[np.random.Generator], FloatArray]
    actual: FloatArray
    deviation: FloatArray | None
    draws: int
    leverage: FloatArray | None = None
    optimal: bool = True
    whiten: Callable[[FloatArray], FloatArray] | None = None
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
        return noise if self.whiten is None else self.whiten(noise)

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
