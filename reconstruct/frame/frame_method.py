"""The estimate of a whole frame and its error, without a matrix of its size: everything is solutions of one system.

With c = C w, C the posterior covariance, Eq. 5 of a weighted sum w of pixels is c^T P0^-1 c + |Rvm^1/2 Rv^-1 H c|^2.
Parts of the mean come from images of noise chosen by chance, whose squares have the right mean (Hutchinson 1990).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model

from ..estimator.estimate import Solver
from ..expected_error import ExpectedError, Interval, interval
from ..methods.method import (
    EstimationTask,
    Execution,
    Image,
    Method,
    MethodResult,
    Vector,
    is_one_number,
    residual_multipliers,
    total,
)
from .conjugate_gradients import FrameSystem, Solution
from .preconditioner import Preconditioner, is_sliding
from .selected_inverse import frame_variances
from .variance_map import VarianceMap, maps, posterior_map, sliding_maps, small_map, small_shape

SEED = 20260401  # of images of chance for the analysis of errors, which data and calibration never see
MANY = 250_000  # pixels, above which neither every variance nor more than a few probes are worth their time
SOLVING = 0.3  # of the time, for the estimate; its error bars and what they consist of take the rest
PROBES = 6  # pixels whose variance is computed exactly, to say how right the map is
FEW = 2
HALO = 5  # boxes of the widest type, beyond which pixels make no difference to a variance


class FrameMethod(Method):
    """By conjugate gradients on all pixels at once."""

    def __init__(self, task: EstimationTask, hands: Execution) -> None:
        """Raises InputError where the camera does not see the same everywhere, or a measurement has no noise."""
        super().__init__(task, hands)
        camera = task.model.camera
        for kind in camera.types:
            if not is_sliding(kind):
                raise InputError(
                    f"estimator.method 'frame': lens type '{kind.name}' is no array of m x m sub-imagers with step 1"
                    " and magnification 1/m; take estimator.method = 'tiles'"
                )
        if not (task.expected_noise > 0).all():
            raise InputError(
                "estimator.method 'frame' needs noise in every measurement; set estimator.noise_variance above 0"
            )

    @cached_property
    def frame(self) -> FrameSystem:
        """The system."""
        task = self.task
        if is_one_number(task.expected_noise) and task.complete:
            weights = np.broadcast_to(1 / task.expected_noise[:1], task.expected_noise.shape)
        else:
            weights = task.over_all(1 / task.expected_noise, 0.0)
        return FrameSystem(task.model.camera, _observation(task.model), weights, task.precision_on(task.shape))

    @cached_property
    def solution(self) -> Solution:
        """f^ - f0."""
        task = self.task
        recorded = np.where(task.used, task.recorded, 0.0) if not task.complete else task.recorded
        away = recorded - self._mean_seen
        return self.frame.solve(
            self.frame.collected(away), task.settings.accuracy, lambda done: self.hands.progress(SOLVING * done)
        )

    @cached_property
    def _mean_seen(self) -> Vector:
        return self.frame.observation.forward(np.full(self.task.model.unknowns, self.task.prior.mean))

    def estimated(self) -> Vector:
        """f^ alone: (N,)."""
        return self.solution.image + self.task.prior.mean

    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise is as given."""
        task, actual = self.task, total(noise)
        solution = self.solution
        found = self._maps(noise)
        self.hands.progress(0.7)
        variance = np.maximum(found.missing + found.noisy, 0.0).ravel()
        doubt = self._doubt(variance, actual)
        resolved = 1 - found.posterior.ravel() / task.prior.variance
        self.hands.progress(0.8)
        parts = self._parts(noise, float(found.noisy.mean()))
        self.hands.progress(0.9)
        expected = ExpectedError(variance, float(found.missing.mean()), parts, resolved)
        given = None if truth is None else self._given(truth - task.prior.mean, actual, expected, doubt)
        solver = Solver(
            method="frame",
            why="every lens type sees the same everywhere, but for the edges",
            condition=solution.condition,
            variance_bound=doubt,
            bound=solution.bound,
            refinements=solution.steps,
            unit="posterior standard deviation",
        )
        multipliers = residual_multipliers(task, self.image)
        return MethodResult(
            self.image, multipliers, solver, expected, given, lambda weights: self._spread(weights, actual)
        )

    def _spread(self, weights: Vector, actual: Vector) -> float:
        """Eq. 5 of w^T f^."""
        return float(np.sum(self._both(self.frame.solve(weights, self.task.settings.accuracy).image, actual)))

    def _both(self, solved: Vector, actual: Vector) -> tuple[float, float]:
        """For c = C w the prior's part of Eq. 5 and that of noise of (pixels used,) variance `actual`."""
        pulled = self._pulled(solved)
        return float(solved @ self.frame.expected(solved)), float(actual @ np.square(pulled))

    def _pulled(self, solved: Vector) -> Vector:
        """A^T w from c = C w: (pixels used,)."""
        pulled = self.frame.observation.forward(solved)
        pulled *= self.frame.weights
        return pulled if self.task.complete else pulled[self.task.used]

    def _maps(self, noise: dict[str, Vector]) -> VarianceMap:
        even = self._even(noise)
        if not even and self.task.model.unknowns <= MANY and isinstance(self.frame.prior, float):
            return self._exact_maps(total(noise))
        found = sliding_maps(self.frame.nearby, self._by_type(total(noise)), self._map)
        if even:
            return found
        local = self._local_noise().reshape(self.task.shape)
        return VarianceMap(found.posterior * local, found.missing * local, found.noisy * local)

    def _exact_maps(self, actual: Vector) -> VarianceMap:
        """Of whatever H and noise, pixel by pixel, from strips of the frame."""
        task, weights, prior = self.task, self.frame.weights, float(np.asarray(self.frame.prior))
        widest = max(int(kind.ratio) for kind in task.model.camera.types)
        told = _gram(task.model.matrix, weights)
        as_told = np.allclose(actual, task.expected_noise, rtol=1e-12)
        most = float(np.max(actual / task.expected_noise)) or 1.0
        spread = told if as_told else _gram(task.model.matrix, weights**2 * task.over_all(actual, 0.0)) / most

        def moved(by_prior: float, by_noise: float) -> Image:
            changed: Any = told.copy()  # SciPy's stubs know no sums of sparse arrays
            changed += (1 + by_prior) * prior * sparse.eye_array(told.shape[0])
            if by_noise:
                changed += by_noise * cast(Any, spread)
            return frame_variances(sparse.csr_array(changed), task.shape, task.model.reach - 1, HALO * widest)

        found = maps(moved, as_told=as_told)
        return found if as_told else replace(found, noisy=most * found.noisy)

    def _map(self, frame: Preconditioner) -> Image:
        if not isinstance(frame.prior, np.ndarray):
            return posterior_map(frame)
        changed = float(frame.prior.flat[0]) / float(np.ravel(self.frame.prior)[0])
        return small_map(frame, changed * np.array(self.task.precision_on(small_shape(frame.shape))))

    def _even(self, noise: dict[str, Vector]) -> bool:
        """Whether H is perfect and the noise of each type one number, as is what is expected of it."""
        if not (self.task.model.is_exact and self.task.complete):
            return False
        parts = [
            one[place]
            for one in (self.task.expected_noise, *noise.values())
            for place in self.task.model.camera.type_slices()
        ]
        return all(is_one_number(part) or bool(np.ptp(part) <= 1e-9 * part.max()) for part in parts)

    def _local_noise(self) -> Vector:
        """How much more noise there is in what sees a pixel than on average: (N,)."""
        near = self._over_types(list(self.frame.nearby.weights))
        here, average = self.frame.observation.adjoint(self.frame.weights), self.frame.observation.adjoint(near)
        return np.divide(average, here, out=np.ones_like(here), where=here > 0)

    def _by_type(self, values: Vector) -> tuple[float, ...]:
        everywhere = self.task.over_all(values, np.nan)
        return tuple(float(np.nanmean(everywhere[place])) for place in self.task.model.camera.type_slices())

    def _over_types(self, numbers: list[float]) -> Vector:
        found = np.empty(self.task.model.measurements)
        for place, number in zip(self.task.model.camera.type_slices(), numbers, strict=True):
            found[place] = number
        return found

    def _doubt(self, variance: Vector, actual: Vector) -> float:
        """How far the map is from the exact error of some pixels, at most: relative."""
        rng = np.random.default_rng(SEED)
        rows, columns = self.task.shape
        worst = 0.0
        for number in range(PROBES if variance.size <= MANY else FEW):
            row = int(rng.integers(rows)) if number % 2 else int(rng.integers(min(4, rows)))  # every other near an edge
            pixel = row * columns + int(rng.integers(columns))
            unit = np.zeros_like(variance)
            unit[pixel] = 1.0
            worst = max(worst, abs(variance[pixel] / self._spread(unit, actual) - 1))
        return worst

    def _parts(self, noise: dict[str, Vector], mean: float) -> dict[str, float]:
        """What each noise brings to the mean of Eq. 5; together they are `mean`."""
        rng, frame = np.random.default_rng(SEED + 1), self.frame
        parts: dict[str, float] = {}
        alike: tuple[float, float] | None = None  # one number for all pixels, and what it brings
        for name, values in noise.items():
            if len(noise) == 1 or not values.any():
                parts[name] = float(values.any())
            elif is_one_number(values) and alike is not None:
                parts[name] = alike[1] * float(values[0]) / alike[0]
            else:
                random = rng.normal(size=values.size) * np.sqrt(values)
                solved = frame.solve(
                    frame.collected(self.task.over_all(random, 0.0)), self.task.settings.accuracy
                ).image
                parts[name] = float(np.mean(np.square(solved)))
                alike = (float(values[0]), parts[name]) if is_one_number(values) else alike
        share = mean / (sum(parts.values()) or 1.0)
        return {name: part * share for name, part in parts.items()}

    def _given(self, away: Vector, actual: Vector, expected: ExpectedError, doubt: float) -> Interval:
        """What the mean squared error of this very image should be; f - f0 is `away`, (N,)."""
        frame, count = self.frame, away.size
        bias = frame.solve(frame.expected(away), self.task.settings.accuracy).image
        _, along = self._both(frame.solve(bias, self.task.settings.accuracy).image, actual)
        random = np.random.default_rng(SEED + 2).normal(size=count)
        pulled = self._pulled(frame.solve(random, self.task.settings.accuracy).image)
        back = frame.solve(frame.collected(self.task.over_all(actual * pulled, 0.0)), self.task.settings.accuracy).image
        noisy = count * sum(expected.parts.values())
        variance = 4 * along + 2 * float(back @ back) + (doubt * noisy) ** 2
        return interval(float(bias @ bias) + noisy, variance, count)


def _observation(model: Model) -> Model:
    """H without its matrix where it is perfect: averages over boxes are faster."""
    return _perfect(model) if model.is_exact else model


def _perfect(model: Model) -> Model:
    nothing = np.zeros(0)
    return Model(model.scene, model.camera, None, nothing, np.zeros((0, 0), np.float32), {"method": "ideal"})


def _gram(matrix: sparse.csr_array, weights: Vector) -> sparse.csr_array:
    return sparse.csr_array(matrix.T @ sparse.csr_array(matrix.multiply(weights[:, None])))
