"""What tiles cost: the variance of their estimate against that of a window many times as large.

A pixel of a tile is estimated without the measurements beyond it. Where the lens types leave a null space these matter
over any distance, and the cost is a factor of several; where they leave none it is some percent.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray

from ..frame.banded_system import Indices, banded_cholesky, shorter_side_first
from .method import EstimationTask

TILES = 3  # sides of the window, in tiles
PIXELS = 12  # whose variances are compared
NOTABLE = 1.1  # factor that is worth saying
SEED = 20261122


def tile_cost(task: EstimationTask, variance: FloatArray) -> float | None:
    """Return the mean of (N,) variances of an estimate by tiles over that of the window, for pixels of its middle.

    The whole frame would make it a little larger. None for pixels that are correlated in the prior, for
    measurements without noise, and where the frame is no larger than a tile.
    """
    size = task.tiles.size
    if task.prior.kind != "independent" or max(task.shape) <= size or not (task.expected_noise > 0).all():
        return None
    if task.model.reach > size:  # footprints as wide as a tile leave K without a band
        return None
    sides = [min(TILES * size, length) for length in task.shape]
    rows, columns = (
        slice((length - side) // 2, (length + side) // 2) for length, side in zip(task.shape, sides, strict=True)
    )
    inside = task.model.measurements_inside(rows, columns)
    used = task.used[inside]
    matrix = task.model.submatrix(rows, columns)[used]
    weights = task.on_all_measurements(1 / task.expected_noise, 0.0)[inside][used]
    information = matrix.T @ sparse.csr_array(matrix.multiply(weights[:, None]))
    precision = sparse.csr_array(information + sparse.eye_array(matrix.shape[1], format="csr") / task.prior.variance)
    shape = rows.stop - rows.start, columns.stop - columns.start
    pixels = _middle_pixels(shape, size)
    exact = _variances(precision, shape, pixels)
    frame_rows, frame_columns = np.divmod(pixels, shape[1])
    tiled = variance.reshape(task.shape)[frame_rows + rows.start, frame_columns + columns.start]
    return float(tiled.mean() / exact.mean())


def words(cost: float | None) -> str:
    """Return the cost in words, or "" where it is not worth saying."""
    if cost is None or cost < NOTABLE:
        return ""
    return f"; tiles cost about a factor of {cost:.2g} of the expected error here"


def _middle_pixels(shape: tuple[int, int], size: int) -> Indices:
    rng = np.random.default_rng(SEED)
    row, column = (
        rng.integers((length - min(size, length)) // 2, (length + min(size, length)) // 2, PIXELS) for length in shape
    )
    return row * shape[1] + column


def _variances(precision: sparse.csr_array, shape: tuple[int, int], pixels: Indices) -> FloatArray:
    """Return the diagonal of K^-1 at some pixels."""
    order = shorter_side_first(shape)
    place = np.empty_like(order)
    place[order] = np.arange(order.size)
    unit = np.zeros((order.size, pixels.size))
    columns = np.arange(pixels.size)
    unit[place[pixels], columns] = 1.0
    factor = banded_cholesky(precision, order)
    solved = np.asarray(linalg.cho_solve_banded((factor, True), unit, check_finite=False))
    return solved[place[pixels], columns]
