"""Estimation of a frame in overlapping tiles, in parallel, and what tiles cost.

A pixel of a tile is estimated without the measurements beyond it. Where the lens types leave a null space these matter
over any distance, and the cost is a factor of several; where they leave none it is some percent. The cost is measured
in a window three times as large as a tile.

Operators of the estimate for means over the frame are those of the whole frame, which the estimate by tiles approaches
to a few hundredths.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import worker_pool
from ommatid.runtime.files import digest
from ommatid.runtime.machine import one_thread, processors

from ..expected_error import ExpectedError, interval
from ..frame.frame_method import FrameMethod
from ..frame.variance_map import is_narrow
from ..frame.windows import Windows
from ..output.run_json import SolverReport
from ..verdict.residual import ResidualInputs, ResidualPower
from .method import (
    EstimationTask,
    Execution,
    Method,
    MethodResult,
    PosteriorOperators,
    residual_multipliers,
    total_variance,
)
from .tile_solver import (
    SolvedTiles,
    Tile,
    TileTask,
    overlapping_tiles,
    solve_tiles,
    solve_tiles_single_threaded,
    transposed_gain,
)

NOTABLE = 1.1  # factor that is worth saying
MAX_TILES = 256  # in one task
MANY = 250_000  # pixels above which each draw takes long and few are enough
DRAWS, FEW_DRAWS = 8, 2  # of images and noise for the expected residual


def tile_cost(task: EstimationTask, variance: FloatArray) -> float | None:
    """Return the mean of (N,) variances of an estimate by tiles over that in the middle of a window of three tiles.

    The whole frame would make it a little larger. None for pixels that are correlated in the prior, for footprints
    that are not sharp, for measurements without noise, and where the frame is no larger than a tile.
    """
    size, noise = task.tiles.size, task.expected_noise
    if not is_narrow(task) or max(task.shape) <= size or not (noise > 0).all():
        return None
    windows = Windows(task, noise, (size, size), halo=size, beside=task.prior.variance)
    row, column = ((length - side) // 2 for length, side in zip(task.shape, windows.shape, strict=True))
    core = [slice((side - min(size, side)) // 2, (side + min(size, side)) // 2) for side in windows.shape]
    exact, *_ = windows.map(task.model.windowed, (row, column), tuple(core))
    tiled = variance.reshape(task.shape)[row + core[0].start :, column + core[1].start :]
    return float(tiled[: exact.shape[0], : exact.shape[1]].mean() / exact.mean())


def words(cost: float | None) -> str:
    """Return the cost in words, or "" where it is not worth saying."""
    if cost is None or cost < NOTABLE:
        return ""
    return f"; tiles cost about a factor of {cost:.2g} of the expected error here"


class TileMethod(Method):
    """Estimation tile by tile."""

    def __init__(self, task: EstimationTask, execution: Execution) -> None:
        """Raises InputError if no measurement fits into a tile, whose pixels would be the prior's mean."""
        super().__init__(task, execution)
        reach, size = task.model.windowed.reach, task.tiles.size
        if reach > size:
            raise InputError(
                f"estimator.method 'tiles': measurements of this camera see up to {reach} pixels of f, tiles have"
                f" {size}; raise tiles.size above {reach}, or set estimator.method to 'auto'"
            )

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        image, groups = np.empty(self.task.shape), self.groups({})
        for tiles, solved in zip(groups, self._solve(groups, {}, None), strict=True):
            for tile, values in zip(tiles, solved.image.T, strict=True):
                image[tile.core] = values.reshape(image[tile.core].shape)
        return image.ravel()

    def left_of_constant(self, value: float) -> None:
        """Return None: tiles are estimated one by one, and take the level for known."""

    def operators(self) -> PosteriorOperators | None:
        """Return the operators of the whole frame, None where a measurement has no noise."""
        noisy = (self.task.expected_noise > 0).all()
        return FrameMethod(self.task, self.execution, little_memory=True).operators() if noisy else None

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        task = self.task
        groups = self.groups(noise)
        inputs = self._residual_inputs(total_variance(noise), truth)
        deviations = None if inputs is None else inputs.block()
        results = self._solve(groups, noise, truth, deviations)
        responses = np.empty((*task.shape, 0 if inputs is None else inputs.count))
        image, variance, resolved = (np.empty(task.shape) for _ in range(3))
        missing, parts, sums = 0.0, dict.fromkeys(noise, 0.0), np.zeros(2)
        for tiles, solved in zip(groups, results, strict=True):
            if solved.expected is None:
                raise RuntimeError("actual noise was given, but no error was computed")
            expected = solved.expected
            share = expected.variance.size / image.size
            for index, tile in enumerate(tiles):
                shape = image[tile.core].shape
                image[tile.core] = solved.image[:, index].reshape(shape)
                variance[tile.core] = expected.variance.reshape(shape)
                resolved[tile.core] = expected.resolved.reshape(shape)
                if solved.responses is not None:
                    responses[tile.core] = solved.responses[:, index].reshape(*shape, -1)
                missing += share * expected.missing
                parts = {name: part + share * expected.parts[name] for name, part in parts.items()}
                sums += 0.0 if solved.given is None else solved.given[:, index]
        self.image_of_mean = image.ravel()
        cost = tile_cost(task, variance) if np.allclose(total_variance(noise), task.expected_noise, rtol=1e-9) else None
        return MethodResult(
            self.image_of_mean,
            residual_multipliers(task, self.image_of_mean),
            _worst([solved.solver for solved in results], len(groups), words(cost)),
            ExpectedError(variance.ravel(), missing, parts, resolved.ravel()),
            None if truth is None else interval(float(sums[0]), float(sums[1]), image.size),
            lambda weights: self._variance_of_sum(weights, total_variance(noise)),
            None if inputs is None or deviations is None else self._residual_power(inputs, deviations, responses),
        )

    def _residual_inputs(self, actual: FloatArray, truth: FloatArray | None) -> ResidualInputs | None:
        """Return the inputs of the expected residual, None where a measurement has no expected noise."""
        task = self.task
        if not task.expected_noise.size or not (task.expected_noise > 0).all():
            return None
        deviation = None if truth is None else truth - task.prior.mean
        draws = DRAWS if task.model.unknowns <= MANY else FEW_DRAWS
        return ResidualInputs(task.observe, task.draw_deviation, actual, deviation, draws, optimal=False)

    def _residual_power(self, inputs: ResidualInputs, deviations: FloatArray, responses: FloatArray) -> ResidualPower:
        """Return the expected squares of the residual from A applied to the deviations: (rows, columns, inputs)."""
        residuals = (
            deviations[:, number] - self.task.observe(np.ascontiguousarray(responses[..., number]).ravel())
            for number in range(inputs.count)
        )
        return inputs.power(residuals, self.task.expected_noise)

    def groups(self, noise: dict[str, FloatArray]) -> list[list[Tile]]:
        """Return the tiles in groups of at most MAX_TILES that share a factorisation."""
        alike: dict[object, list[Tile]] = {}
        for tile in self._tiles():
            alike.setdefault(self._key(tile, noise), []).append(tile)
        return [
            tiles[first : first + MAX_TILES] for tiles in alike.values() for first in range(0, len(tiles), MAX_TILES)
        ]

    def _tiles(self) -> list[Tile]:
        return overlapping_tiles(self.task.shape, self.task.tiles.size, self.task.tiles.overlap)

    def _solve(
        self,
        groups: list[list[Tile]],
        noise: dict[str, FloatArray],
        truth: FloatArray | None,
        deviations: FloatArray | None = None,
    ) -> list[SolvedTiles]:
        """Solve every group with one thread each, so that results do not depend on the workers."""
        tasks = (self._tile_task(tiles, noise, truth, deviations) for tiles in groups)  # lazily, to bound memory
        workers, progress = self.execution.workers, self.execution.progress
        if workers is not None:
            return workers.map(solve_tiles_single_threaded, tasks, progress, len(groups))
        with one_thread(), worker_pool(threads=processors()) as threads:
            return threads.map(solve_tiles, tasks, progress, len(groups))

    def _key(self, tile: Tile, noise: dict[str, FloatArray]) -> object:
        """A key that is equal for tiles with the same H, noise and core."""
        task = self.task
        inside = task.model.windowed.measurements_inside(*tile.window)
        index = task.among_used(task.used_inside(*tile.window))
        same = digest(task.used[inside], task.expected_noise[index], *(values[index] for values in noise.values()))
        return task.model.windowed.signature(*tile.window), tile.shape, tile.kept.tobytes(), same

    def _tile_task(
        self,
        tiles: list[Tile],
        noise: dict[str, FloatArray],
        truth: FloatArray | None,
        deviations: FloatArray | None = None,
    ) -> TileTask:
        task, first = self.task, tiles[0]
        inside = [task.used_inside(*tile.window) for tile in tiles]
        window = task.window(*first.window)
        true_image = None if truth is None else truth.reshape(task.shape)
        return TileTask(
            matrix=window.matrix,
            recorded=np.stack([task.recorded[numbers] for numbers in inside], axis=1),
            expected_noise=window.expected_noise,
            noise={name: values[window.index] for name, values in noise.items()},
            prior=task.prior_on(first.shape),
            kept=first.kept,
            settings=task.settings,
            truth=None if true_image is None else np.stack([true_image[tile.window].ravel() for tile in tiles], axis=1),
            deviations=None
            if deviations is None
            else np.stack([deviations[task.among_used(numbers)] for numbers in inside], axis=1),
        )

    def _variance_of_sum(self, weights: FloatArray, actual: FloatArray) -> float:
        """Return Eq. 5 of w^T f^; the A^T w of the tiles add up on the measurements that they share."""
        task, gain = self.task, np.zeros(self.task.expected_noise.size)
        image = weights.reshape(task.shape)
        for tile in self._tiles():
            inside = np.zeros_like(image)
            inside[tile.core] = image[tile.core]
            if inside.any():
                index = task.among_used(task.used_inside(*tile.window))
                gain[index] += transposed_gain(self._tile_task([tile], {}, None), inside[tile.window].ravel())
        unexplained = weights - task.model.adjoint(task.on_all_measurements(gain, 0.0))
        return task.prior_variance_of_sum(unexplained) + float(actual @ np.square(gain))


def _worst(solvers: list[SolverReport], factorisations: int, cost: str) -> SolverReport:
    worst = max(solvers, key=lambda solver: max(solver.bound or 0.0, solver.variance_bound))
    conditions = [solver.condition for solver in solvers if solver.condition is not None]
    return worst.model_copy(
        update={
            "method": f"tiles, {worst.method}",
            "why": f"each tile separately, {factorisations} factorisations{cost}",
            "condition": max(conditions) if len(conditions) == len(solvers) else None,
        }
    )
