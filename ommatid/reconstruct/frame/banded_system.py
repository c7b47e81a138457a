"""The precision of a frame as a banded matrix, factorised, for any array of lenses and any null space.

With independent pixels K = H^T Rv^-1 H + P0^-1 couples only pixels that one sensor pixel sees, so that its Cholesky
factor has a band as wide as a few lines of the frame. It serves frames of some ten thousand pixels whatever the lens
types leave open; conjugate gradients with a shift-invariant preconditioner serve larger ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera

from .conjugate_gradients import ACCURACY, FrameSystem, NotReachedError, Solution
from .preconditioner import is_sliding

Indices = NDArray[np.intp]

MOST_WORK = 1.2e11  # pixels times the square of the band: a minute or two with the error bars
MAX_REFINEMENTS = 4


@dataclass(frozen=True)
class BandedSystem(FrameSystem):
    """K of a frame of independent pixels; `matrix`, (M, N), is H."""

    matrix: sparse.csr_array

    @cached_property
    def precision(self) -> sparse.csr_array:
        """K: (N, N)."""
        information = self.matrix.T @ sparse.csr_array(self.matrix.multiply(self.weights[:, None]))
        diagonal = sparse.eye_array(self.matrix.shape[1], format="csr")
        return sparse.csr_array(information + float(np.asarray(self.prior)) * diagonal)

    @cached_property
    def _order(self) -> Indices:
        return shorter_side_first(self.shape)

    @cached_property
    def _factor(self) -> FloatArray:
        return banded_cholesky(self.precision, self._order)

    def solve(self, right: FloatArray, accuracy: float = ACCURACY, progress: Progress = no_progress) -> Solution:
        """Return C b with an error of at most `accuracy` posterior standard deviations in every pixel.

        Raises NotReachedError if rounding prevents it.
        """
        image, residual, bound, steps = np.zeros_like(right), right, np.inf, 0
        while steps <= MAX_REFINEMENTS and not bound <= accuracy:
            change = np.empty_like(right)
            change[self._order] = linalg.cho_solve_banded((self._factor, True), residual[self._order])
            image = image + change
            residual = right - self.apply(image)
            bound, steps = self._bound(residual), steps + 1
        if not bound <= accuracy:
            raise NotReachedError(
                f"the banded solver reached {bound:.2g} posterior standard deviations, expected {accuracy:g}; set"
                " estimator.method = 'tiles', or raise estimator.accuracy"
            )
        progress(1.0)
        largest = float(abs(self.precision).sum(axis=1).max())
        return Solution(image, steps, bound, largest / float(np.asarray(self.prior)))


def shorter_side_first(shape: tuple[int, int]) -> Indices:
    """Return the pixels of a frame in the order that makes the band of K narrow: (N,)."""
    numbers: Indices = np.arange(shape[0] * shape[1]).reshape(shape)
    return (numbers if shape[1] <= shape[0] else numbers.T).ravel()


def banded_cholesky(precision: sparse.csr_array, order: Indices) -> FloatArray:
    """Return the lower Cholesky factor of K with its pixels in this order, as SciPy stores bands: (width, N)."""
    ordered = sparse.coo_array(precision[order][:, order])
    below = ordered.row >= ordered.col
    row, column, values = ordered.row[below], ordered.col[below], ordered.data[below]
    band = np.zeros((int((row - column).max(initial=0)) + 1, ordered.shape[0]))
    band[row - column, column] = values
    return np.asarray(linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False))


def serves(camera: Camera, independent: bool) -> bool:
    """Return True where K of a frame is factorised: a null space or another array, few pixels, independent in P0."""
    sliding = all(is_sliding(lens_type) for lens_type in camera.types)
    if not camera.has_sharp_footprints:  # a blurred footprint may be as wide as the frame
        return False
    return independent and band_work(camera) <= MOST_WORK and not (sliding and not leaves_null_space(camera))


def band_work(camera: Camera) -> float:
    """Return the pixels times the square of the band: half the operations of a factorisation."""
    return camera.unknowns * float(band_width(camera)) ** 2


def band_width(camera: Camera) -> int:
    """Return the width of the band of K for the designed camera, without blur or distortion."""
    widest = max(ceil(lens_type.ratio) for lens_type in camera.types)
    return widest * (min(camera.shape) + 1)


def leaves_null_space(camera: Camera) -> bool:
    """Return True unless three lens types of pairwise coprime whole ratios, m x m each, see the frame.

    Two of them leave 2 (m - 1) (n - 1) dimensions and more (docs/equations.md), and errors that reach far.
    """
    ratios = {lens_type.ratio for lens_type in camera.types}
    whole = sorted(int(ratio) for ratio in ratios if ratio.denominator == 1)
    return (
        not any(
            np.gcd(a, b) == np.gcd(a, c) == np.gcd(b, c) == 1
            for i, a in enumerate(whole)
            for j, b in enumerate(whole[i + 1 :], i + 1)
            for c in whole[j + 1 :]
        )
        and 1 not in whole
    )
