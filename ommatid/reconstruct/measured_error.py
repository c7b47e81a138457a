"""The error of an estimate whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.constants import WHITE

TRIM = 2  # pixels of the border that trimmed errors leave out

SMALLEST_SSIM = 7  # pixels, the window of structural similarity


@dataclass(frozen=True)
class MeasuredError:
    """An estimate against the truth; None where the image is too small for the measure, or the error is zero."""

    mse: float
    trimmed_mse: float | None
    psnr: float | None
    ssim: float | None


def trimmed_mean(values: FloatArray, shape: tuple[int, int]) -> float | None:
    """Return the mean of a map, (N,), without its border of 2 pixels; None where nothing is left."""
    inner = values.reshape(shape)[TRIM:-TRIM, TRIM:-TRIM]
    return float(inner.mean()) if inner.size else None


def measure_error(estimate: FloatArray, truth: FloatArray, shape: tuple[int, int]) -> MeasuredError:
    """Return mean squared error, PSNR (peak 255) and structural similarity of an estimate, (N,), to the truth, (N,)."""
    squared = (estimate - truth) ** 2
    mse = float(squared.mean())
    psnr = 10 * float(np.log10(WHITE**2 / mse)) if mse > 0 else None
    ssim: float | None = None
    if min(shape) >= SMALLEST_SSIM:
        from skimage import metrics

        similarity = cast(Any, metrics).structural_similarity
        ssim = float(similarity(truth.reshape(shape), estimate.reshape(shape), data_range=WHITE))
    return MeasuredError(mse, trimmed_mean(squared, shape), psnr, ssim)
