"""Attenuation of the estimate by the errors of H that it was computed with (errors in variables).

With H^ = H + E and the gain A of H^, the estimate errs by -A E f. This is not only noise: A is made of the same E. To
first order of the covariance of E, with rows of independent errors (Fuller 1987, Measurement Error Models, 2.2),

    mean of A E f = C D f,   D = mean of E^T Rv^-1 diag(I - H A) E,

with C the posterior covariance. It draws the estimate towards an image without contrast, as a
stronger prior would. D comes from the batches of the calibration; two halves of them give its effect twice with
independent errors, so that products of the two have the right mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray

from ..expected_error import ExpectedError, Interval, interval
from ..methods.method import Method, MethodResult, PosteriorOperators

SEED = 20260404  # of the random image for what the measurements do not show
NEIGHBOURHOOD = 5  # pixels, over which the square of the attenuation is averaged for the map
GROUP_SIZE = 200  # fewest measurements over which a leverage is averaged
MOST_GROUPS = 24  # per lens type
FIRST_ORDER = 0.5  # share of the posterior's spread that attenuation takes, up to which the first order serves
UNCERTAINTY = 0.1  # of the attenuation's part of the error, relative: it is of first order


@dataclass(frozen=True)
class Attenuation:
    """C D as an operator, by each half of the batches.

    errors : E of each half as matrices whose squares add up to the covariance of H, (M, N) each
    residual_share : (measurements used,) 1 - (H A)_ii
    """

    errors: tuple[list[sparse.csr_array], list[sparse.csr_array]]
    operators: PosteriorOperators
    used: BoolArray
    residual_share: FloatArray

    @classmethod
    def of(
        cls,
        method: Method,
        operators: PosteriorOperators,
        whites: Sequence[FloatArray],
        noise: Sequence[FloatArray],
        root: FloatArray,
    ) -> Attenuation:
        """Return the attenuation of a method's estimate.

        noise : A of `root` times each of `whites`, whose products show the diagonal of H A (Hutchinson 1990), on
            average over measurements of a lens type with similar noise
        """
        task = method.task
        inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
        products = [inverse * white * task.observe(image) for white, image in zip(whites, noise, strict=True)]
        leverage = np.mean(products, axis=0)
        share = np.empty_like(leverage)
        used = np.flatnonzero(task.used)
        for part in task.model.camera.type_slices():
            rows = np.flatnonzero((used >= part.start) & (used < part.stop))
            for group in np.array_split(
                rows[np.argsort(root[rows])], max(1, min(rows.size // GROUP_SIZE, MOST_GROUPS))
            ):
                share[group] = np.clip(1 - leverage[group].mean(), 0.0, 1.0) if group.size else 1.0
        return cls(task.model.error_halves, operators, task.used, share)

    def halves(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C D f by either half of the batches: (N,) each."""
        first, second = (self._by(errors, image) for errors in self.errors)
        return first, second

    def strength(self, image: FloatArray) -> float:
        """Return the share of an image that attenuation takes away: f^T C D f / f^T f, from 0 to 1 but for chance."""
        first, second = self.halves(image)
        return float(image @ (first + second)) / (2 * float(image @ image) or 1.0)

    def _by(self, errors: list[sparse.csr_array], image: FloatArray) -> FloatArray:
        weighted = np.zeros(self.used.size)
        total = np.zeros(image.size)
        for error in errors:
            weighted[self.used] = self.residual_share * self.operators.weigh((error @ image)[self.used])
            total += error.T @ weighted
        return self.operators.posterior(total)


def can_be_corrected(method: Method) -> bool:
    """Return True if the batches of the calibration can show the attenuation."""
    return bool(method.task.used.any()) and method.task.model.has_error_halves


def with_attenuation(
    result: MethodResult,
    method: Method,
    operators: PosteriorOperators,
    image: FloatArray,
    truth: FloatArray | None,
    actual: FloatArray,
) -> MethodResult:
    """Return a result whose Eq. 5 and interval hold the attenuation, or the same where its first order does not serve.

    image : (N,) with the contrast of the true one;  truth : (N,), or None;  actual : (measurements used,) variances
    """
    task, rng, root = method.task, np.random.default_rng(SEED), np.sqrt(actual)
    white = rng.normal(size=root.size)
    noise = operators.gain(root * white)
    attenuation = Attenuation.of(method, operators, [white], [noise], root)

    unseen = operators.hidden(task.draw_deviation(rng))
    if not attenuation.strength(noise + unseen) <= FIRST_ORDER:
        return result
    whole = image + unseen
    lacking, (first, second) = operators.hidden(whole - task.prior.mean), attenuation.halves(whole)
    added = max(_added(lacking, first, second), 0.0)
    given = result.interval
    if truth is not None and given is not None:
        given = _shifted(
            given, operators.hidden(truth - task.prior.mean), attenuation.halves(truth), method, operators, actual
        )
    before = result.variance_of_sum

    def variance_of_sum(weights: FloatArray) -> float:
        return before(weights) + max(float((weights @ first) * (weights @ second)), 0.0)

    return replace(
        result,
        expected=_with_added(result.expected, added, first + second, task.shape),
        interval=given,
        variance_of_sum=variance_of_sum,
    )


def _added(lacking: FloatArray, first: FloatArray, second: FloatArray) -> float:
    """Return |lacking + b|^2 - |lacking|^2 from two independent estimates of b."""
    return float(first @ second + lacking @ (first + second))


def _with_added(expected: ExpectedError, added: float, shape: FloatArray, size: tuple[int, int]) -> ExpectedError:
    """Return Eq. 5 with a sum of squares added where `shape` is large, (N,)."""
    squares = ndimage.uniform_filter(np.square(shape).reshape(size), NEIGHBOURHOOD, mode="nearest").ravel()
    total, mean = float(squares.sum()), added / shape.size
    if not total:
        return replace(expected, attenuation=0.0)
    parts = expected.parts | {"calibration": expected.parts.get("calibration", 0.0) + mean}
    return replace(expected, variance=expected.variance + squares * (added / total), parts=parts, attenuation=mean)


def _shifted(
    given: Interval,
    lacking: FloatArray,
    halves: tuple[FloatArray, FloatArray],
    method: Method,
    operators: PosteriorOperators,
    actual: FloatArray,
) -> Interval:
    """Return the interval with the attenuation of the true image: its square, and its product with the noise."""
    count = lacking.size
    added = _added(lacking, *halves)
    along = operators.weigh(method.task.observe(operators.posterior((halves[0] + halves[1]) / 2)))
    variance = count**2 * given.variance + 4 * float(actual @ np.square(along)) + (UNCERTAINTY * added) ** 2
    return interval(max(count * given.mse + added, 0.0), variance, count)
