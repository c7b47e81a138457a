"""Where the fit of a sub-imager's geometry starts: as designed, and as the moments of its entries suggest.

The middles of what the pixels see, against where the design puts them, give the shift, the magnification and the
rotation by least squares; their mean square widths give the blur, since that of an even disk of diameter b is b^2 / 16
along either axis, on top of what there is without it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager

from .geometry_model import BLUR, COLUMN, MAGNIFICATION, ROTATION, ROW, designed, entries

Vector = NDArray[np.float64]

WHOLE = 0.99  # of a pixel's light, that its middle and its width are to be trusted with
LEAST = 0.1  # pixels of f: a blur to start from


def starts(camera: Camera, sub: SubImager, measured: sparse.csr_array) -> list[Vector]:
    """Numbers to start from, (6,) each: as designed and by moments. measured : (pixels, N)."""
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
    found = plan.copy()
    away = intended[both] - np.array([float(at) for at in sub.type.middle(sub.window)])
    row, column = away.T
    ones, none = np.ones_like(row), np.zeros_like(row)
    # A view grows as its lens comes nearer to the sensor, and turns with the sensor.
    down, across = np.column_stack([ones, none, -row, column]), np.column_stack([none, ones, -column, -row])
    moved = (middle - intended)[both].T.ravel()
    numbers, *_ = np.linalg.lstsq(np.vstack([down, across]), moved, rcond=None)
    found[[ROW, COLUMN, MAGNIFICATION, ROTATION]] += numbers
    if not pinhole:
        grown = float((width[both] - least[both] * (1 - 2 * numbers[2])).mean())
        found[BLUR] = max(4 * max(grown, 0.0) ** 0.5, LEAST)
    return [plan, found]


def moments(matrix: sparse.csr_array, columns: int) -> tuple[Vector, Vector, NDArray[np.bool_]]:
    """Middles, (pixels, 2) in rows and columns of f, mean square widths along an axis, (pixels,), of rows of H.

    The last array tells whose light lands on the target, all but a hundredth.
    """
    light = matrix.sum(axis=1)
    share = np.maximum(light, np.finfo(float).tiny)
    row, column = (np.asarray(each, dtype=np.float64) for each in np.divmod(np.arange(matrix.shape[1]), columns))
    middle = np.column_stack([matrix @ row, matrix @ column]) / share[:, None] + 0.5
    square = (matrix @ (np.square(row + 0.5) + np.square(column + 0.5))) / share
    return middle, (square - np.square(middle).sum(axis=1)) / 2, light > WHOLE
