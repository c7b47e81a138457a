"""A prior of natural pictures for the check, fitted to a few small windows of the stack: seconds, whatever the size.

The errors of predictions hardly depend on it, since other sub-imagers see most of what one sees. It matters in
components of the image that one sub-imager alone sees.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import IntArray
from ommatid.scenes.tables.estimation import PriorTable

from ..fitting.evidence import Evidence
from ..fitting.prior_fit import MIN_MEASUREMENTS, fit_prior
from ..methods.method import EstimationTask

FIT_WINDOW = 16  # pixels, side of a window of narrow footprints
FIT_REACHES = 2  # footprints that fit side by side into a window
PER_AXIS = 3  # most windows along each axis


def fitted_prior(task: EstimationTask) -> PriorTable | None:
    """Return the exponential prior of largest evidence with the task's noise; None if measurements are too few."""
    side = max(FIT_WINDOW, FIT_REACHES * task.model.reach)
    windows = product(*(_spread(size, side) for size in task.shape))
    order: IntArray = np.cumsum(task.used) - 1
    blocks = [_window(task, order, rows, columns) for rows, columns in windows]
    residual = np.concatenate([block.residual for block in blocks])
    if residual.size < MIN_MEASUREMENTS or not residual.any():
        return None
    matrix = sparse.csr_array(sparse.block_diag([block.matrix for block in blocks], format="csr"))
    noise = np.concatenate([block.known_noise for block in blocks])
    fit = fit_prior(Evidence(matrix, residual, noise, task.shape, None, True), blocks)
    if fit.variance is None or fit.length is None:
        return None
    length = fit.length * task.model.camera.target_pitch
    update = {"kind": "exponential", "variance": fit.variance, "correlation_length": length, "exponent": None}
    return task.prior.model_copy(update=update)


def _spread(size: int, side: int) -> list[slice]:
    """Return windows of one axis in the middle of equal parts of it, or all of it where it is short."""
    count = min(size // side, PER_AXIS)
    if count <= 1:
        return [slice(0, size)]
    starts = (np.arange(count) + 0.5) * size / count - side / 2
    return [slice(int(start), int(start) + side) for start in starts]


def _window(task: EstimationTask, order: IntArray, rows: slice, columns: slice) -> Evidence:
    """Return the evidence of the used measurements inside a window; `order` numbers the used ones, (M,)."""
    inside = task.model.measurements_inside(rows, columns)
    used = task.used[inside]
    matrix, inside = task.model.submatrix(rows, columns)[used], inside[used]
    shape = rows.stop - rows.start, columns.stop - columns.start
    residual = task.recorded[inside] - task.prior.mean * matrix.sum(axis=1)
    return Evidence(matrix, residual, task.expected_noise[order[inside]], shape, None, True)
