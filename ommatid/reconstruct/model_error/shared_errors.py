"""What errors of few numbers of H do to the estimate: they are shared by many measurements and do not average out.

Where the entries of H follow from few numbers, the error of H f is L xi with independent xi of variance 1, and the
estimate errs by -A L xi. Beside the other noise, Rvm, Eq. 5 and the residual gain

    Eq. 5: A L L^T A^T,    of the residual: (I - H A) L L^T (I - H A)^T,

and with K = A L L^T A^T the squared error of one image, whose bias is b, gains the variance
4 b^T K b + 2 tr K^2 + 4 tr(K A Rvm A^T). The columns of L pass through the estimator one by one where they and the
pixels are few; else random combinations of them do, whose squares have the right mean (Hutchinson 1990).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.fitted.fitted_matrix import Directions

from ..expected_error import Interval
from ..methods.method import EstimationTask, Method, MethodResult, PosteriorOperators
from ..prior import spectrum_of
from ..verdict.residual import ResidualPower, SharedResidual, squared_trace

FEW_PIXELS, FEW_COLUMNS = 4000, 1000  # up to which every column is taken
DRAWS, FEW_DRAWS = 12, 4  # of combinations, otherwise
MANY = 250_000  # pixels above which a combination takes long and few are enough
SMALL = 0.01  # mean share of the noise, below which few are enough, too
CROSS_DRAWS = 4  # of combinations for the product with the noise
NEIGHBOURHOOD = 9  # pixels, over which the squares of few combinations are averaged for the map
NEGLIGIBLE = 1e-3  # of the expected error, up to which a bound on the part makes its computation needless


@dataclass(frozen=True)
class SharedErrors:
    """Columns of L, or random combinations of them, before and after the estimator.

    residuals : (K, measurements used) what the estimate leaves of each;  images : (K, N) A of each
    exact : True if they are all columns of L, False if their squares have the right mean alone
    """

    residuals: FloatArray
    images: FloatArray
    exact: bool
    directions: Directions | None = None

    @cached_property
    def variance(self) -> FloatArray:
        """Diagonal of K, (N,)."""
        return np.square(self.images).sum(axis=0)

    def map(self, shape: tuple[int, int]) -> FloatArray:
        """Return the diagonal of K, (N,), averaged over neighbours where few combinations stand for all columns."""
        if self.exact:
            return self.variance
        smooth = ndimage.uniform_filter(self.variance.reshape(shape), NEIGHBOURHOOD, mode="nearest").ravel()
        return smooth * (float(self.variance.mean()) / (float(smooth.mean()) or 1.0))

    def variance_of_sum(self, weights: FloatArray, task: EstimationTask, operators: PosteriorOperators) -> float:
        """Return w^T K w of (N,) weights."""
        if self.exact or self.directions is None:
            return float(np.square(self.images @ weights).sum())
        back = operators.transposed_gain(task, weights)
        return float(np.square(self.directions.adjoint(task.on_all_measurements(back, 0.0))).sum())

    def whitened(self, task: EstimationTask) -> SharedResidual:
        """Return their whitened residuals."""
        white = np.asarray(self.residuals / np.sqrt(task.expected_noise), dtype=np.float32)
        return SharedResidual(white, self.exact)

    def variance_of_square(
        self, bias: FloatArray, actual: FloatArray, task: EstimationTask, operators: PosteriorOperators
    ) -> float:
        """Return what K adds to the variance of the squared error of an image; actual : (M,) diagonal of Rvm."""
        along = float(np.square(self.images @ bias).sum())
        combined = self.images
        if len(combined) > CROSS_DRAWS:
            weights = probe(Purpose.SHARED_PRODUCTS).normal(size=(CROSS_DRAWS, len(combined)))
            combined = weights @ combined / CROSS_DRAWS**0.5
        across = sum(float(actual @ np.square(operators.transposed_gain(task, image))) for image in combined)
        return 4 * along + 2 * squared_trace(self.images @ self.images.T, self.exact) + 4 * across


def shared_errors(task: EstimationTask, operators: PosteriorOperators, image: FloatArray) -> SharedErrors | None:
    """Return the errors of few numbers for an image, (N,); None where H has none."""
    model, used, small = task.model, task.used, task.model.unknowns <= FEW_PIXELS
    errors = task.shared_errors if image is task.shared_image else model.errors(image)
    if errors is None:
        return None
    columns = errors.matrix if small else None
    exact = columns is not None and columns.shape[1] <= FEW_COLUMNS
    if exact and columns is not None:
        readings: FloatArray = columns.T.toarray()[:, used]
    else:
        few = model.unknowns > MANY or float(np.mean(errors.variance[used] / task.expected_noise)) < SMALL
        count = FEW_DRAWS if few else DRAWS
        readings = errors.draws(probe(Purpose.SHARED_ERRORS), count)[:, used] / count**0.5
    return _passed(readings, task, operators, exact, errors)


def _passed(
    readings: FloatArray,
    task: EstimationTask,
    operators: PosteriorOperators,
    exact: bool,
    directions: Directions | None = None,
) -> SharedErrors:
    """Pass errors of the measurements, (K, measurements used), through the estimator."""
    residuals, images = np.empty_like(readings), np.empty((len(readings), task.shape_of_f[0] * task.shape_of_f[1]))
    for number, reading in enumerate(readings):
        solved = operators.gain(reading)
        residuals[number], images[number] = reading - task.observe(solved), task.of_f(solved)
    return SharedErrors(residuals, images, exact, directions)


def bound(task: EstimationTask, image: FloatArray) -> float:
    """Return a bound on what errors of few numbers add to the mean of Eq. 5 for an image, (N,); 0 where H has none.

    A Rv^1/2 has no singular value above half the root of the largest eigenvalue p of P0, so that with variances d of
    the errors it is p / 4 times the sum of d / Rv, over N.
    """
    errors = task.model.errors(image)
    if errors is None or not errors.variance.any():
        return 0.0
    camera = task.model.camera
    largest = float(np.max(spectrum_of(task.prior, task.shape, camera.target_pitch, camera.detail)))
    with np.errstate(divide="ignore"):
        return largest / 4 * float(np.sum(errors.variance[task.used] / task.expected_noise)) / task.model.unknowns


def with_shared_errors(
    result: MethodResult,
    method: Method,
    operators: PosteriorOperators,
    image: FloatArray,
    truth: FloatArray | None,
    actual: FloatArray,
) -> MethodResult:
    """Return a result whose Eq. 5, interval, sums of pixels and residual hold the errors of few numbers of H.

    image : (N,) with the contrast of the true one;  truth : (N,) or (pixels of the world,), or None
    actual : (measurements used,) the variances that the result holds already
    """
    task = method.task
    errors = shared_errors(task, operators, image)
    if errors is None:
        return result
    given, power = errors, result.residual_power
    if truth is not None and errors.exact:
        given = shared_errors(task, operators, truth) or errors
    if power is not None:
        power = _with_residuals(power, errors, given, task)
    added = _added(result, method, operators, errors, given, truth, actual, "calibration")
    return replace(added, residual_power=power)


def with_common_rounding(
    result: MethodResult,
    method: Method,
    operators: PosteriorOperators,
    columns: FloatArray,
    truth: FloatArray | None,
    actual: FloatArray,
) -> MethodResult:
    """Return a result whose Eq. 5, interval and sums of pixels hold errors of rounding that measurements share.

    columns : (K, measurements used), see `noise.common_rounding`;  others as of `with_shared_errors`
    """
    errors = _passed(columns, method.task, operators, exact=True)
    return _added(result, method, operators, errors, errors, truth, actual, "quantisation")


def _added(
    result: MethodResult,
    method: Method,
    operators: PosteriorOperators,
    errors: SharedErrors,
    given: SharedErrors,
    truth: FloatArray | None,
    actual: FloatArray,
    cause: str,
) -> MethodResult:
    """Return a result with errors for its image, and in the interval those `given` the true one."""
    task = method.task

    def of_sum(weights: FloatArray) -> float:
        return errors.variance_of_sum(weights, task, operators)

    def wider(without: Interval) -> Interval | None:
        return None if truth is None else _wider(without, given, truth, actual, method, operators)

    return result.with_error(cause, errors.map(task.shape_of_f), of_sum, wider)


def _wider(
    without: Interval,
    errors: SharedErrors,
    truth: FloatArray,
    actual: FloatArray,
    method: Method,
    operators: PosteriorOperators,
) -> Interval:
    task = method.task
    rows, columns = task.shape_of_f
    count, image = rows * columns, truth
    if truth.size < task.model.unknowns:
        image = task.finer**2 * task.of_unknowns(truth)
    bias = task.of_f(operators.hidden(image - method.mean))
    added = errors.variance_of_square(bias, actual, task, operators)
    return without.with_added(float(errors.variance.sum()), added, count)


def _with_residuals(
    power: ResidualPower, errors: SharedErrors, given: SharedErrors, task: EstimationTask
) -> ResidualPower:
    """Return the expected squares of the residual with those of the errors for the image and for the true one."""
    shared = errors.whitened(task)
    of_given = shared if given is errors else given.whitened(task)
    noise = None if power.noise is None else power.noise + of_given.power
    return replace(power, prior=power.prior + shared.power, noise=noise, shared=shared, shared_given=of_given)
