"""The estimate of a whole frame and its error, without a matrix of its size: by solutions of one linear system.

With c = C w, C the posterior covariance, Eq. 5 of a weighted sum w of pixels is c^T P0^-1 c + |Rvm^1/2 Rv^-1 H c|^2.
Shares of the mean error come from random noise images, whose squares have the right mean (Hutchinson 1990).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, islice
from math import isfinite

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, probe

from ..coarse_model import CAUSE as DETAIL
from ..coarse_model import world_of
from ..expected_error import ExpectedError, Interval, interval
from ..methods.method import (
    SAME_NOISE,
    EstimationTask,
    Execution,
    Method,
    MethodResult,
    PosteriorOperators,
    is_uniform,
    residual_multipliers,
)
from ..output.run_json import SolverReport
from ..prior import coloured
from ..verdict.residual import ResidualInputs, ResidualPower
from .bands import Bands
from .conjugate_gradients import (
    BandedFactor,
    FrameSystem,
    Refined,
    Solution,
    frame_system,
    serves,
)
from .error_map import MANY, ErrorMap, error_map, is_invariant
from .reading_space import ReadingSpace, moments_of
from .unseen import with_unseen
from .variance_map import VarianceMap, mean_ratios
from .windows import of_mean_kernels

NULL_SPACE = "the lens types leave a null space or see edges otherwise: K is factorised"
INVARIANT = "every lens type is shift-invariant except at the edges"
ELSEWHERE = "the lens types do not see alike everywhere: windows give the error bars"
WORLD = "the world finer than f is estimated, and f's pixels are its averages"
MEAN_ACCURACY = 0.01  # of operators for means over the frame, in posterior standard deviations
SOLVING = 0.3  # share of the time that the estimate takes; the error analysis takes the rest
LEAST_WEIGHT = 1e-300  # of lens types whose pixels are all saturated
SIMILAR = 0.1  # relative difference of mean weights up to which a preconditioner serves, which costs a step at most
ERRORS = "errors"  # name of a FrameError among what frames share
DRAWS = 2  # of images and noise for the expected residual, at least
DRAWN, MOST_DRAWS = 20_000, 16  # pixels of random images together, so that a mean over few pixels is from more images


@dataclass(frozen=True)
class FrameError:
    """The expected error of every frame of the same noise.

    maps : of its variances
    power : expected squares of the residual, `bias` that of an image equal to f0; None where the error alone is asked
    """

    expected: ExpectedError
    maps: ErrorMap
    power: ResidualPower | None


class FrameMethod(Method):
    """Estimation of all pixels at once by conjugate gradients."""

    def __init__(self, task: EstimationTask, execution: Execution, *, little_memory: bool = False) -> None:
        """Raises InputError if a measurement has no noise; little_memory : True where K is never factorised."""
        super().__init__(task, execution)
        self._banded = (
            not little_memory and task.finer == 1 and task.prior.kind == "independent" and serves(task.model.camera)
        )
        self._start, self._nearly = None, None  # solutions from which those of this method start
        self._lacking: tuple[FloatArray, FloatArray] | None = None  # the last image of `_hidden`, and its result
        nearby = execution.nearby
        if nearby is not None and nearby.image.size == task.model.unknowns:
            self._start, self._nearly = nearby.image - task.prior.mean, nearby.response
        if not (task.expected_noise > 0).all():
            raise InputError(
                "estimator.method 'frame' needs noise in every measurement; set estimator.noise_variance above 0"
            )

    @property
    def _why(self) -> str:
        if self._banded:
            return NULL_SPACE
        return WORLD if self.task.finer > 1 else INVARIANT if is_invariant(self.task) else ELSEWHERE

    @cached_property
    def system(self) -> FrameSystem:
        """The linear system of the frame."""
        system = frame_system(self.task)
        if self._banded:
            matrix = self.task.model.matrix
            factor, _ = self.shared("factor", self.conditions(), lambda: BandedFactor(system, matrix))
            return replace(system, similar=factor)
        if ReadingSpace.serves(self.task):
            conditions = replace(self.conditions(), assumed=np.ones(0))
            found, _ = self.shared("moments", conditions, lambda: moments_of(self.task))
            space = ReadingSpace(self.task, system, found, np.array(self.task.expected_noise))
            if space.is_regular:
                return replace(system, similar=space)
        variances = 1 / np.maximum(system.mean_weights, LEAST_WEIGHT)
        conditions = replace(self.conditions(), used=np.ones(0, np.bool_), assumed=variances)
        nearly = replace(system, observation=of_mean_kernels(system.observation))  # in which steps are fast
        similar, _ = self.shared("preconditioner", conditions, lambda: nearly.preconditioner, SIMILAR)
        return replace(system, similar=Refined.of(system, with_unseen(system, similar)))

    @cached_property
    def solution(self) -> Solution:
        """The solution f^ - f0."""
        accuracy, progress = self.task.settings.accuracy, self.execution.progress
        return self._solved(self._right, accuracy, self._start, lambda done: progress(SOLVING * done))

    def _solved(
        self, right: FloatArray, accuracy: float, start: FloatArray | None, progress: Progress = no_progress
    ) -> Solution:
        """Return C b from about C b, (unknowns,), which leaves fewer steps; None: from 0."""
        if start is None:
            return self.system.solve(right, accuracy, progress)
        change = self.system.solve(right - self.system.apply(start), accuracy, progress)
        return replace(change, image=start + change.image)

    @cached_property
    def preliminary_of_mean(self) -> FloatArray:
        """The estimate where the image's level is the prior's mean, to the accuracy of means over the image: (N,)."""
        self._start = self._solved(self._right, self._mean_accuracy, self._start).image
        return self._start + self.task.prior.mean

    @property
    def _right(self) -> FloatArray:
        """The right-hand side of the solution."""
        task = self.task
        recorded = task.recorded if task.complete else np.where(task.used, task.recorded, 0.0)
        mean = self.system.observation.forward(np.full(task.model.unknowns, task.prior.mean))
        return self.system.right_hand_side(np.subtract(recorded, mean, out=mean))

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.solution.image + self.task.prior.mean

    def left_of_constant(self, value: float) -> FloatArray:
        """Return C P0^-1 1, (unknowns,), to the accuracy of the estimate for an image of this value."""
        constant = np.full(self.task.model.unknowns, value)
        right = self.system.apply_prior_precision(constant)
        if self.quick_bands is not None:
            return self.quick_bands.solve(right.reshape(self.task.shape), edges=False).ravel() / value
        start = None if self._nearly is None else value * self._nearly
        return self._solved(right, self.task.settings.accuracy, start).image / value

    def operators(self) -> PosteriorOperators:
        """Return the operators of the estimate, to a mean error of a hundredth of a posterior standard deviation."""
        noise = self.task.expected_noise
        return PosteriorOperators(self._gain, self._solve_weights, lambda values: values / noise, self._hidden)

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        task, actual = self.task, self.actual_noise(noise)
        solution = self.solution
        make = partial(self._frame_error, noise, actual)
        errors, difference = self.shared(ERRORS, self.conditions(noise), make, SAME_NOISE)
        self.execution.progress(0.9)
        expected, check = errors.expected, errors.maps.check
        deviation = None if truth is None else self._of_unknowns(truth) - task.prior.mean
        variances = errors.maps.variances
        given = None if deviation is None else self._interval(deviation, actual, expected, check.mean, variances)
        solver = SolverReport(
            way="frame",
            method="frame",
            why=self._why,
            condition=solution.condition if isfinite(solution.condition) else None,
            variance_bound=check.worst + (difference or 0.0),
            bound=solution.bound,
            refinements=solution.steps,
            unit="posterior standard deviation",
        )
        return MethodResult(
            task.of_f(self.image_of_mean),
            residual_multipliers(task, self.image_of_mean),
            solver,
            expected,
            given,
            lambda weights: self._variance_of_sum(weights, actual),
            self._residual_power(errors.power, deviation),
            difference,
        )

    def _frame_error(self, noise: dict[str, FloatArray], actual: FloatArray) -> FrameError:
        """Return the expected error, which depends on the noise and not on what is recorded."""
        task, system = self.task, self.system
        maps = error_map(task, system, actual, quick=self.execution.quick)
        variances = maps.variances
        self.execution.progress(0.7)
        resolved = 1 - variances.posterior.ravel() / maps.prior
        parts, missing = self._parts(noise, float(variances.noisy.mean())), float(variances.missing.mean())
        if task.finer > 1:
            parts[DETAIL] = min(self._by_detail(), missing)
        self.execution.progress(0.8)
        expected = ExpectedError(variances.variance, missing - parts.get(DETAIL, 0.0), parts, resolved)
        power = None if self.execution.quick else self._random_power(actual, expected.degrees_of_freedom)
        return FrameError(expected, maps, power)

    def _of_unknowns(self, truth: FloatArray) -> FloatArray:
        """Return a true image on the grid of the unknowns; one of f becomes a random world with its averages."""
        task = self.task
        if truth.size == task.model.unknowns:
            return truth
        mean, spectrum = task.prior.mean, 1 / np.asarray(task.precision_on(task.shape))
        drawn = mean + coloured(spectrum, probe(Purpose.DETAIL).normal(size=task.shape))
        left = (truth - task.of_f(drawn.ravel())).reshape(task.shape_of_f)
        return drawn.ravel() + world_of(left, spectrum, task.finer)

    def _by_detail(self) -> float:
        """Return the mean squared error by what f does not hold of a random world of the prior."""
        task, bands = self.task, self.quick_bands
        if bands is not None:
            return bands.detail_variance()
        rng, spectrum = probe(Purpose.DETAIL), 1 / np.asarray(task.precision_on(task.shape))
        squares = 0.0
        for _ in range(self._draws):
            world = task.draw_deviation(rng)
            world -= world_of(task.of_f(world).reshape(task.shape_of_f), spectrum, task.finer)
            squares += self._mean_square(task.observe(world))
        return squares / self._draws

    @property
    def quick_bands(self) -> Bands | None:
        """The camera's transfer functions where they are enough, None where random images are to be solved for."""
        return self.system.bands if self.execution.quick and not self._banded else None

    @property
    def _draws(self) -> int:
        """Number of random images for a mean over them."""
        return int(np.clip(DRAWN // self.task.model.unknowns, 1, MOST_DRAWS))

    def _mean_square(self, readings: FloatArray) -> float:
        """Return the mean square of f's pixels in A g; readings : (measurements used,) g."""
        return float(np.square(self.task.of_f(self._gain(readings))).mean())

    def _random_power(self, actual: FloatArray, freedoms: float) -> ResidualPower:
        """Return the expected squares of the residual, by solutions for random images and noise, of f0 as true image.

        freedoms : trace of A H of independent pixels
        """
        task, total, space = self.task, None, self.system.similar
        draws = max(self._draws, DRAWS) if task.model.unknowns <= MANY else 1
        as_expected = np.allclose(actual, task.expected_noise, rtol=1e-9)
        if as_expected and task.prior.kind == "independent" and actual.size > freedoms:
            total = actual.size - freedoms
        leverage = space.leverage if as_expected and isinstance(space, ReadingSpace) else None
        mean = np.zeros(task.model.unknowns)
        inputs = ResidualInputs(lambda image: image, task.draw_deviation, actual, mean, draws, leverage, total=total)
        columns = inputs.columns()
        next(columns)  # f0, of which no residual is left; the bias of another image takes its place
        residuals = chain([np.zeros(actual.size)], map(self._residual, islice(columns, draws)))
        power = inputs.power(chain(residuals, map(self._residual_of, columns)), task.expected_noise)
        return replace(power, bias=None)

    def _residual_power(self, power: ResidualPower | None, deviation: FloatArray | None) -> ResidualPower | None:
        """Return the expected squares of the residual for the true image f0 + `deviation`, (N,), if it is known."""
        if power is None:
            return None
        if deviation is None:
            return replace(power, bias=None, noise=None)
        bias = self.task.observe(self._hidden(deviation))  # (I - H A) H f
        np.square(bias, out=bias)
        bias /= self.task.expected_noise
        return replace(power, bias=bias)

    def _residual_of(self, deviation: FloatArray) -> FloatArray:
        """Return (I - H A) H f = H C P0^-1 f of an image less its mean: (measurements used,)."""
        return self.task.observe(self._solve(self.system.apply_prior_precision(deviation)))

    def _residual(self, column: FloatArray) -> FloatArray:
        """Return (I - H A) x: (measurements used,)."""
        observed = self.task.observe(self._gain(column))
        return np.subtract(column, observed, out=observed)

    def _hidden(self, deviation: FloatArray) -> FloatArray:
        """Return C P0^-1 f, what the estimate lacks of an image less its mean: of the true one for several purposes."""
        if self._lacking is None or not np.array_equal(self._lacking[0], deviation):
            self._lacking = deviation, self._solve(self.system.apply_prior_precision(deviation))
        return self._lacking[1]

    @property
    def _mean_accuracy(self) -> float:
        """The accuracy of solutions for means over the frame.

        The bound on the largest error of a pixel is sqrt(N) times the mean error or more.
        """
        task = self.task
        return max(task.settings.accuracy, MEAN_ACCURACY * task.model.unknowns**0.5 / task.finer)

    def _solve(self, right: FloatArray) -> FloatArray:
        """Return C b for a mean over the frame, to a mean error of a hundredth of a posterior standard deviation."""
        return self.system.solve(right, self._mean_accuracy).image

    def _gain(self, readings: FloatArray) -> FloatArray:
        """Return A g likewise: (measurements used,) to (unknowns,)."""
        return self._solve(self.system.right_hand_side(self.task.on_all_measurements(readings, 0.0)))

    def _solve_weights(self, weights: FloatArray) -> FloatArray:
        """Return C w of weights of the unknowns, to an accuracy relative to w^T C w."""
        return self.system.solve_weights(weights, self._mean_accuracy)

    def _variance_of_sum(self, weights: FloatArray, actual: FloatArray) -> float:
        """Eq. 5 of w^T f^."""
        solved = self.system.solve_weights(self.task.of_unknowns(weights), self.task.settings.accuracy)
        prior_part = float(solved @ self.system.apply_prior_precision(solved))
        return float(np.sum((prior_part, self._noise_part(solved, actual))))

    def _noise_part(self, solved: FloatArray, actual: FloatArray) -> float:
        """The part of Eq. 5 from noise of (measurements used,) variance `actual`, for c = C w."""
        return float(actual @ np.square(self.task.observe(solved) / self.task.expected_noise))

    def _transposed_gain(self, weights: FloatArray) -> FloatArray:
        """Return A^T w = Rv^-1 H C w: (unknowns,) to (measurements used,)."""
        if isinstance(self.system.similar, ReadingSpace):
            return self.system.similar.transposed_gain(weights)
        return self.task.observe(self._solve_weights(weights)) / self.task.expected_noise

    def _parts(self, noise: dict[str, FloatArray], mean: float) -> dict[str, float]:
        """Share of each cause of noise in the mean of Eq. 5; they add up to `mean`."""
        rng, bands = probe(Purpose.ERROR_PARTS), self.quick_bands
        parts: dict[str, float] = {}
        uniform: tuple[float, float] | None = None  # a uniform variance and its part
        for name, values in noise.items():
            if len(noise) == 1 or not values.any():
                parts[name] = float(values.any())
            elif bands is not None:
                parts[name] = bands.variances(1.0, mean_ratios(self.task, self.system.weights, values))[2]
            elif is_uniform(values) and uniform is not None:
                parts[name] = uniform[1] * float(values[0]) / uniform[0]
            else:
                random = (rng.normal(size=values.size) * np.sqrt(values) for _ in range(self._draws))
                parts[name] = sum(map(self._mean_square, random)) / self._draws
                uniform = (float(values[0]), parts[name]) if is_uniform(values) else uniform
        share = mean / (sum(parts.values()) or 1.0)
        return {name: part * share for name, part in parts.items()}

    def _interval(
        self,
        deviation: FloatArray,
        actual: FloatArray,
        expected: ExpectedError,
        map_error: float,
        variances: VarianceMap,
    ) -> Interval:
        """Interval of the mean squared error of the true image; that less its prior's mean is `deviation`."""
        task, system, count = self.task, self.system, expected.variance.size
        noisy = count * sum(part for name, part in expected.parts.items() if name != DETAIL)  # the world is known
        if self.quick_bands is not None:
            lost, variance = self._by_waves(self.quick_bands, deviation, actual, variances)
            return interval(lost + noisy, variance + (map_error * noisy) ** 2, count)
        bias = task.of_f(self._hidden(deviation))
        along = float(actual @ np.square(self._transposed_gain(task.of_unknowns(bias))))
        rng, squares = probe(Purpose.ERROR_INTERVAL), 0.0
        for _ in range(self._draws):
            gain = self._transposed_gain(task.of_unknowns(rng.normal(size=count)))
            right = system.right_hand_side(task.on_all_measurements(actual * gain, 0.0))
            squares += float(np.square(task.of_f(self._solve_weights(right))).sum()) / self._draws
        variance = 4 * along + 2 * squares + (map_error * noisy) ** 2
        return interval(float(bias @ bias) + noisy, variance, count)

    def _by_waves(
        self, bands: Bands, deviation: FloatArray, actual: FloatArray, variances: VarianceMap
    ) -> tuple[float, float]:
        """Return the square of the bias of a deviation, and the variance of the squared error, from waves.

        The covariance of errors by noise is taken to be that far from the edges, times the root of the map at both
        pixels.
        """
        noise = bands.noise_of_waves(1.0, mean_ratios(self.task, self.system.weights, actual))
        right = self.system.apply_prior_precision(deviation)
        bias = self.task.of_f(bands.solve(right.reshape(self.task.shape)).ravel()).reshape(bands.shape)
        local = variances.noisy.reshape(bands.shape) / noise.mean()
        waves: FloatArray = np.asarray(fft.dctn(bias * np.sqrt(local), 2, norm="ortho"), dtype=np.float64)
        along, squares = (noise * np.square(waves)).sum(), np.square(noise).sum() * np.square(local).mean()
        return float(np.square(bias).sum()), float(4 * along + 2 * squares)
