"""The estimate of a whole frame and its error, without a matrix of its size: by solutions of one linear system.

With c = C w, C the posterior covariance, Eq. 5 of a weighted sum w of pixels is c^T P0^-1 c + |Rvm^1/2 Rv^-1 H c|^2.
Shares of the mean error come from random noise images, whose squares have the right mean (Hutchinson 1990).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model

from ..estimator.estimate import Solver
from ..expected_error import ExpectedError, Interval, interval
from ..methods.method import (
    EstimationTask,
    Execution,
    Method,
    MethodResult,
    PosteriorOperators,
    is_uniform,
    residual_multipliers,
    total_variance,
)
from ..verdict.residual_power import ResidualInputs, ResidualPower
from .banded_system import BandedSystem, serves
from .conjugate_gradients import FrameSystem, Solution, posterior_operators
from .error_map import MANY, ErrorMap
from .preconditioner import is_sliding

NULL_SPACE = "the lens types leave a null space or see edges otherwise: K is factorised"
SEED = 20260401  # of random images of the error analysis, different from those of data and calibration
SOLVING = 0.3  # share of the time that the estimate takes; the error analysis takes the rest
DRAWS = 2  # of images and noise for the expected residual


class FrameMethod(Method):
    """Estimation of all pixels at once by conjugate gradients."""

    def __init__(self, task: EstimationTask, execution: Execution) -> None:
        """Raises InputError if the camera is not shift-invariant and too large, or a measurement has no noise."""
        super().__init__(task, execution)
        self._banded = serves(task.model.camera, task.prior.kind == "independent")
        for lens_type in task.model.camera.types:
            if not (self._banded or is_sliding(lens_type)):
                raise InputError(
                    f"estimator.method 'frame': lens type '{lens_type.name}' is no array of m x m sub-imagers with"
                    " step 1 and magnification 1/m, and the frame is too large for another solver, or its prior"
                    " correlated; set estimator.method = 'tiles'"
                )
        if not (task.expected_noise > 0).all():
            raise InputError(
                "estimator.method 'frame' needs noise in every measurement; set estimator.noise_variance above 0"
            )

    @cached_property
    def system(self) -> FrameSystem:
        """The linear system of the frame."""
        task = self.task
        if is_uniform(task.expected_noise) and task.complete:
            weights = np.broadcast_to(1 / task.expected_noise[:1], task.expected_noise.shape)
        else:
            weights = task.on_all_measurements(1 / task.expected_noise, 0.0)
        camera, prior, observation = task.model.camera, task.precision_on(task.shape), _without_matrix(task.model)
        if self._banded:
            return BandedSystem(camera, observation, weights, prior, task.model.matrix)
        return FrameSystem(camera, observation, weights, prior)

    @cached_property
    def solution(self) -> Solution:
        """The solution f^ - f0."""
        task = self.task
        recorded = task.recorded if task.complete else np.where(task.used, task.recorded, 0.0)
        mean = self.system.observation.forward(np.full(task.model.unknowns, task.prior.mean))
        right = self.system.right_hand_side(recorded - mean)
        return self.system.solve(right, task.settings.accuracy, lambda done: self.execution.progress(SOLVING * done))

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.solution.image + self.task.prior.mean

    def operators(self) -> PosteriorOperators:
        """Return the operators of the estimate, to a mean error of a hundredth of a posterior standard deviation."""
        return posterior_operators(self.system, self.task)

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        task, actual = self.task, total_variance(noise)
        solution = self.solution
        errors, check = ErrorMap.of(task, self.system, actual)
        variances, variance = errors.maps, errors.variance
        self.execution.progress(0.7)
        resolved = 1 - variances.posterior.ravel() / task.prior.variance
        self.execution.progress(0.8)
        parts = self._parts(noise, float(variances.noisy.mean()))
        self.execution.progress(0.9)
        expected = ExpectedError(variance, float(variances.missing.mean()), parts, resolved)
        given = None if truth is None else self._interval(truth - task.prior.mean, actual, expected, check.mean)
        solver = Solver(
            method="frame",
            why=NULL_SPACE if self._banded else "every lens type is shift-invariant except at the edges",
            condition=solution.condition,
            variance_bound=check.worst,
            bound=solution.bound,
            refinements=solution.steps,
            unit="posterior standard deviation",
        )
        multipliers = residual_multipliers(task, self.image)
        return MethodResult(
            self.image,
            multipliers,
            solver,
            expected,
            given,
            lambda weights: self._variance_of_sum(weights, actual),
            self._residual_power(actual, truth, expected.degrees_of_freedom),
        )

    def _residual_power(self, actual: FloatArray, truth: FloatArray | None, freedoms: float) -> ResidualPower:
        """Return the expected squares of the residual, by solutions for random images and noise.

        freedoms : trace of A H of independent pixels
        """
        task, system = self.task, self.system
        deviation = None if truth is None else truth - task.prior.mean
        draws = DRAWS if task.model.unknowns <= MANY else 1
        total = None
        as_expected = task.prior.kind == "independent" and np.allclose(actual, task.expected_noise, rtol=1e-9)
        if as_expected and actual.size > freedoms:
            total = actual.size - freedoms
        inputs = ResidualInputs(task.observe, task.draw_deviation, actual, deviation, draws, total=total)

        def residual(column: FloatArray) -> FloatArray:
            observed = task.observe(self._solve(system.right_hand_side(task.on_all_measurements(column, 0.0))))
            return np.subtract(column, observed, out=observed)

        return inputs.power(map(residual, inputs.columns()), task.expected_noise)

    def _solve(self, right: FloatArray) -> FloatArray:
        return self.system.solve(right, self.task.settings.accuracy).image

    def _variance_of_sum(self, weights: FloatArray, actual: FloatArray) -> float:
        """Eq. 5 of w^T f^."""
        solved = self._solve(weights)
        prior_part = float(solved @ self.system.apply_prior_precision(solved))
        return float(np.sum((prior_part, self._noise_part(solved, actual))))

    def _noise_part(self, solved: FloatArray, actual: FloatArray) -> float:
        """The part of Eq. 5 from noise of (measurements used,) variance `actual`, for c = C w."""
        return float(actual @ np.square(self._transposed_gain(solved)))

    def _transposed_gain(self, solved: FloatArray) -> FloatArray:
        """A^T w from c = C w: (measurements used,)."""
        readings = self.system.observation.forward(solved)
        readings *= self.system.weights
        return readings if self.task.complete else readings[self.task.used]

    def _parts(self, noise: dict[str, FloatArray], mean: float) -> dict[str, float]:
        """Share of each cause of noise in the mean of Eq. 5; they add up to `mean`."""
        rng = np.random.default_rng(SEED + 1)
        parts: dict[str, float] = {}
        uniform: tuple[float, float] | None = None  # a uniform variance and its part
        for name, values in noise.items():
            if len(noise) == 1 or not values.any():
                parts[name] = float(values.any())
            elif is_uniform(values) and uniform is not None:
                parts[name] = uniform[1] * float(values[0]) / uniform[0]
            else:
                random = rng.normal(size=values.size) * np.sqrt(values)
                solved = self._solve(self.system.right_hand_side(self.task.on_all_measurements(random, 0.0)))
                parts[name] = float(np.mean(np.square(solved)))
                uniform = (float(values[0]), parts[name]) if is_uniform(values) else uniform
        share = mean / (sum(parts.values()) or 1.0)
        return {name: part * share for name, part in parts.items()}

    def _interval(
        self, deviation: FloatArray, actual: FloatArray, expected: ExpectedError, map_error: float
    ) -> Interval:
        """Interval of the mean squared error of the true image; f - f0 is `deviation`, (N,)."""
        system, count = self.system, deviation.size
        bias = self._solve(system.apply_prior_precision(deviation))
        along = self._noise_part(self._solve(bias), actual)
        random = np.random.default_rng(SEED + 2).normal(size=count)
        gain = self._transposed_gain(self._solve(random))
        back = self._solve(system.right_hand_side(self.task.on_all_measurements(actual * gain, 0.0)))
        noisy = count * sum(expected.parts.values())
        variance = 4 * along + 2 * float(back @ back) + (map_error * noisy) ** 2
        return interval(float(bias @ bias) + noisy, variance, count)


def _without_matrix(model: Model) -> Model:
    """Return the model without its matrix if H is exact: averages over boxes are faster."""
    if not model.is_exact:
        return model
    no_entries = np.zeros(0)
    return Model(model.scene, model.camera, None, no_entries, np.zeros((0, 0), np.float32), {"method": "ideal"})
