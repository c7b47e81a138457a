"""Cost and numerical error of the solvers: the dense one, tiles of several sizes, and the frame.

Errors are relative to the exact solution, in posterior standard deviations of each pixel. The exact solution is the
dense one, refined to fifteen digits, or, for a frame, the same frame solved to a much higher accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.frame.frame_method import FrameMethod
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.tables.estimation import TilesTable

from .table import DENSE, SkippedJob

TILE_SIZES = ((11, 2), (15, 3), (19, 4), (27, 6), (35, 8), (51, 12))  # sides, and widths of the border that is dropped
ACCURACIES = (1.0, 0.1, 0.01, 1e-3, 1e-4)  # estimator.accuracy of a frame
EXACT_ACCURACY = 1e-6  # of the exact solution for a frame, in posterior standard deviations


@dataclass(frozen=True)
class SolverSetting:
    """One setting of a solver; `image` computes the estimate, (N,)."""

    method: str
    setting: str
    image: Callable[[EstimationTask], FloatArray]


@dataclass(frozen=True)
class ExactSolution:
    """Exact solution of a task, (N,), and the posterior standard deviation of each pixel, (N,)."""

    image: FloatArray
    deviation: FloatArray

    def error(self, image: FloatArray) -> float:
        """Return the RMS difference in posterior standard deviations, at least the resolution of float64."""
        resolution = np.spacing(np.abs(self.image) + np.abs(image)) / self.deviation
        return float(np.sqrt(np.mean(np.square((image - self.image) / self.deviation) + np.square(resolution))))


def is_dense(task: EstimationTask) -> bool:
    """Return True if a single dense problem is small enough."""
    return task.model.unknowns <= MOST_DENSE


def exact_solution(task: EstimationTask, deviation: FloatArray | None = None) -> ExactSolution:
    """Return the exact solution.

    deviation : the posterior standard deviations if already known; they do not depend on the recorded values
    Raises InputError if no method applies to the task.
    """
    exact = replace(task, settings=task.settings.model_copy(update={"method": "auto", "accuracy": EXACT_ACCURACY}))
    method = (DenseMethod if is_dense(task) else FrameMethod)(exact, Execution())
    if deviation is None:
        deviation = np.sqrt(method.result({"noise": task.expected_noise}, None).expected.variance)
    return ExactSolution(method.image, deviation)


def solver_settings(task: EstimationTask) -> tuple[list[SolverSetting], list[SkippedJob]]:
    """Return the settings that can be measured for this task, and those that cannot, with the reason."""
    measurable, left_out = list[SolverSetting](), list[SkippedJob]()
    has_frame = task.model.camera.is_sliding and bool((task.expected_noise > 0).all())
    if is_dense(task):
        measurable.append(SolverSetting(DENSE, f"tolerance {task.settings.tolerance:g}", _dense_image))
    else:
        left_out.append(SkippedJob(what=DENSE, why=f"{task.model.unknowns} pixels, and the limit is {MOST_DENSE}"))
        if not has_frame:
            why = "too many pixels for one dense problem, and a frame does not apply: there is no exact solution"
            return [], [SkippedJob(what="reconstruct", why=why)]
    measurable += [_tile_setting(size, overlap) for size, overlap in TILE_SIZES if size < min(task.shape)]
    if has_frame:
        measurable += [_frame_setting(accuracy) for accuracy in ACCURACIES]
    else:
        why = "it needs noise in every measurement, and lens types with the same view everywhere"
        left_out.append(SkippedJob(what="frame", why=why))
    return measurable, left_out


def _dense_image(task: EstimationTask) -> FloatArray:
    problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
    return estimate(problem, task.recorded[task.used], task.settings.tolerance).image


def _tile_setting(size: int, overlap: int) -> SolverSetting:
    tiles = TilesTable(size=size, overlap=overlap)

    def image(task: EstimationTask) -> FloatArray:
        return TileMethod(replace(task, tiles=tiles), Execution()).image

    return SolverSetting("tiles", f"{size} less {overlap}", image)


def _frame_setting(accuracy: float) -> SolverSetting:
    def image(task: EstimationTask) -> FloatArray:
        settings = task.settings.model_copy(update={"accuracy": accuracy})
        return FrameMethod(replace(task, settings=settings), Execution()).image

    return SolverSetting("frame", f"accuracy {accuracy:g}", image)
