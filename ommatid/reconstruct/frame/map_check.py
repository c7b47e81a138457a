"""The error of a map of variances, measured at random pixels by exact solutions of the frame's own system.

With x = C z, z random signs at pixels k far from one another and 0 elsewhere, z_k x_k is C_kk: what the others add
falls with the distance as C does (Tang and Saad 2012). So one solution measures the variances of some hundred pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray

from .conjugate_gradients import FrameSystem, NotReachedError

Pixels = NDArray[np.intp]

SEED = 20260401  # of the pixels, different from those of data and calibration
SPACING = 80  # rows or columns between two pixels of a set, at least
MOST = 200  # pixels of a set
TRIALS = 2000  # random pixels that are tried for it
EDGE = 4  # pixels: how near the edges the first of a set lie
SETS = 2  # of few pixels; one of many
SINGLE = 6  # pixels where errors are correlated over any distance, and each needs a solution of its own
FEW_SINGLE = 2  # of many pixels
MANY = 250_000
EXACT = 1e-3  # relative accuracy of a solution


@dataclass(frozen=True)
class MapCheck:
    """The difference of a map from exact variances at random pixels, relative: the largest, and that of the mean."""

    worst: float
    mean: float


@dataclass(frozen=True)
class ExactVariances:
    """Exact variances of some pixels of a frame.

    noise : (M,) Rvm / Rv^2, None where the actual noise Rvm is the expected one
    accuracy : that of solutions in posterior standard deviations, if EXACT is out of reach
    """

    system: FrameSystem
    noise: FloatArray | None
    accuracy: float

    def at(self, pixels: Pixels, posterior: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return Eq. 5 of pixels whose errors are not correlated, (n,); posterior : (N,) about the diagonal of C."""
        signs = np.zeros_like(posterior)
        signs[pixels] = rng.choice([-1.0, 1.0], size=pixels.size)
        finest = EXACT * float(np.sqrt(posterior[pixels].min()))
        solved = self._solve(signs, finest)
        if self.noise is not None:
            readings = self.system.observation.forward(solved)
            readings *= self.noise
            right = self.system.observation.adjoint(readings) + self.system.apply_prior_precision(solved)
            smallest = float(np.min((signs * solved)[pixels]))
            solved = self._solve(right, min(finest, EXACT * max(smallest, 0.0) / float(posterior.max()) ** 0.5))
        return (signs * solved)[pixels]

    def _solve(self, right: FloatArray, accuracy: float) -> FloatArray:
        try:
            return self.system.solve(right, min(accuracy, self.accuracy)).image
        except NotReachedError:
            return self.system.solve(right, self.accuracy).image


def check_map(
    variance: FloatArray, posterior: FloatArray, shape: tuple[int, int], exact: ExactVariances, *, local: bool
) -> MapCheck:
    """Compare a map of Eq. 5, (N,), with exact solutions; posterior : (N,) the map of the diagonal of C.

    local : False where errors are correlated over any distance, so that pixels are taken one at a time
    """
    rng = np.random.default_rng(SEED)
    ratios: list[FloatArray] = []
    many = variance.size > MANY
    for number in range((1 if many else SETS) if local else (FEW_SINGLE if many else SINGLE)):
        pixels = spread_pixels(shape, rng, edges=local or bool(number % 2))
        if not local:
            pixels = pixels[:1]
        ratios.append(variance[pixels] / exact.at(pixels, posterior, rng) - 1)
    ratio = np.concatenate(ratios)
    worst = float(np.abs(ratio).max())
    if not local:
        return MapCheck(worst, worst)
    return MapCheck(worst, min(worst, abs(float(ratio.mean())) + 2 * float(ratio.std()) / ratio.size**0.5))


def spread_pixels(shape: tuple[int, int], rng: np.random.Generator, *, edges: bool) -> Pixels:
    """Return random pixels of a frame that lie SPACING rows or columns apart, (n,); with `edges` some lie near them."""
    rows, columns = shape
    trials = np.stack([rng.integers(rows, size=TRIALS), rng.integers(columns, size=TRIALS)], axis=1)
    for number in range(4 if edges else 0):
        axis, end = divmod(number, 2)
        near = int(rng.integers(min(EDGE, shape[axis])))
        trials[number, axis] = shape[axis] - 1 - near if end else near
    chosen = [trials[0]]
    for pixel in trials[1:]:
        if len(chosen) < MOST and (np.abs(np.array(chosen) - pixel).max(axis=1) >= SPACING).all():
            chosen.append(pixel)
    return np.array([row * columns + column for row, column in chosen], dtype=np.intp)
