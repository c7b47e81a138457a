"""Starting points of the fit of a sub-imager's geometry: its design, and an estimate from moments of its entries.

The centroids of the pixels' footprints, compared with the design, give the shift, the magnification and the rotation by
least squares; their mean square widths give the blur, since a uniform disk of diameter b adds b^2 / 16 along each axis.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager

from .geometry_model import BLUR, COLUMN, MAGNIFICATION, ROTATION, ROW, designed, entries

WHOLE = 0.99  # of a pixel's light that has to land on the target for its moments to be used
LEAST = 0.1  # pixels of f: a blur to start from


def starts(camera: Camera, sub: SubImager, measured: sparse.csr_array) -> list[FloatArray]:
    """Return starting parameters, (6,) each, as designed and by moments. measured : (pixels, N)."""
    plan = designed(camera, sub)
    sharp = plan.copy()
    sharp[BLUR] = 0.0
    pinhole = sub.type.optics.aperture is None and sub.type.optics.surfaces is None
    middle, width, whole = moments(measured, camera.columns)
    try:
        intended, least, inside = moments(entries(camera, sub, sharp), camera.columns)
    except InputError:
        return [plan]
    if not pinhole:
        plan[BLUR] = max(plan[BLUR], LEAST)
    both = whole & inside
    if both.sum() < 3:
        return [plan]
    estimate = plan.copy()
    away = intended[both] - np.array([float(at) for at in sub.type.middle(sub.window)])
    row, column = away.T
    ones, none = np.ones_like(row), np.zeros_like(row)
    # A view grows as its lens comes nearer to the sensor, and turns with the sensor.
    down, across = np.column_stack([ones, none, -row, column]), np.column_stack([none, ones, -column, -row])
    moved = (middle - intended)[both].T.ravel()
    numbers, *_ = np.linalg.lstsq(np.vstack([down, across]), moved, rcond=None)
    estimate[[ROW, COLUMN, MAGNIFICATION, ROTATION]] += numbers
    if not pinhole:
        grown = float((width[both] - least[both] * (1 - 2 * numbers[2])).mean())
        estimate[BLUR] = max(4 * max(grown, 0.0) ** 0.5, LEAST)
    return [plan, estimate]


def moments(matrix: sparse.csr_array, columns: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return moments of rows of H: centroids, (pixels, 2) in rows and columns of f, and mean square widths, (pixels,).

    The last array is True for pixels with at least 99 % of their light on the target.
    """
    light = matrix.sum(axis=1)
    share = np.maximum(light, np.finfo(float).tiny)
    row, column = (np.asarray(each, dtype=np.float64) for each in np.divmod(np.arange(matrix.shape[1]), columns))
    middle = np.column_stack([matrix @ row, matrix @ column]) / share[:, None] + 0.5
    square = (matrix @ (np.square(row + 0.5) + np.square(column + 0.5))) / share
    return middle, (square - np.square(middle).sum(axis=1)) / 2, light > WHOLE
