"""Interface of the estimation methods (dense, tiles, frame): their task, their result, and what frames share.

With the same H and prior, factorisations and error bars depend on the noise alone. Where every variance of a frame's
noise is between 1 / (1 + d) and 1 + d times that of another one, so is Eq. 5 of the minimum-variance estimate, since it
grows with Rv and is linear in its scale. Of an estimator whose assumed noise stays the same, Eq. 5 is linear in the
actual noise, and the same holds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from scipy import fft, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.execution.workers import Workers
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.fitted.fitted_matrix import Directions
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.tables import estimation

from ..expected_error import ExpectedError, Interval
from ..output.run_json import SolverReport
from ..prior import Prior, coloured, prior_of, spectrum_of
from ..verdict.residual import ResidualPower
from .level import Level

Value = TypeVar("Value")

SAME_NOISE = 1e-2  # largest relative difference of noise variances whose error bars are reused: that of a map's pixels
EXPECTED = 1e-9  # relative difference of the actual from the assumed noise where the estimate is that of least variance


@dataclass(frozen=True, eq=False)
class Conditions:
    """Everything but H that factorisations and error bars depend on.

    settings : the tables of the prior and of the estimator;  used : (M,) True for measurements that are used
    assumed : (measurements used,) the estimator's noise;  actual : by cause, likewise; empty where it has no effect
    """

    settings: tuple[object, ...]
    used: BoolArray
    assumed: FloatArray
    actual: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])

    def difference(self, other: Conditions) -> float:
        """Return the largest relative difference d of the noise; infinite where Eq. 5 is not within 1 + d for it."""
        comparable = self.settings == other.settings and self.actual.keys() == other.actual.keys()
        if not comparable or not np.array_equal(self.used, other.used):
            return inf
        assumed = relative_difference(self.assumed, other.assumed)
        if not self.actual:
            return assumed
        actual = relative_difference(self._total, other._total)
        if assumed > EXPECTED and not (self._optimal and other._optimal):
            return inf
        return max(assumed, actual)

    @property
    def _total(self) -> FloatArray:
        parts = list(self.actual.values())
        return sum(parts[1:], parts[0])

    @property
    def _optimal(self) -> bool:
        return relative_difference(self.assumed, self._total) <= EXPECTED


def relative_difference(values: FloatArray, others: FloatArray) -> float:
    """Return the least d with which all values are between 1 / (1 + d) and 1 + d times the others; all 0 or more."""
    if values.shape != others.shape:
        return inf
    if np.array_equal(values, others):
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(values == others, 1.0, values / others)
    least, largest = float(ratio.min()), float(ratio.max())
    return inf if not least > 0 else max(largest, 1 / least) - 1


class Prepared:
    """Results that the frames of one model share, by name; of each, that of the last conditions for which it was made.

    Serves one frame at a time.
    """

    def __init__(self, model: Model) -> None:
        """Nothing is prepared before the first frame."""
        self.model = model
        self._kept: dict[str, tuple[Conditions, Any]] = {}

    def shared(
        self, name: str, conditions: Conditions, make: Callable[[], Value], tolerance: float = 0.0
    ) -> tuple[Value, float | None]:
        """Return a result and the difference of the noise for which it was made, None if `make` had to make it.

        tolerance : largest difference of the noise at which a result serves
        """
        if name in self._kept:
            kept, value = self._kept[name]
            difference = conditions.difference(kept)
            if difference <= tolerance:
                return cast(Value, value), difference
        value = make()
        self._kept[name] = conditions, value
        return value, None

    def contents(self, *names: str) -> dict[str, tuple[Conditions, Any]]:
        """Return the results of these kinds for another process; a kind is the end of a name."""
        return {name: kept for name, kept in self._kept.items() if name.endswith(names)}

    def with_contents(self, contents: dict[str, tuple[Conditions, Any]]) -> Prepared:
        """Return a copy that holds the results of another process, for the same model."""
        copy = Prepared(self.model)
        copy._kept |= contents
        return copy


class Nearby(NamedTuple):
    """Solutions for nearly the same noise, from which those of a method may start.

    image : (unknowns,) of an image of the prior's mean;  response : (unknowns,) h of its level, None without one
    """

    image: FloatArray
    response: FloatArray | None


@dataclass(frozen=True)
class Execution:
    """Workers for parallel tasks (default: threads of this process), a callback for progress, and what frames share.

    nearby : solutions for nearly the same noise, None where there are none
    quick : True takes a frame's error from transfer functions alone, those of the mean camera, and no residual's: for
        predictions, and for what errors of H add to the error
    """

    workers: Workers | None = None
    progress: Progress = no_progress
    prepared: Prepared | None = None
    quick: bool = False
    nearby: Nearby | None = None


@dataclass(frozen=True)
class TaskWindow:
    """The used measurements that see nothing outside a window of f of this shape: (m,) of them.

    matrix : (m, pixels of the window) H;  index : (m,) of the measurements among all that are used
    """

    matrix: sparse.csr_array
    recorded: FloatArray
    expected_noise: FloatArray
    index: IntArray
    shape: tuple[int, int]


@dataclass(frozen=True)
class EstimationTask:
    """Everything an estimation method needs: H, measurements, noise, prior and settings.

    recorded : (M,) g;  used : (M,) True for measurements that are used
    expected_noise : (measurements used,) the noise variance that the estimator assumes, 0 allowed
    shared_image : (N,) whose errors by few numbers of H are part of the expected noise; None: they are not
    prior : as the estimator assumes it;  prior_ratio : the actual variance of the pixels over that of `prior`
    finer : the model's pixels, the unknowns, are so many times finer than f's along both axes
    """

    model: Model
    recorded: FloatArray
    used: BoolArray
    expected_noise: FloatArray
    prior: estimation.PriorTable
    settings: estimation.EstimatorTable
    tiles: estimation.TilesTable
    prior_ratio: float = 1.0
    shared_image: FloatArray | None = None
    finer: int = 1

    @cached_property
    def complete(self) -> bool:
        """True if all measurements are used."""
        return bool(self.used.all())

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the unknowns."""
        return self.model.camera.rows, self.model.camera.columns

    @property
    def shape_of_f(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.shape[0] // self.finer, self.shape[1] // self.finer

    def of_f(self, image: FloatArray) -> FloatArray:
        """Return the averages A w over pixels of f: (unknowns,) to (N,)."""
        return averaged(image.reshape(self.shape), self.finer).ravel()

    def of_unknowns(self, weights: FloatArray) -> FloatArray:
        """Return A^T c, the weights of the unknowns in a weighted sum of pixels of f: (N,) to (unknowns,)."""
        if self.finer == 1:
            return weights
        whole = np.kron(weights.reshape(self.shape_of_f), np.full((self.finer, self.finer), self.finer**-2.0))
        return np.asarray(whole, dtype=np.float64).ravel()

    def window(self, rows: slice, columns: slice) -> TaskWindow:
        """Cut out a window of f with the used measurements that see nothing outside it."""
        numbers, shape = self.used_inside(rows, columns), (rows.stop - rows.start, columns.stop - columns.start)
        index, matrix = self.among_used(numbers), self.model.windowed.rows_on(numbers, rows, columns)
        return TaskWindow(matrix, self.recorded[numbers], self.expected_noise[index], index, shape)

    def used_inside(self, rows: slice, columns: slice) -> IntArray:
        """Return the numbers, in ascending order, of the used measurements that see nothing outside a window of f."""
        inside = self.model.windowed.measurements_inside(rows, columns)
        return inside if self.complete else inside[self.used[inside]]

    def among_used(self, numbers: IntArray) -> IntArray:
        """Return the indices of used measurements among those that are used."""
        return numbers if self.complete else self._order[numbers]

    @cached_property
    def _order(self) -> IntArray:
        return np.cumsum(self.used) - 1

    @property
    def _scale(self) -> tuple[float, int]:
        """Pitch of f, and by how much the world is finer."""
        return self.model.camera.target_pitch, self.model.camera.detail

    def prior_on(self, shape: tuple[int, int]) -> Prior:
        """Return the prior of an image of this shape."""
        return prior_of(self.prior, shape, *self._scale)

    def precision_on(self, shape: tuple[int, int]) -> float | FloatArray:
        """Return 1 / P0 of independent pixels, or 1 / its spectrum under the DCT-II: (rows, columns)."""
        return 1 / spectrum_of(self.prior, shape, *self._scale, self.shape)

    def prior_variance_of_sum(self, weights: FloatArray) -> float:
        """Return w^T P0 w, the prior variance of a weighted sum of pixels; weights : (N,)."""
        spectrum = spectrum_of(self.prior, self.shape, *self._scale)
        if isinstance(spectrum, float):
            return spectrum * float(weights @ weights)
        waves = fft.dctn(weights.reshape(self.shape), 2, norm="ortho")
        return float(np.sum(spectrum * np.square(waves)))

    def draw_deviation(self, rng: np.random.Generator) -> FloatArray:
        """Draw an image from the assumed prior, less its mean: (N,)."""
        return coloured(spectrum_of(self.prior, self.shape, *self._scale), rng.normal(size=self.shape)).ravel()

    def observe(self, image: FloatArray) -> FloatArray:
        """Return H f of the used measurements: (N,) to (measurements used,)."""
        readings = self.model.forward(image)
        return readings if self.complete else readings[self.used]

    @cached_property
    def shared_errors(self) -> Directions | None:
        """The errors by few numbers of H that are part of the expected noise; None where there are none."""
        return None if self.shared_image is None else self.model.errors(self.shared_image)

    @property
    def shared_variance(self) -> FloatArray:
        """Their variances: (measurements used,)."""
        errors = self.shared_errors
        return np.zeros(self.expected_noise.size) if errors is None else errors.variance[self.used]

    @property
    def shared_directions(self) -> sparse.csc_array | None:
        """L of them, (measurements used, q); None where there are none."""
        errors = self.shared_errors
        return None if errors is None else sparse.csc_array(sparse.csr_array(errors.matrix)[self.used])

    def on_all_measurements(self, values: FloatArray, fill: float) -> FloatArray:
        """Return values of the used measurements on all of them: (measurements used,) to (M,), else `fill`."""
        if self.complete:
            return values
        filled = np.full(self.used.size, fill)
        filled[self.used] = values
        return filled


@dataclass(frozen=True)
class MethodResult:
    """An estimate and its error.

    image : (N,) f^;  multipliers : (measurements used,) Rv^-1 (g - H f^)
    expected : Eq. 5 with the actual noise;  interval : for the true image, if it is known
    variance_of_sum : expected squared error of a weighted sum of pixels, as a function of (N,) weights
    residual_power : expected squares of the residual, None where a measurement has no expected noise
    noise_difference : largest relative difference of the noise from that of the frame whose error bars these are; None
        where they were computed for this one
    left_out : bound on what errors of few numbers of H add to Eq. 5, where that was left out; None where it was not
    """

    image: FloatArray
    multipliers: FloatArray
    solver: SolverReport
    expected: ExpectedError
    interval: Interval | None
    variance_of_sum: Callable[[FloatArray], float]
    residual_power: ResidualPower | None
    noise_difference: float | None = None
    left_out: float | None = None

    def with_error(
        self,
        cause: str,
        variance: FloatArray,
        of_sum: Callable[[FloatArray], float],
        interval: Callable[[Interval], Interval | None],
    ) -> MethodResult:
        """Return the result with one more error, independent of the others.

        variance : (N,) of every pixel;  of_sum : of a weighted sum of pixels;  interval : that with the error
        """
        expected, before, given = self.expected, self.variance_of_sum, self.interval
        parts = expected.parts | {cause: expected.parts.get(cause, 0.0) + float(variance.mean())}

        def variance_of_sum(weights: FloatArray) -> float:
            return before(weights) + of_sum(weights)

        return replace(
            self,
            expected=replace(expected, variance=expected.variance + variance, parts=parts),
            interval=None if given is None else interval(given),
            variance_of_sum=variance_of_sum,
        )


@dataclass(frozen=True)
class PosteriorOperators:
    """Linear operators of an estimate.

    gain : A, (measurements used,) to (N,);  posterior : C, (N,) to (N,);  weigh : Rv^-1 on (measurements used,)
    hidden : I - A H = C P0^-1, (N,) to (N,): what the estimate lacks of an image less its mean
    """

    gain: Callable[[FloatArray], FloatArray]
    posterior: Callable[[FloatArray], FloatArray]
    weigh: Callable[[FloatArray], FloatArray]
    hidden: Callable[[FloatArray], FloatArray]

    def transposed_gain(self, task: EstimationTask, weights: FloatArray) -> FloatArray:
        """Return A^T w = Rv^-1 H C w of f's pixels: (N,) to (measurements used,)."""
        return self.weigh(task.observe(self.posterior(task.of_unknowns(weights))))


class Method(ABC):
    """An estimation method applied to one task."""

    def __init__(self, task: EstimationTask, execution: Execution) -> None:
        """Create the method for `task`, run by `execution`."""
        self.task = task
        self.execution = execution

    def conditions(self, noise: dict[str, FloatArray] | None = None) -> Conditions:
        """Return what results of this method depend on; noise : actual, where they depend on it."""
        task = self.task
        settings = task.prior, task.settings, task.tiles, task.prior_ratio
        return Conditions(settings, task.used, task.expected_noise, noise or {})

    def shared(
        self, name: str, conditions: Conditions, make: Callable[[], Value], tolerance: float = 0.0
    ) -> tuple[Value, float | None]:
        """Return a result that frames of one camera share, as `Prepared.shared`; made here for a frame by itself."""
        prepared = self.execution.prepared
        if prepared is None or prepared.model is not self.task.model:
            return make(), None
        return prepared.shared(f"{type(self).__name__} {name}", conditions, make, tolerance)

    @cached_property
    def image(self) -> FloatArray:
        """The estimate f^ without its error: (N,)."""
        return self._with_level(self.image_of_mean, self.level)

    @cached_property
    def preliminary_image(self) -> FloatArray:
        """The estimate to the accuracy of means over the image, of which noise is taken: (N,)."""
        return self._with_level(self.preliminary_of_mean, self._level_of(self.preliminary_of_mean))

    @property
    def nearby(self) -> Nearby:
        """What a method for nearly the same noise may start from."""
        return Nearby(self.preliminary_of_mean, self.response)

    @staticmethod
    def _with_level(image: FloatArray, level: Level | None) -> FloatArray:
        return image if level is None else image + level.value * level.response

    @cached_property
    def image_of_mean(self) -> FloatArray:
        """The estimate where the image's level is the prior's mean: (N,)."""
        return self.estimate_image()

    @cached_property
    def preliminary_of_mean(self) -> FloatArray:
        """The same to the accuracy of means over the image, where that is faster."""
        return self.image_of_mean

    def observe(self, image: FloatArray) -> FloatArray:
        """Return H f by the H of the estimate: (N,) to (measurements used,), or with columns."""
        return self.task.observe(image)

    @abstractmethod
    def estimate_image(self) -> FloatArray:
        """Compute the estimate where the image's level is the prior's mean, without its error: (N,)."""

    @cached_property
    def level(self) -> Level | None:
        """The common level of the image, None where the prior knows it or this method takes it for known."""
        return self._level_of(self.image_of_mean)

    @cached_property
    def response(self) -> FloatArray | None:
        """What the estimate lacks of a constant image, h, (unknowns,); None as for the level."""
        deviation = self.task.prior.level_deviation
        if not deviation:
            return None
        return self.shared("level", self.conditions(), lambda: self.left_of_constant(deviation))[0]

    def _level_of(self, image: FloatArray) -> Level | None:
        """Return the level for an estimate of an image of the prior's mean."""
        response, task = self.response, self.task
        if response is None:
            return None
        wave = float(np.ravel(1 / np.asarray(task.precision_on(task.shape)))[0])
        return Level.of(image - task.prior.mean, response, wave, task.prior.level_deviation**2)

    def left_of_constant(self, value: float) -> FloatArray | None:
        """Return C P0^-1 1, (unknowns,), as accurate as for an image of this value; None where there is no noise."""
        operators = self.operators()
        return None if operators is None else operators.hidden(np.full(self.task.model.unknowns, value)) / value

    @property
    def mean(self) -> float:
        """The prior's mean with the level of the estimate."""
        return self.task.prior.mean + (0.0 if self.level is None else self.level.value)

    def operators(self) -> PosteriorOperators | None:
        """Return the operators of the estimate, None where this method cannot apply them, or not without noise."""
        return None

    def result(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual `noise`, (measurements used,) by cause, and actual prior.

        With P0M = c P0, Eq. 5 is c times that of the noise Rvm / c for images of the assumed prior P0.
        """
        truth = None if truth is None else truth - (self.mean - self.task.prior.mean)
        result, level = self._result_for_actual_prior(noise, truth), self.level
        operators = None if level is None else self.operators()
        if level is None or operators is None:
            return result
        return _with_level(result, level, self.task, self.actual_noise(noise), operators)

    def actual_noise(self, noise: dict[str, FloatArray]) -> FloatArray:
        """Return Rvm, (measurements used,); Rv itself where it is the same, as a large frame has no room for both."""
        total, expected = total_variance(noise), self.task.expected_noise
        return expected if np.array_equal(total, expected) else total

    def _result_for_actual_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        ratio = self.task.prior_ratio
        if ratio == 1:
            return self.result_for_assumed_prior(noise, truth)
        scaled = {name: values / ratio for name, values in noise.items()}
        mean = self.task.prior.mean
        closer = None if truth is None else mean + (truth - mean) / ratio**0.5
        return _multiplied(self.result_for_assumed_prior(scaled, closer), ratio)

    @abstractmethod
    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual `noise` and images of the prior that is assumed.

        The level of the image is the prior's mean.
        """


def _with_level(
    result: MethodResult, level: Level, task: EstimationTask, actual: FloatArray, operators: PosteriorOperators
) -> MethodResult:
    """Return the result for the prior's mean with the level added; actual : (measurements used,) Rvm."""
    read, response, expected = task.observe(level.response), task.of_f(level.response), result.expected
    gain = level.variance * operators.weigh(read)
    other = actual - task.prior_ratio * task.expected_noise
    other *= gain
    variance, before = level.variance_for(gain, other, task.prior_ratio), result.variance_of_sum
    beside = task.of_f(operators.gain(other)) if other.any() else np.zeros(response.size)
    more = np.maximum(variance * response**2 + 2 * beside * response, -expected.variance)
    read *= -level.value
    read /= task.expected_noise
    read += result.multipliers

    def variance_of_sum(weights: FloatArray) -> float:
        along = float(weights @ response)
        return before(weights) + variance * along**2 + 2 * along * float(weights @ beside)

    return replace(
        result,
        image=result.image + level.value * response,
        multipliers=read,
        expected=replace(expected, variance=expected.variance + more, missing=expected.missing + float(more.mean())),
        variance_of_sum=variance_of_sum,
    )


def _multiplied(result: MethodResult, ratio: float) -> MethodResult:
    """Return a result whose expected squares are `ratio` times as large."""
    expected, given, power, of_sum = result.expected, result.interval, result.residual_power, result.variance_of_sum
    expected = replace(
        expected,
        variance=ratio * expected.variance,
        missing=ratio * expected.missing,
        parts={name: ratio * part for name, part in expected.parts.items()},
    )
    if given is not None:
        given = Interval(ratio * given.mse, ratio * given.low, ratio * given.high, ratio**2 * given.variance)
    if power is not None:
        power = power.multiplied(ratio)

    def variance_of_sum(weights: FloatArray) -> float:
        return ratio * of_sum(weights)

    return replace(result, expected=expected, interval=given, variance_of_sum=variance_of_sum, residual_power=power)


def total_variance(noise: dict[str, FloatArray]) -> FloatArray:
    """Return the sum of the variances of all causes."""
    first, *others = noise.values()
    total = np.array(first)
    for variance in others:
        total += variance
    return total


def is_uniform(values: FloatArray) -> bool:
    """Return True if an array repeats one number, or is empty."""
    return values.size == 0 or not np.ptp(values)


def residual_multipliers(task: EstimationTask, image: FloatArray) -> FloatArray:
    """Return Rv^-1 (g - H f^): (measurements used,); 0 for a measurement without noise."""
    recorded = task.recorded if task.complete else task.recorded[task.used]
    residual = recorded - task.observe(image)
    return np.divide(residual, task.expected_noise, out=np.zeros_like(residual), where=task.expected_noise > 0)
