"""Norms and relative errors of columns without overflow, and the pixels whose variances are checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray

Indices = NDArray[np.intp]
Residuals = tuple[FloatArray, FloatArray]

ALL_CHECKED = 128  # pixels, up to which every variance is checked
SAMPLE = 16  # pixels checked beyond that
LEAST_FLOAT = 2.0**-1074  # the smallest float64 above 0
NEGLIGIBLE_VARIANCE = 1e-28  # relative to the prior variance: smaller posterior variances count as 0


def sampled_pixels(variance: FloatArray, prior: FloatArray) -> Indices:
    """Return the pixels whose variances are checked: those of extreme variance, and random others."""
    if variance.size <= ALL_CHECKED:
        return np.arange(variance.size)
    ratio = np.divide(variance, prior, out=np.ones_like(variance), where=prior > 0)
    extremes = [variance.argmin(), variance.argmax(), ratio.argmin(), ratio.argmax()]
    others = np.random.default_rng(2).choice(variance.size, SAMPLE - len(extremes), replace=False)
    return np.concatenate([extremes, others])


def norms(values: FloatArray) -> FloatArray:
    """The 2-norm of every column, without overflow: (q,)."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    scale = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    return scale * np.linalg.norm(values / scale, axis=0)


def infinite(pairs: tuple[Residuals, Residuals]) -> FloatArray:
    """Infinity for every column with a value other than 0, else 0: (q,)."""
    return np.where(np.any([part.any(axis=0) for pair in pairs for part in pair], axis=0), np.inf, 0.0)


def relative(error: FloatArray, size: FloatArray) -> FloatArray:
    """Return error / size, 0 where both are 0."""
    return np.divide(error, size, out=np.where(error == 0, 0.0, np.inf), where=size > 0)  # NaN is not 0


def worst(bound: FloatArray) -> float:
    """Return the largest bound; NaN counts as infinite."""
    return float(np.nan_to_num(bound, nan=np.inf, posinf=np.inf).max(initial=0.0))


def last_digit(variance: FloatArray) -> float:
    """Return the smallest float64 relative to the least variance above 0."""
    least = float(variance[variance > 0].min(initial=np.inf))
    return LEAST_FLOAT / least
