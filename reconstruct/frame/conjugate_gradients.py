"""A whole frame at once: conjugate gradients on the information form of Eq. 4, with nothing stored but images.

    K (f^ - f0) = H^T Rv^-1 (g - H f0),   K = H^T Rv^-1 H + P0^-1,   posterior covariance C = K^-1.

Steps end when the error of every pixel is known to lie below a fraction of its posterior standard deviation: with the
residual r = b - K x, Cauchy and Schwarz give |x_i - x*_i| <= sqrt(C_ii) sqrt(r^T K^-1 r) for every pixel i at once, and
K is no less than the least eigenvalue of P0^-1, so that r^T K^-1 r is at most |r|^2 over that, whatever H is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from ommatid.runtime.errors import InputError
from ommatid.runtime.processors import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera

from .preconditioner import WORKERS, Preconditioner, preconditioner_for

Vector = NDArray[np.float64]
Image = NDArray[np.float64]

ACCURACY = 0.01  # of the error of the computation, in posterior standard deviations
MOST_STEPS = 600
RESTARTS = 3  # from the residual as it really is
SAFETY = 0.5  # the least eigenvalue of P K that the steps have revealed may be this much too large


class NotReachedError(InputError):
    """The steps do not get as near as was asked."""


class Observation(Protocol):
    """H, however it is stored."""

    def forward(self, image: Vector) -> Vector:
        """H f: (N,) to (M,)."""
        ...

    def adjoint(self, measurements: Vector) -> Vector:
        """H^T g: (M,) to (N,)."""
        ...


@dataclass(frozen=True)
class Solution:
    """C b, (N,), the steps that it took, and the bound of its error in posterior standard deviations of each pixel.

    condition : the largest over the least eigenvalue of P K, as far as the steps have revealed them
    """

    image: Vector
    steps: int
    bound: float
    condition: float = 1.0


@dataclass(frozen=True)
class FrameSystem:
    """K of a frame, never stored, and its approximate inverse.

    weights : (M,) 1 / Rv, 0 for sensor pixels that are not used
    prior : 1 / P0 of independent pixels, or 1 / its spectrum, (rows, columns), under the cosine transform (DCT-II)
    """

    camera: Camera
    observation: Observation
    weights: Vector
    prior: float | Image

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.camera.rows, self.camera.columns

    def apply(self, image: Vector) -> Vector:
        """K f: (N,) to (N,)."""
        readings = self.observation.forward(image)
        readings *= self.weights
        return self.observation.adjoint(readings) + self.expected(image)

    def expected(self, image: Vector) -> Vector:
        """P0^-1 f: (N,) to (N,)."""
        if isinstance(self.prior, float):
            return self.prior * image
        waves = fft.dctn(image.reshape(self.shape), 2, norm="ortho", workers=WORKERS)
        waves *= self.prior
        return np.asarray(fft.idctn(waves, 2, norm="ortho", workers=WORKERS, overwrite_x=True)).ravel()

    def collected(self, readings: Vector) -> Vector:
        """H^T Rv^-1 g: (M,) to (N,)."""
        return self.observation.adjoint(self.weights * readings)

    @cached_property
    def nearby(self) -> Preconditioner:
        """The sliding camera whose types have the mean weights of this one's."""
        means = tuple(float(self.weights[place].mean()) for place in self.camera.type_slices())
        return preconditioner_for(self.camera, means, self.prior)

    def solve(self, right: Vector, accuracy: float = ACCURACY, progress: Progress = no_progress) -> Solution:
        """C b to `accuracy` posterior standard deviations in every pixel.

        Raises NotReachedError if steps do not get there.
        """
        with one_thread():  # products of vectors gain nothing from threads, and wait for them
            found, left, lanczos = np.zeros_like(right), right.copy(), _Lanczos()
            for _ in range(RESTARTS):
                found, lanczos = self._improved(found, left, accuracy, lanczos, progress)
                left = right - self.apply(found)  # the steps' own residual knows nothing of their rounding
                bound = self._bound(left)
                if bound <= accuracy:
                    break
            else:
                # What is left is rounding, which has no part in what only the prior knows.
                bound = (max(float(left @ self._prepared(left)), 0.0) / (SAFETY * lanczos.least)) ** 0.5
            if bound > accuracy:
                raise NotReachedError(self._short_of(bound, lanczos.count, accuracy))
        return Solution(found, lanczos.count, bound, lanczos.largest / lanczos.least if lanczos.count else 1.0)

    def _improved(
        self, start: Vector, residual: Vector, accuracy: float, lanczos: _Lanczos, progress: Progress
    ) -> tuple[Vector, _Lanczos]:
        """Conjugate gradients from `start`, until their own residual meets the bound."""
        found, left, steps = start.copy(), residual.copy(), _Lanczos()
        worst = bound = self._bound(left)
        step = self._prepared(left) if bound > accuracy else left
        size = float(left @ step)
        while bound > accuracy:
            if steps.count >= MOST_STEPS or not np.isfinite(bound):
                raise NotReachedError(self._short_of(bound, steps.count, accuracy))
            seen = self.apply(step)
            along = size / float(step @ seen)
            found += along * step
            left -= along * seen
            bound = self._bound(left)
            seen = self._prepared(left)
            before, size = size, max(float(left @ seen), 0.0)
            steps.add(along, size / before)
            step *= size / before
            step += seen
            progress(min(1.0, float(np.log(worst / bound) / np.log(worst / accuracy)) if bound > 0 else 1.0))
        return found, steps if steps.count else lanczos

    def _bound(self, left: Vector) -> float:
        """sqrt(r^T K^-1 r) at most, since K is no less than the least that the prior knows of an image."""
        known = self.prior if isinstance(self.prior, float) else float(np.min(self.prior))
        return (float(left @ left) / known) ** 0.5

    def _short_of(self, bound: float, steps: int, accuracy: float) -> str:
        return (
            f"the frame solver is at {bound:.2g} posterior standard deviations after {steps} steps, asked were"
            f" {accuracy:g}; take estimator.method = 'tiles', or raise estimator.accuracy"
        )

    def _prepared(self, image: Vector) -> Vector:
        return self.nearby.solve(image.reshape(self.shape)).ravel()


class _Lanczos:
    """The tridiagonal matrix that conjugate gradients build on their way; its eigenvalues close in on those of P K."""

    def __init__(self) -> None:
        self.along: list[float] = []
        self.shrunk: list[float] = []

    def add(self, along: float, shrunk: float) -> None:
        self.along.append(along)
        self.shrunk.append(shrunk)

    @property
    def count(self) -> int:
        return len(self.along)

    @property
    def least(self) -> float:
        """Its least eigenvalue."""
        return self._eigenvalue(0)

    @property
    def largest(self) -> float:
        """Its largest eigenvalue."""
        return self._eigenvalue(self.count - 1)

    def _eigenvalue(self, number: int) -> float:
        along, shrunk = np.array(self.along), np.array(self.shrunk)
        diagonal = 1 / along
        diagonal[1:] += shrunk[:-1] / along[:-1]
        beside = np.sqrt(shrunk[:-1]) / along[:-1]
        return float(linalg.eigvalsh_tridiagonal(diagonal, beside, select="i", select_range=(number, number))[0])
