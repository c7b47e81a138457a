"""From a recorded stack and a model to the image, its error bars, and where its error comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.processors import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.workers import Workers
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables import estimation

from .assumptions import assumptions_for, with_fallback
from .estimator.estimate import Solver
from .expected_error import ExpectedError, Interval
from .fitting.prior_fit import PriorFit
from .method_choice import MethodChoice
from .methods.method import Execution, MethodResult
from .noise import UsablePixels
from .prediction import MeasuredError, compare, trimmed

Vector = NDArray[np.float64]

MOST_FEIGNED = 0.05  # of what is believed of a pixel on average: above it the expected error is not to be trusted
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration")


@dataclass(frozen=True)
class Residual:
    """Squares of what the estimate leaves of the measurements, in units of the expected noise, against expectation.

    expected : M - trace(A H) for images drawn from the prior;  deviation : of the sum by chance, at most
    """

    chi_squared: float
    expected: float
    deviation: float


@dataclass(frozen=True)
class Reconstruction:
    """An estimate with its expected error (Eq. 5), and how it compares where the truth is known.

    choice : which way to it;  prior : what was believed of the image, found or told
    noise : what is known of it by name, (pixels used,) each
    feigned : the share of what is believed of a pixel, on average, that the noise of H may have feigned
    """

    result: MethodResult
    choice: MethodChoice
    prior: estimation.PriorTable
    trimmed_mse: float | None
    residual: Residual | None
    shape: tuple[int, int]
    usable: UsablePixels
    noise: dict[str, Vector]
    fit: PriorFit | None
    spurious_information: float
    seconds: float
    truth: Vector | None
    error: MeasuredError | None

    @property
    def estimate(self) -> Vector:
        """f^, (N,)."""
        return self.result.image

    @property
    def expected(self) -> ExpectedError:
        """Eq. 5."""
        return self.result.expected

    @property
    def interval(self) -> Interval | None:
        """What the error of this very image should be."""
        return self.result.interval

    @property
    def solver(self) -> Solver:
        """What computed it, why, and how right it is."""
        return self.result.solver

    def budget(self) -> dict[str, float]:
        """Parts of the expected squared error by their cause; they add up to it, an absent effect brings 0."""
        parts = {"null_space": self.expected.missing, **self.expected.parts}
        return {name: parts.get(name, 0.0) for name in BUDGET} | parts

    def region(self, corner: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
        """Mean of the estimate in a region and its expected deviation (Eq. 5). Raises InputError if it lies outside."""
        check_region(corner, size, self.shape)
        weights = np.zeros(self.shape)
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / (size[0] * size[1])
        variance = self.result.variance_of_sum(weights.ravel())
        return float(weights.ravel() @ self.estimate), variance**0.5


def check_region(corner: tuple[int, int], size: tuple[int, int], shape: tuple[int, int]) -> None:
    """Raise InputError unless a region of `size` at `corner` lies inside an image of `shape`."""
    ends = corner[0] + size[0], corner[1] + size[1]
    if min(*corner) < 0 or min(*size) < 1 or ends[0] > shape[0] or ends[1] > shape[1]:
        raise InputError(
            f"a region of {size[0]} x {size[1]} pixels at row {corner[0]}, column {corner[1]} does not lie inside"
            f" an image of {shape[0]} x {shape[1]}"
        )


def check_match(stack: Stack, model: Model, names: tuple[Path | str, Path | str]) -> None:
    """Raise InputError, naming the first difference, unless a stack and a model are of one camera and target grid."""
    recorded, calibrated = stack.camera.describe(), model.camera.describe()
    for key in [*recorded, *(key for key in calibrated if key not in recorded)]:
        if recorded.get(key) != calibrated.get(key):
            raise InputError(
                f"{names[0]} and {names[1]} do not belong together: {key} is {recorded.get(key, 'absent')} in the"
                f" stack and {calibrated.get(key, 'absent')} in the model; calibrate with the stack's scene"
            )


@one_thread()
def restore(
    stack: Stack,
    model: Model,
    truth: Vector | None = None,
    workers: Workers | None = None,
    progress: Progress = no_progress,
) -> Reconstruction:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or None;  workers : who does tiles, absent: threads of this process
    Raises InputError if memory does not suffice, if no way is right to what the scene asks, or if the noise of a
    [sensor] is to be fitted.
    """
    return with_fallback(
        stack, model, lambda choice: _restored(stack, model, truth, choice, Execution(workers, progress))
    )


def _restored(
    stack: Stack, model: Model, truth: Vector | None, choice: MethodChoice, hands: Execution
) -> Reconstruction:
    start = perf_counter()
    told = assumptions_for(stack, model, choice, hands)
    way, usable, noise = told.method, told.usable, told.noise
    outcome = way.result(noise, truth)
    shape = model.camera.shape
    return Reconstruction(
        result=outcome,
        choice=choice,
        prior=told.prior,
        trimmed_mse=trimmed(outcome.expected.variance, shape),
        residual=_residual(outcome, way.task.expected_noise),
        shape=shape,
        usable=usable,
        noise=noise,
        fit=told.fit,
        spurious_information=_feigned(model, usable, way.task.expected_noise, outcome.expected),
        seconds=perf_counter() - start,
        truth=truth,
        error=None if truth is None else compare(outcome.image, truth, shape),
    )


def _feigned(model: Model, usable: UsablePixels, believed: Vector, expected: ExpectedError) -> float:
    if not model.variance.any():
        return 0.0
    noise = np.full(model.measurements, np.inf)
    noise[usable.used] = believed
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise and without uncertainty of H
        return float(np.nan_to_num(model.spurious_information(noise) * expected.variance).mean())


def _residual(outcome: MethodResult, believed: Vector) -> Residual | None:
    """None where a measurement is said to have no noise: then there is no unit for what is left of it."""
    if not believed.size or not (believed > 0).all():
        return None
    freedoms = max(believed.size - outcome.expected.degrees_of_freedom, 0.0)
    return Residual(float(believed @ np.square(outcome.multipliers)), freedoms, (2 * freedoms) ** 0.5)
