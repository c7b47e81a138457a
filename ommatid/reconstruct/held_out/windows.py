"""The problems in which sub-imagers are predicted: the whole of a small target, or windows of a frame.

The windows of a frame do not overlap, and a window holds the measurements that see nothing outside it. So sums of
squares of different windows are independent where the pixels of the prior are, and a sub-imager's sums add up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.execution.cluster import worker_pool
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.camera import Camera

from ..frame.reading_space import ReadingSpace, moments_of
from ..methods.method import EstimationTask, Execution
from ..prior import Prior, covariance_root
from ..problem import Problem
from .block_errors import block_errors

Window = tuple[slice, slice]

MOST_WHOLE = 1700  # pixels of a target that is one window
WINDOW, WIDEST_WINDOW = 32, 60  # pixels, largest side of a window of a frame: of narrow and of wide footprints
REACHES = 3  # footprints that fit side by side into a window
LEAST_NOISE = 1e-3  # share of the expected noise that is independent, at least
MOST_WINDOWS = 8  # along each axis; of larger frames so many at equal distances


@dataclass(frozen=True)
class WindowProblem:
    """A problem with its measurements, and the sub-imager of each: (m,)."""

    problem: Problem
    recorded: FloatArray
    sub_imager: IntArray
    count: int


def windows(task: EstimationTask) -> tuple[list[Window], int]:
    """Return the windows of a task's target that are checked, and the number that would cover it."""
    shape = task.shape
    if ReadingSpace.serves(task) or shape[0] * shape[1] <= MOST_WHOLE:
        return [(slice(0, shape[0]), slice(0, shape[1]))], 1
    side = min(max(WINDOW, REACHES * task.model.windowed.reach), WIDEST_WINDOW)
    rows, columns = (_intervals(size, side) for size in shape)
    shown = product(_evenly(rows), _evenly(columns))
    return [(down, across) for down, across in shown], len(rows) * len(columns)


def held_out_sums(task: EstimationTask, execution: Execution) -> FloatArray:
    """Predict the used pixels of every sub-imager from all others: (3, sub-imagers).

    The rows are their number, the sums of the squares of their whitened errors, and of the diagonals of W; 0 where
    there are no others to predict from.
    """
    if ReadingSpace.serves(task):
        return _sums(_light(task))
    chosen, _ = windows(task)
    if len(chosen) == 1:
        return _sums(next(_problems(task, chosen)))
    with one_thread(), worker_pool(threads=processors()) as pool:
        parts = pool.map(_sums, _problems(task, chosen), execution.progress, len(chosen))
    return np.sum(parts, axis=0)


def _intervals(size: int, side: int) -> list[slice]:
    edges = np.linspace(0, size, -(-size // side) + 1).astype(int)
    return [slice(int(first), int(last)) for first, last in pairwise(edges)]


def _evenly(intervals: list[slice]) -> list[slice]:
    chosen = np.linspace(0, len(intervals) - 1, min(len(intervals), MOST_WINDOWS)).round()
    return [intervals[int(index)] for index in chosen]


def _sub_imager_of(camera: Camera, measurements: IntArray) -> IntArray:
    starts = np.array([pixels.start for pixels in camera.slices()])
    return np.searchsorted(starts, measurements, side="right") - 1


def without_shared(task: EstimationTask) -> FloatArray:
    """Return the expected noise less the errors of few numbers that it holds: (measurements used,)."""
    return np.maximum(task.expected_noise - task.shared_variance, LEAST_NOISE * task.expected_noise)


def _light(task: EstimationTask) -> WindowProblem:
    """Take the light on the pixels as what is measured; its prior covariance is H P H^T of the world."""
    camera, used = task.model.camera, np.flatnonzero(task.used)
    matrix = task.model.to_sparse()[used]
    level = _level(matrix, task).toarray()
    covariance, noise = moments_of(task).readings + level @ level.T, task.expected_noise
    directions = task.shared_directions
    if directions is not None:
        covariance += (directions @ directions.T).toarray()
        noise = without_shared(task)
    mean = matrix @ np.full(matrix.shape[1], task.prior.mean)
    problem = Problem(sparse.csr_array(sparse.eye_array(used.size)), Prior(mean, covariance_root(covariance)), noise)
    return WindowProblem(problem, task.recorded[used], _sub_imager_of(camera, used), len(camera.sub_imagers))


def _problems(task: EstimationTask, chosen: list[Window]) -> Iterator[WindowProblem]:
    """Yield the problem of every window, one at a time to bound memory.

    The level of the image, and errors of few numbers of H, which measurements of a sub-imager share, are unknowns of
    variance 1 beside the pixels. So a sub-imager whose readings are all off by what the numbers allow does not disagree
    with the others.
    """
    camera, used, prior_on = task.model.camera, np.flatnonzero(task.used), cache(task.prior_on)
    directions = None if task.shared_directions is None else sparse.csr_array(task.shared_directions)
    for rows, columns in chosen:
        window = task.window(rows, columns)
        noise = window.expected_noise if directions is None else without_shared(task)[window.index]
        level = _level(window.matrix, task)
        unknowns = [level, *([] if directions is None else [directions[window.index]])]
        matrix, prior = _with_unknowns(window.matrix, prior_on(window.shape), unknowns)
        sub_imager = _sub_imager_of(camera, used[window.index])
        yield WindowProblem(Problem(matrix, prior, noise), window.recorded, sub_imager, len(camera.sub_imagers))


def _level(matrix: sparse.csr_array, task: EstimationTask) -> sparse.csc_array:
    """Return what a standard deviation of the level of the image, 0 if it is known, does to the readings: (m, 1)."""
    return sparse.csc_array(matrix.sum(axis=1)[:, None] * task.prior.level_deviation)


def _with_unknowns(
    matrix: sparse.csr_array, prior: Prior, parts: Sequence[sparse.csc_array | sparse.csr_array]
) -> tuple[sparse.csr_array, Prior]:
    """Return H and the prior with an unknown of variance 1 for every column of L, (m, q) in parts, that is not 0."""
    directions = sparse.csc_array(sparse.hstack(parts, format="csc"))
    directions = directions[:, np.flatnonzero(np.diff(directions.indptr))]
    count = directions.shape[1]
    if not count:
        return matrix, prior
    if prior.independent:
        root: FloatArray = np.concatenate([prior.root, np.ones(count)])
    else:
        root = np.asarray(linalg.block_diag(prior.root, np.eye(count)))
    joined = sparse.csr_array(sparse.hstack([matrix, directions], format="csr"))
    return joined, Prior(np.concatenate([prior.mean, np.zeros(count)]), root, prior.rounding)


def _sums(window: WindowProblem) -> FloatArray:
    present = np.unique(window.sub_imager)
    blocks = [np.flatnonzero(window.sub_imager == index) for index in present]
    sums = np.zeros((3, window.count))
    if present.size < 2:  # nothing to predict from
        return sums
    errors = block_errors(window.problem, window.recorded, blocks)
    for index, block in zip(present, errors, strict=True):
        sums[:, index] = block.whitened.size, block.whitened @ block.whitened, block.precision.sum()
    return sums
