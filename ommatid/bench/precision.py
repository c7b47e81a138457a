"""What each way to the estimate costs and how right it is: dense forms, tiles of several sizes, the frame.

Errors are held against the exact answer, in posterior standard deviations of each pixel. That answer is a dense form's
after refinement, known to fifteen digits, or, of a frame, the same frame solved a hundred times more accurately.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.estimator.estimate import FORMS, estimate
from ommatid.reconstruct.estimator.memory import needed_memory
from ommatid.reconstruct.forms.form import NotSolvableError
from ommatid.reconstruct.frame.frame_method import FrameMethod
from ommatid.reconstruct.frame.preconditioner import is_sliding
from ommatid.reconstruct.method_choice import MAX_DENSE_PIXELS
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import free_memory
from ommatid.scenes.tables.estimation import TilesTable

from .table import ALONE

Vector = NDArray[np.float64]

SIZES = ((11, 2), (15, 3), (19, 4), (27, 6), (35, 8), (51, 12))  # of tiles, and of the border that is dropped
ACCURACIES = (1.0, 0.1, 0.01, 1e-3, 1e-4)  # that a frame is asked for
EXACTLY = 1e-6  # posterior standard deviations: of the answer that these are held against
EACH = 4e-12  # seconds, times the 3/2th power of the numbers that a form holds: about what it takes


@dataclass(frozen=True)
class SolverSetting:
    """One way with what is set of it; `guess`: about how many seconds it takes; `image`: the estimate, (N,)."""

    method: str
    setting: str
    guess: float
    image: Callable[[EstimationTask], Vector]


@dataclass(frozen=True)
class ExactSolution:
    """The right answer to one task, (N,), and the posterior standard deviation of each pixel, (N,)."""

    image: Vector
    deviation: Vector

    def error(self, image: Vector) -> float:
        """Root mean square over pixels, in posterior standard deviations of each; no less than float64 can tell."""
        told = np.spacing(np.abs(self.image) + np.abs(image)) / self.deviation
        return float(np.sqrt(np.mean(np.square((image - self.image) / self.deviation) + np.square(told))))


def is_dense(task: EstimationTask) -> bool:
    """Whether one dense problem serves."""
    return task.model.unknowns <= MAX_DENSE_PIXELS


def exact_solution(task: EstimationTask, deviation: Vector | None = None) -> ExactSolution:
    """The right answer; `deviation` where it is known already, since it does not depend on what was recorded.

    Raises InputError where there is no way to it.
    """
    told = task.settings.model_copy(update={"method": "auto", "accuracy": EXACTLY})
    way = (DenseMethod if is_dense(task) else FrameMethod)(replace(task, settings=told), Execution())
    if deviation is None:
        deviation = np.sqrt(way.result({"noise": task.expected_noise}, None).expected.variance)
    return ExactSolution(way.image, deviation)


def settings(task: EstimationTask) -> tuple[list[SolverSetting], list[tuple[str, str]]]:
    """What can be measured of this task, and what cannot, with the reason."""
    found, left_out = _forms(task), list[tuple[str, str]]()
    sliding, noisy = all(is_sliding(kind) for kind in task.model.camera.types), bool((task.expected_noise > 0).all())
    if not is_dense(task):
        left_out.append(("dense forms", f"{task.model.unknowns} pixels, up to {MAX_DENSE_PIXELS} are served"))
        if not (sliding and noisy):
            why = "too many pixels for a dense form, and no frame: there is no exact answer to hold estimates against"
            return [], [("reconstruct", why)]
    for size, overlap in SIZES:
        if size < min(task.shape):
            found.append(_tiles(size, overlap))
    if sliding and noisy:
        found += [_frame(task, accuracy) for accuracy in ACCURACIES]
    else:
        left_out.append(("frame", "it takes noise in every measurement, and lens types that see the same everywhere"))
    return found, left_out


def _forms(task: EstimationTask) -> list[SolverSetting]:
    """Each dense form by itself, and refined until its bound is below the tolerance."""
    if not is_dense(task):
        return []
    found: list[SolverSetting] = []
    correlated = task.prior.kind != "independent"
    for name in FORMS:
        needed = needed_memory(name, task.model.measurements, task.model.unknowns, correlated=correlated)
        guess = EACH * (needed / 8) ** 1.5

        def alone(task: EstimationTask, name: str = name) -> Vector:
            return _alone(task, name)

        def refined(task: EstimationTask, name: str = name) -> Vector:
            return _refined(task, name)

        found.append(SolverSetting(name, ALONE, guess, alone))
        found.append(SolverSetting(name, f"refined, tolerance {task.settings.tolerance:g}", 2 * guess, refined))
    return found


def _problem(task: EstimationTask) -> tuple[Problem, Vector]:
    problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
    return problem, task.recorded[task.used]


def _alone(task: EstimationTask, name: str) -> Vector:
    """Of a form as it is. Raises InputError where it cannot."""
    problem, recorded = _problem(task)
    needed = needed_memory(name, problem.measurements, problem.unknowns, correlated=not problem.prior.independent)
    if needed > free_memory():
        raise InputError(f"it needs {needed / 1e9:.1f} GB")
    try:
        with np.errstate(all="ignore"):  # of forms that lose all digits, which their error shows
            form = FORMS[name](problem)
            away = form.gain(recorded - problem.matrix @ problem.prior.mean)
    except NotSolvableError as error:
        raise InputError(str(error)) from error
    return problem.prior.mean + away


def _refined(task: EstimationTask, name: str) -> Vector:
    problem, recorded = _problem(task)
    return estimate(problem, recorded, name, task.settings.tolerance).image


def _tiles(size: int, overlap: int) -> SolverSetting:
    cut = TilesTable(size=size, overlap=overlap)

    def image(task: EstimationTask) -> Vector:
        return TileMethod(replace(task, tiles=cut), Execution()).image

    return SolverSetting("tiles", f"{size} less {overlap}", 1.0 + 4 * (size / 51) ** 4, image)


def _frame(task: EstimationTask, accuracy: float) -> SolverSetting:
    def image(task: EstimationTask) -> Vector:
        told = task.settings.model_copy(update={"accuracy": accuracy})
        return FrameMethod(replace(task, settings=told), Execution()).image

    return SolverSetting("frame", f"accuracy {accuracy:g}", 0.1 + 1e-5 * task.model.unknowns, image)
