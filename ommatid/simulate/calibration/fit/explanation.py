"""Whether the numbers of a view explain the measured rows of H of a sub-imager: an F test.

The weighted sum of squares of the residuals of all entries, those that are zero included, is compared with that of the
batches, whose rays scatter as those of the mean do. The weights are those of independent rays, but where cells hold few
of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ommatid.runtime.arrays import FloatArray

from .chart import ChartRows

FEW = 8  # rays of a cell, below which its weight hardly grows: single rays there would decide
STRAY = 0.5  # rays that each cell may miss or have in excess, by rounding of positions to float32


@dataclass(frozen=True)
class Explanation:
    """Weighted sum of squared residuals, its expectation from the batches, and the degrees of freedom of the sums."""

    left: float
    expected: float
    freedom: float
    batches: int

    @property
    def chance(self) -> float:
        """Probability of a sum of squares at least as large if the model is correct."""
        return float(stats.f.sf(self.left / self.expected, self.freedom, self.freedom * (self.batches - 1)))


def explanation(chart: ChartRows, model: FloatArray, rays: int) -> Explanation:
    """Compare measured rows with those of a model, (pixels, W, V). rays : per pixel, of all passes."""
    weights = (rays / (model + FEW / rays)).ravel()
    residual = (chart.values - model).ravel()
    batches = chart.batches.reshape(len(chart.batches), -1)
    gram = np.asarray((batches * weights) @ batches.T, dtype=np.float64)
    count = len(gram)
    touched = ((model > 0) | (chart.values > 0)).ravel()
    floor = float(weights[touched].sum()) * (STRAY / rays) ** 2
    return Explanation(
        left=float(weights @ np.square(residual)),
        expected=float(np.trace(gram)) / (count * (count - 1)) + floor,
        freedom=min(_freedom(gram), float(residual.size)),
        batches=count,
    )


def _freedom(gram: FloatArray) -> float:
    """Return the effective degrees of freedom (tr S)^2 / tr S^2 of the covariance S, from the Gram matrix of draws.

    tr S^2 without bias from few draws: Bai and Saranadasa 1996, Statistica Sinica 6, 311.
    """
    free = len(gram) - 1
    trace, square = float(np.trace(gram)) / free, float(np.square(gram).sum()) / free**2
    squares = free**2 / ((free - 1) * (free + 2)) * (square - trace**2 / free)
    if trace == 0:
        return 1.0
    return max(1.0, trace**2 / max(squares, trace**2 * 1e-9))
