"""The estimate tile by tile: for frames that are too large for one dense problem, whatever their camera.

Its error is that of what it is: of every pixel estimated from the measurements of its tile alone.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.files import digest
from ommatid.runtime.pool import worker_pool
from ommatid.runtime.processors import one_thread, processors

from ..estimator.estimate import Solver
from ..expected_error import ExpectedError, Interval, interval
from .method import Method, MethodResult, Vector, is_one_number, residual_multipliers, total
from .tile_solver import SolvedTile, Tile, TileTask, cut, pulled, work, work_alone

MOST_TILES = 256  # in one piece


class TileMethod(Method):
    """By tiles."""

    def estimated(self) -> Vector:
        """f^ alone: (N,)."""
        found, groups = np.empty(self.task.shape), self.groups({})
        for tiles, done in zip(groups, self.done(groups, {}, None), strict=True):
            for tile, image in zip(tiles, done.image.T, strict=True):
                found[tile.core] = image.reshape(found[tile.core].shape)
        return found.ravel()

    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise is as given."""
        task = self.task
        groups = self.groups(noise)
        results = self.done(groups, noise, truth)
        image, variance, resolved = (np.empty(task.shape) for _ in range(3))
        missing, parts, sums = 0.0, dict.fromkeys(noise, 0.0), np.zeros(2)
        for tiles, done in zip(groups, results, strict=True):
            for place, tile in enumerate(tiles):
                for whole, values in (
                    (image, done.image[:, place]),
                    (variance, done.variance),
                    (resolved, done.resolved),
                ):
                    whole[tile.core] = values.reshape(whole[tile.core].shape)
                share = done.variance.size / image.size
                missing += share * done.missing
                parts = {name: part + share * done.parts[name] for name, part in parts.items()}
                sums += 0.0 if done.given is None else done.given[:, place]
        self.image = image.ravel()
        given: Interval | None = None if truth is None else interval(float(sums[0]), float(sums[1]), image.size)
        return MethodResult(
            self.image,
            residual_multipliers(task, self.image),
            _worst([done.solver for done in results], len(groups)),
            ExpectedError(variance.ravel(), missing, parts, resolved.ravel()),
            given,
            lambda weights: self._variance_of_sum(weights, total(noise)),
        )

    def groups(self, noise: dict[str, Vector]) -> list[list[Tile]]:
        """Tiles that share a factorisation, some at a time."""
        alike: dict[object, list[Tile]] = {}
        for tile in cut(self.task.shape, self.task.tiles.size, self.task.tiles.overlap):
            alike.setdefault(self._key(tile, noise), []).append(tile)
        return [
            tiles[first : first + MOST_TILES] for tiles in alike.values() for first in range(0, len(tiles), MOST_TILES)
        ]

    def done(self, groups: list[list[Tile]], noise: dict[str, Vector], truth: Vector | None) -> list[SolvedTile]:
        """What becomes of them; without noise, of the image alone.

        Each is computed by one thread, so that results do not depend on who does it.
        """
        pieces = (self._piece(tiles, noise, truth) for tiles in groups)  # each is made when somebody is free for it
        if self.hands.workers is not None:
            return self.hands.workers.map(work_alone, pieces, self.hands.progress, len(groups))
        with one_thread(), worker_pool(threads=processors()) as here:
            return here.map(work, pieces, self.hands.progress, len(groups))

    def _key(self, tile: Tile, noise: dict[str, Vector]) -> object:
        task = self.task
        varied = [values for values in (task.expected_noise, *noise.values()) if not is_one_number(values)]
        marks: list[str] = []
        if varied or not task.complete:
            numbers = task.model.measurements_inside(*tile.window)
            marks = [digest(task.used[numbers]), *(digest(values[self._places(numbers)]) for values in varied)]
        return task.model.signature(*tile.window), tile.shape, tile.kept.tobytes(), *marks

    def _piece(self, tiles: list[Tile], noise: dict[str, Vector], truth: Vector | None) -> TileTask:
        task, one = self.task, tiles[0]
        numbers = [task.model.measurements_inside(*tile.window) for tile in tiles]
        used = task.used[numbers[0]]
        some = self._places(numbers[0])
        whole = None if truth is None else truth.reshape(task.shape)
        return TileTask(
            matrix=task.model.submatrix(*one.window)[used],
            recorded=np.stack([task.recorded[found[task.used[found]]] for found in numbers], axis=1),
            believed=task.expected_noise[some],
            noise={name: values[some] for name, values in noise.items()},
            prior=task.prior_on(one.shape),
            kept=one.kept,
            told=task.settings,
            truth=None if whole is None else np.stack([whole[tile.window].ravel() for tile in tiles], axis=1),
            image_only=not noise,
        )

    def _places(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Where those of the measurements that are used stand among all that are."""
        if self.task.complete:
            return numbers
        return self._order[numbers[self.task.used[numbers]]]

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        return np.cumsum(self.task.used) - 1

    def _variance_of_sum(self, weights: Vector, actual: Vector) -> float:
        """Eq. 5 of w^T f^: the tiles' A^T w add up on the measurements that they share."""
        task, pull = self.task, np.zeros(self.task.expected_noise.size)
        grid = weights.reshape(task.shape)
        for tile in cut(task.shape, task.tiles.size, task.tiles.overlap):
            inside = np.zeros_like(grid)
            inside[tile.core] = grid[tile.core]
            if inside.any():
                places = self._places(task.model.measurements_inside(*tile.window))
                pull[places] += pulled(self._piece([tile], {}, None), inside[tile.window].ravel())
        left = weights - task.model.adjoint(task.over_all(pull, 0.0))
        return task.prior_spread(left) + float(actual @ np.square(pull))


def _worst(solvers: list[Solver], pieces: int) -> Solver:
    worst = max(solvers, key=lambda solver: max(solver.bound or 0.0, solver.variance_bound))
    condition = max(solver.condition for solver in solvers)
    why = f"each tile by itself, {pieces} factorisations"
    return replace(worst, method=f"tiles, {worst.method}", why=why, condition=condition)
