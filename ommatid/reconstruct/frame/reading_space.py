"""C of few readings, by the covariance of these: C = P - P H^T S^-1 H P, S = H P H^T + Rv.

It is exact but for rounding, whatever the camera. As a preconditioner it makes one or two steps of conjugate gradients
do, and these state what rounding has left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, linalg

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors

from ..methods.method import EstimationTask
from .conjugate_gradients import FrameSystem
from .variance_map import Moments, moments

MOST_READINGS = 1_500  # up to which S takes a fraction of a second, and
MOST_UNKNOWNS = 32_000  # pixels of the world, up to which H P H^T takes some seconds


@dataclass(frozen=True)
class ReadingSpace:
    """C of a task with few readings; `noise` is Rv, (measurements used,)."""

    task: EstimationTask
    system: FrameSystem
    moments: Moments
    noise: FloatArray

    @staticmethod
    def serves(task: EstimationTask) -> bool:
        """Return True for the few readings of a world finer than f."""
        few = task.expected_noise.size <= MOST_READINGS and task.model.unknowns <= MOST_UNKNOWNS
        return task.finer > 1 and few

    @cached_property
    def is_regular(self) -> bool:
        """True if S is not singular in float64."""
        try:
            return bool(np.isfinite(self._factor[0]).all())
        except linalg.LinAlgError:
            return False

    @cached_property
    def _factor(self) -> tuple[FloatArray, bool]:
        return self.moments.factor(self.noise)

    @cached_property
    def leverage(self) -> FloatArray:
        """The diagonal of H A = I - Rv S^-1: (measurements used,)."""
        inverse = linalg.cho_solve(self._factor, np.eye(self.noise.size), check_finite=False)
        return 1 - self.noise * np.diagonal(inverse)

    def rounding(self, posterior: FloatArray) -> float:
        """Return a bound on the relative error of posterior variances, (N,), by rounding: that of both^T S^-1 both."""
        gain = np.asarray(linalg.cho_solve(self._factor, self.moments.both.T, check_finite=False))
        largest = float(np.trace(self.moments.readings)) + float(self.noise.max(initial=0.0))
        lost = np.finfo(float).eps * largest * np.square(gain).sum(axis=0)
        return float(np.divide(lost, posterior, out=np.ones_like(lost), where=posterior > 0).max())

    def solve(self, image: FloatArray, waves: FloatArray | None = None) -> FloatArray:
        """Return C b: (rows, columns) to (rows, columns)."""
        del waves
        spread = self._of_prior(image)
        back = self.system.observation.adjoint(self.task.on_all_measurements(self._weights(spread), 0.0))
        return spread - self._of_prior(back.reshape(image.shape))

    def transposed_gain(self, weights: FloatArray) -> FloatArray:
        """Return A^T w = S^-1 H P w: (unknowns,) to (measurements used,)."""
        return self._weights(self._of_prior(weights.reshape(self.task.shape)))

    def _weights(self, spread: FloatArray) -> FloatArray:
        """Return S^-1 H w: (rows, columns) to (measurements used,)."""
        return linalg.cho_solve(self._factor, self.task.observe(spread.ravel()), check_finite=False)

    def _of_prior(self, image: FloatArray) -> FloatArray:
        """Return P w: (rows, columns)."""
        waves = fft.dctn(image, 2, norm="ortho", workers=processors())
        waves /= self.system.prior
        return np.asarray(fft.idctn(waves, 2, norm="ortho", workers=processors(), overwrite_x=True))


def moments_of(task: EstimationTask) -> Moments:
    """Return the prior covariances of f's pixels and the readings that are used."""
    spectrum = np.broadcast_to(1 / np.asarray(task.precision_on(task.shape)), task.shape)
    return moments(task.model.to_sparse()[task.used], spectrum, task.finer)
