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
from ommatid.runtime.streams import Purpose, probe

from ..expected_error import ExpectedError, Interval
from ..methods.method import EstimationTask, Method, MethodResult, PosteriorOperators
from ..verdict.residual import ResidualPower

NEIGHBOURHOOD = 5  # pixels, over which the square of the attenuation is averaged for the map
GROUP_SIZE = 200  # fewest measurements over which a leverage is averaged
MOST_GROUPS = 24  # per lens type
FIRST_ORDER = 0.5  # share of the posterior's spread that attenuation takes, up to which the first order serves
LEAST_LEFT = 0.05  # of an expected square of the residual
UNCERTAINTY = 0.07  # of what the errors of H add to the error, relative: noise and attenuation are of first order


@dataclass(frozen=True)
class Effect:
    """What the errors of H do to the estimate of an image, (unknowns,).

    lacking : what the estimate lacks of it without such errors;  halves : C D image by either half of the batches
    """

    image: FloatArray
    lacking: FloatArray
    halves: tuple[FloatArray, FloatArray]

    def added(self, task: EstimationTask) -> float:
        """Return |lacking + C D image|^2 - |lacking|^2 over f's pixels, by two independent estimates of C D image."""
        first, second = (task.of_f(half) for half in self.halves)
        return float(first @ second + task.of_f(self.lacking) @ (first + second))


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
            average over measurements of a lens type of about the same leverage. They are divided by the squares of
            `whites`, since leverages near 1 would else be lost in the scatter of these.
        """
        task = method.task
        inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
        products = [inverse * white * task.observe(image) for white, image in zip(whites, noise, strict=True)]
        leverage, power = np.mean(products, axis=0), np.mean(np.square(whites), axis=0)
        share, likely = np.empty_like(leverage), _likely_leverage(task)
        used = np.flatnonzero(task.used)
        for part in task.model.camera.type_slices():
            rows = np.flatnonzero((used >= part.start) & (used < part.stop))
            groups = max(1, min(rows.size // GROUP_SIZE, MOST_GROUPS))
            for group in np.array_split(rows[np.argsort(likely[rows])], groups):
                seen = leverage[group].sum() / power[group].sum() if group.size else 0.0
                share[group] = np.clip(1 - seen, 0.0, 1.0)
        return cls(task.model.error_halves, operators, task.used, share)

    def halves(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C D f by either half of the batches: (N,) each."""
        first, second = (self._by(errors, image) for errors in self.errors)
        return first, second

    def strength(self, image: FloatArray) -> float:
        """Return the share of an image that attenuation takes away: f^T C D f / f^T f, from 0 to 1 but for chance."""
        first, second = self.halves(image)
        return float(image @ (first + second)) / (2 * float(image @ image) or 1.0)

    def effect(self, image: FloatArray, mean: float) -> Effect:
        """Return the effect on the estimate of an image, (N,); mean : of the prior, with the level."""
        return Effect(image, self.operators.hidden(image - mean), self.halves(image))

    def residual_change(self, task: EstimationTask, effect: Effect) -> FloatArray:
        """Return what the errors of H add to the mean square of each whitened residual, (measurements used,).

        The estimate is image - lacking - C D image, on average, and it is this image that E acts upon in the residual.
        """
        seen = [task.observe(half) for half in effect.halves]
        change = seen[0] * self.operators.weigh(seen[1])
        change += task.observe(effect.lacking) * self.operators.weigh(seen[0] + seen[1])
        for errors, other in zip(self.errors, reversed(effect.halves), strict=True):
            for error in errors:
                weighted = self.operators.weigh((error @ (other + effect.lacking))[self.used])
                change -= self.residual_share * (error @ effect.image)[self.used] * weighted
        return change

    def _by(self, errors: list[sparse.csr_array], image: FloatArray) -> FloatArray:
        weighted = np.zeros(self.used.size)
        total = np.zeros(image.size)
        for error in errors:
            weighted[self.used] = self.residual_share * self.operators.weigh((error @ image)[self.used])
            total += error.T @ weighted
        return self.operators.posterior(total)


def _likely_leverage(task: EstimationTask) -> FloatArray:
    """Return a quantity that orders measurements by their leverage, (measurements used,), as for pixels by themselves.

    A pixel near an edge, or seen with little noise by few measurements, leaves each of them a larger leverage.
    """
    squares = task.model.matrix[task.used].power(2)
    weights = np.divide(1.0, task.expected_noise, out=np.zeros(squares.shape[0]), where=task.expected_noise > 0)
    information = squares.T @ weights + 1 / task.prior.variance
    return np.asarray(weights * (squares @ (1 / information)))


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

    image : (unknowns,) with the contrast of the true one;  truth : likewise, or None
    actual : (measurements used,) variances
    """
    task, rng, root = method.task, probe(Purpose.ATTENUATION), np.sqrt(actual)
    white = rng.normal(size=root.size)
    noise = operators.gain(root * white)
    attenuation = Attenuation.of(method, operators, [white], [noise], root)

    unseen = task.prior_ratio**0.5 * operators.hidden(task.draw_deviation(rng))
    if not attenuation.strength(noise + unseen) <= FIRST_ORDER:
        return result
    average = attenuation.effect(image + unseen, method.mean)
    given = None if truth is None else attenuation.effect(truth, method.mean)
    first, second = (task.of_f(half) for half in average.halves)
    power = result.residual_power

    def of_sum(weights: FloatArray) -> float:
        return max(float((weights @ first) * (weights @ second)), 0.0)

    def shifted(without: Interval) -> Interval:
        return without if given is None else _shifted(without, result.expected, given, method, operators, actual)

    if power is not None:
        change = None if given is None else attenuation.residual_change(task, given)
        power = _with_change(power, attenuation.residual_change(task, average), change)
    variance = _spread(max(average.added(task), 0.0), first + second, task.shape_of_f)
    second_order = max(attenuation.strength(sum(average.halves, np.zeros_like(unseen))), 0.0)
    added = result.with_error("calibration", variance, of_sum, shifted)
    expected = replace(added.expected, attenuation=float(variance.mean()), second_order=second_order)
    return replace(added, expected=expected, residual_power=power)


def _with_change(power: ResidualPower, average: FloatArray, given: FloatArray | None) -> ResidualPower:
    """Return expected squares with their changes for images of the prior, and for the true one if it is known."""

    def changed(squares: FloatArray, change: FloatArray) -> FloatArray:
        return np.maximum(squares + change, LEAST_LEFT * squares)

    noise = power.noise if power.noise is None or given is None else changed(power.noise, given)
    return replace(power, prior=changed(power.prior, average), noise=noise)


def _spread(total: float, shape: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Return squares of this sum that are large where `shape` is, (N,)."""
    squares = ndimage.uniform_filter(np.square(shape).reshape(size), NEIGHBOURHOOD, mode="nearest").ravel()
    return squares * (total / (float(squares.sum()) or 1.0))


def _shifted(
    without: Interval,
    expected: ExpectedError,
    effect: Effect,
    method: Method,
    operators: PosteriorOperators,
    actual: FloatArray,
) -> Interval:
    """Return the interval with the attenuation of the true image: its square, and its product with the noise."""
    count, task = expected.variance.size, method.task
    mean = task.of_f(effect.halves[0] + effect.halves[1]) / 2
    along, added = operators.transposed_gain(task, mean), effect.added(task)
    unknown = UNCERTAINTY * (added + count * expected.parts.get("calibration", 0.0))
    return without.with_added(added, 4 * float(actual @ np.square(along)) + unknown**2, count)
