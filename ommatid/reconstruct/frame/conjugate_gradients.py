"""The linear system of a whole frame, on the information form of Eq. 4, and its solution.

    K (f^ - f0) = H^T Rv^-1 (g - H f0),   K = H^T Rv^-1 H + P0^-1,   posterior covariance C = K^-1.

Conjugate gradients need no matrix. Iteration stops when the error of every pixel is below a fraction of its posterior
standard deviation. With the residual r = b - K x, the Cauchy-Schwarz inequality gives
|x_i - x*_i| <= sqrt(C_ii) sqrt(r^T K^-1 r) for every pixel i. Since K >= P0^-1, r^T K^-1 r is at most r^T P0 r, for
any H.

The preconditioner P is an argument. With independent pixels K couples only pixels that one sensor pixel sees, so that
its Cholesky factor has a band as wide as a few lines of the frame: C itself for frames of some ten thousand pixels,
whatever the lens types leave open. Transfer functions serve larger ones, and kernels of any width; where many kernels
describe the field, P is some steps with the few that matter most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread, processors
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.observation import Observation

from ..methods.method import EstimationTask
from .bands import Bands, bands_of
from .readings import leaves_null_space

Indices = NDArray[np.intp]

ACCURACY = 0.01  # numerical error, in posterior standard deviations
SUM_ACCURACY = 5e-3  # of the variance of a weighted sum of pixels, relative
MAX_STEPS = 600
MAX_STARTS = 3  # each from the recomputed residual
SAFETY = 0.5  # of the least eigenvalue of P K, which the Lanczos matrix overestimates
MOST_WORK = 1.2e11  # pixels times the square of the band: a minute or two with the error bars
EVEN = 0.1  # relative range of weights for which no scaling is tried
TRIAL_STEPS = 10  # with each of two preconditioners, where noise is uneven
REDUCTION = 0.1  # of a residual by steps with a cheaper H; more of them would follow what it lacks
MOST_INNER, MOST_OUTER = 60, 100  # such steps, and times that they are taken
LEAST_LOCAL = 1e-3  # of the weights of a pixel's measurements, relative to their mean
ROUNDING = 1e-12  # of such weights, below which they are 0


class Preconditioner(Protocol):
    """An approximation of C."""

    def solve(self, image: FloatArray, waves: FloatArray | None = None) -> FloatArray:
        """Return about C b: (rows, columns) to (rows, columns); waves : those of b where they are known."""
        ...


class NotReachedError(InputError):
    """Conjugate gradients do not reach the requested accuracy."""


@dataclass(frozen=True)
class Solution:
    """C b, (N,), the number of steps, and the bound on its error in posterior standard deviations of each pixel.

    condition : ratio of the largest to the least eigenvalue of P K, estimated from the steps
    """

    image: FloatArray
    steps: int
    bound: float
    condition: float = 1.0


@dataclass(frozen=True)
class FrameSystem:
    """K of a frame, as an operator, and its preconditioner P.

    weights : (M,) 1 / Rv, 0 for sensor pixels that are not used
    prior : 1 / P0 of independent pixels, or 1 / its spectrum, (rows, columns), under the DCT-II
    bands : the shift-invariant camera like this one, which gives P
    types : the measurements of each lens type, over which weights are averaged
    similar : P of the same prior and similar weights, or exact; None to make one of `bands`
    """

    observation: Observation
    weights: FloatArray
    prior: float | FloatArray
    bands: Bands
    types: tuple[slice, ...]
    similar: Preconditioner | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.observation.shape

    def apply(self, image: FloatArray) -> FloatArray:
        """Return K f: (N,) to (N,)."""
        readings = self.observation.forward(image)
        readings *= self.weights
        return self.observation.adjoint(readings) + self.apply_prior_precision(image)

    def apply_prior_precision(self, image: FloatArray) -> FloatArray:
        """Return P0^-1 f: (N,) to (N,)."""
        if isinstance(self.prior, float):
            return self.prior * image
        waves = fft.dctn(image.reshape(self.shape), 2, norm="ortho", workers=processors())
        waves *= self.prior
        return np.asarray(fft.idctn(waves, 2, norm="ortho", workers=processors(), overwrite_x=True)).ravel()

    def right_hand_side(self, readings: FloatArray) -> FloatArray:
        """Return H^T Rv^-1 g: (M,) to (N,)."""
        return self.observation.adjoint(self.weights * readings)

    @cached_property
    def preconditioner(self) -> Preconditioner:
        """P of all kernels or their means, by the mean weights or scaled by local ones: what takes the fewest steps."""
        if self.similar is not None:
            return self.similar
        pairs = zip(self.types, self.mean_weights, strict=True)
        found = self._fastest(self.bands, *([] if self.bands.simpler is None else [self.bands.simpler]))
        if all(float(np.ptp(self.weights[part])) <= EVEN * weight for part, weight in pairs):
            return found
        scale = np.sqrt(self.levels(lambda image: image)).reshape(self.shape)
        return self._fastest(found, replace(found, scale=scale))

    def levels(self, of: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the weights of the measurements of each pixel relative to the means of their lens types.

        of : takes an image of the unknowns to the pixels asked for
        """
        local, average = (of(each) for each in self._local_weights)
        relative = np.divide(local, average, out=np.ones_like(local), where=average > 0)
        return np.maximum(relative, LEAST_LOCAL)

    @cached_property
    def _local_weights(self) -> tuple[FloatArray, FloatArray]:
        """H^T w of the weights, and of their means over each lens type: (N,) each."""
        means = np.repeat(self.mean_weights, [part.stop - part.start for part in self.types])
        return self.observation.adjoint(self.weights), self.observation.adjoint(means)

    @cached_property
    def unseen(self) -> BoolArray:
        """True for pixels that no used measurement sees, though others do: (rows, columns)."""
        local, average = self._local_weights
        return (local <= ROUNDING * average).reshape(self.shape) & (average > 0).reshape(self.shape)

    def _fastest(self, *candidates: Bands) -> Bands:
        return candidates[0] if len(candidates) == 1 else min(candidates, key=self._after_trial)

    def _after_trial(self, candidate: Bands) -> float:
        """Return the bound that a few steps with a preconditioner reach."""
        right = self.apply(probe(Purpose.PRECONDITIONER).normal(size=self.observation.unknowns))
        return replace(self, similar=candidate).steps(right, TRIAL_STEPS)[1]

    def steps(self, right: FloatArray, most: int, reduction: float = 0.0) -> tuple[FloatArray, float]:
        """Return about C b and the bound on its error, after `most` steps or when that is `reduction` times the first.

        right : (N,) b
        """
        image, least = np.zeros_like(right), reduction * self._bound(self._waves(right))
        with one_thread():
            return image, self._iterate(image, right, least, most, _Lanczos())

    @property
    def mean_weights(self) -> tuple[float, ...]:
        """Mean weight of each lens type."""
        return tuple(float(self.weights[part].mean()) for part in self.types)

    def solve(self, right: FloatArray, accuracy: float = ACCURACY, progress: Progress = no_progress) -> Solution:
        """Return C b with an error of at most `accuracy` posterior standard deviations in every pixel.

        Raises NotReachedError if the iteration does not get there.
        """
        most = MOST_OUTER if isinstance(self.similar, Refined) else MAX_STEPS
        with one_thread():  # dot products gain nothing from threads and wait for them
            image, residual, lanczos = np.zeros_like(right), right, _Lanczos()
            for _ in range(MAX_STARTS):
                again = _Lanczos()
                bound = self._iterate(image, residual, accuracy, most, again, progress)
                if not bound <= accuracy:
                    raise NotReachedError(self._not_reached(bound, again.count, accuracy))
                lanczos = again if again.count else lanczos
                residual = right - self.apply(image)  # the recursive residual excludes rounding errors
                bound = self._bound(self._waves(residual))
                if bound <= accuracy:
                    break
            else:
                # The residual is rounding error, for which the bound by the prior alone is too pessimistic.
                energy = float(residual @ self._precondition(residual, self._waves(residual)))
                bound = (max(energy, 0.0) / (SAFETY * lanczos.least)) ** 0.5
            if bound > accuracy:
                raise NotReachedError(self._not_reached(bound, lanczos.count, accuracy))
        return Solution(image, lanczos.count, bound, lanczos.largest / lanczos.least if lanczos.count else 1.0)

    def solve_weights(self, weights: FloatArray, accuracy: float) -> FloatArray:
        """Return C w of (N,) weights, so that w^T C w is right to SUM_ACCURACY where the iteration gets there.

        A residual r changes w^T C w by (w^T C w r^T C r)^1/2 at most, which is small against it only if r is measured
        against (w^T C w)^1/2, and that is at least w^T w / (w^T K w)^1/2 (Cauchy-Schwarz).

        accuracy : in posterior standard deviations, at least, and all there is where more is out of reach
        """
        energy = float(weights @ self.apply(weights))
        if not energy > 0:
            return np.zeros_like(weights)
        try:
            least = float(weights @ weights) / energy**0.5
            return self.solve(weights, min(accuracy, SUM_ACCURACY * least)).image
        except NotReachedError:
            return self.solve(weights, accuracy).image

    def _iterate(
        self,
        image: FloatArray,
        residual: FloatArray,
        accuracy: float,
        most: int,
        lanczos: _Lanczos,
        progress: Progress = no_progress,
    ) -> float:
        """Improve an image by conjugate gradients until its recursive residual meets a bound, or `most` steps are done.

        Returns the bound that is reached.
        """
        first = bound = np.inf
        for waves in self._residuals(image, residual.copy(), lanczos):
            bound = self._bound(waves)
            first = first if lanczos.count else bound
            if lanczos.count and accuracy > 0:
                progress(min(1.0, float(np.log(first / bound) / np.log(first / accuracy)) if bound > 0 else 1.0))
            if bound <= accuracy or lanczos.count >= most or not np.isfinite(bound):
                break
        return bound

    def _residuals(self, image: FloatArray, residual: FloatArray, lanczos: _Lanczos) -> Iterator[FloatArray]:
        """Yield the waves of the residual before each step of conjugate gradients, which change both arguments.

        Where P is itself an iteration, no fixed matrix, the new direction is conjugate to the last one all the same
        (Notay 2000, Eq. 4).
        """
        direction, energy = None, 1.0
        before = np.zeros_like(residual) if isinstance(self.similar, Refined) else None
        while True:
            waves = self._waves(residual)
            yield waves
            conditioned = self._precondition(residual, waves)
            previous, energy = energy, float(residual @ conditioned)
            change = energy if before is None else energy - float(before @ conditioned)
            if not energy > 0:
                raise NotReachedError(
                    "the frame solver's preconditioner is not positive in double precision; set estimator.method ="
                    " 'tiles', or raise the noise"
                )
            if direction is None:
                direction = conditioned
            else:
                lanczos.ratios.append(energy / previous)
                direction *= change / previous
                direction += conditioned
            if before is not None:
                before[:] = residual
            product = self.apply(direction)
            lanczos.lengths.append(energy / float(direction @ product))
            image += lanczos.lengths[-1] * direction
            residual -= lanczos.lengths[-1] * product

    def _not_reached(self, bound: float, steps: int, accuracy: float) -> str:
        other = "raise the noise" if self.bands.detail > 1 else "set estimator.method = 'tiles'"
        return (
            f"the frame solver reached {bound:.2g} posterior standard deviations after {steps} steps, expected"
            f" {accuracy:g}; {other}, or raise estimator.accuracy"
        )

    def _waves(self, residual: FloatArray) -> FloatArray:
        """Return a residual under the DCT-II, (rows, columns), or itself where pixels are independent in the prior."""
        image = residual.reshape(self.shape)
        if isinstance(self.prior, float):
            return image
        return np.asarray(fft.dctn(image, 2, norm="ortho", workers=processors()))

    def _bound(self, waves: FloatArray) -> float:
        """Upper bound on sqrt(r^T K^-1 r) for the waves of r: sqrt(r^T P0 r)."""
        return float(np.sum(np.square(waves) / self.prior)) ** 0.5

    def _precondition(self, residual: FloatArray, waves: FloatArray) -> FloatArray:
        known = None if isinstance(self.prior, float) else waves
        return self.preconditioner.solve(residual.reshape(self.shape), known).ravel()


@dataclass(frozen=True)
class Refined:
    """P of a system by some steps of another one whose H is cheaper and nearly the same."""

    system: FrameSystem

    @classmethod
    def of(cls, system: FrameSystem, similar: Preconditioner) -> Preconditioner:
        """Return that of a system with cheaper kernels, whose own P is `similar`; that itself where there are none."""
        cheaper = system.observation.cheaper
        return similar if cheaper is system.observation else cls(replace(system, observation=cheaper, similar=similar))

    def solve(self, image: FloatArray, waves: FloatArray | None = None) -> FloatArray:
        """Return about C b: (rows, columns) to (rows, columns)."""
        del waves
        return self.system.steps(image.ravel(), MOST_INNER, REDUCTION)[0].reshape(image.shape)


def frame_system(task: EstimationTask) -> FrameSystem:
    """Return the system of a task whose every measurement has noise."""
    weights = task.on_all_measurements(1 / task.expected_noise, 0.0)
    prior, observation, camera = task.precision_on(task.shape), task.model.applied, task.model.camera
    spectrum = np.broadcast_to(1 / np.asarray(prior), task.shape)
    bands = bands_of(camera, task.finer, spectrum, weights, observation)
    return FrameSystem(observation, weights, prior, bands, tuple(camera.type_slices()))


class _Lanczos:
    """The tridiagonal matrix of conjugate gradients, whose extreme eigenvalues approach those of P K."""

    def __init__(self) -> None:
        self.lengths: list[float] = []
        self.ratios: list[float] = []

    @property
    def count(self) -> int:
        return len(self.lengths)

    @property
    def least(self) -> float:
        return self._eigenvalue(0)

    @property
    def largest(self) -> float:
        return self._eigenvalue(self.count - 1)

    def _eigenvalue(self, index: int) -> float:
        lengths, ratios = np.array(self.lengths), np.array(self.ratios[: self.count - 1])
        diagonal = 1 / lengths
        diagonal[1:] += ratios / lengths[:-1]
        beside = np.sqrt(ratios) / lengths[:-1]
        return float(linalg.eigvalsh_tridiagonal(diagonal, beside, select="i", select_range=(index, index))[0])


@dataclass(frozen=True)
class BandedFactor:
    """C of a frame of independent pixels, by the Cholesky factor of K; as P it leaves no more than rounding.

    matrix : (M, N) H
    """

    system: FrameSystem
    matrix: sparse.csr_array

    @cached_property
    def _order(self) -> Indices:
        """The pixels in the order that makes the band of K narrow: (N,)."""
        numbers: Indices = np.arange(self.system.observation.unknowns).reshape(self.system.shape)
        return (numbers if numbers.shape[1] <= numbers.shape[0] else numbers.T).ravel()

    @cached_property
    def _factor(self) -> FloatArray:
        """The lower factor of K with its pixels in this order, as SciPy stores bands: (width, N)."""
        information = self.matrix.T @ sparse.csr_array(self.matrix.multiply(self.system.weights[:, None]))
        precision = sparse.csr_array(
            information + float(np.asarray(self.system.prior)) * sparse.eye_array(self._order.size)
        )
        ordered = sparse.coo_array(precision[self._order][:, self._order])
        below = ordered.row >= ordered.col
        row, column, values = ordered.row[below], ordered.col[below], ordered.data[below]
        band = np.zeros((int((row - column).max(initial=0)) + 1, ordered.shape[0]))
        band[row - column, column] = values
        return np.asarray(linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False))

    def solve(self, image: FloatArray, waves: FloatArray | None = None) -> FloatArray:
        """Return C b: (rows, columns) to (rows, columns)."""
        del waves
        solved = np.empty(image.size)
        solved[self._order] = linalg.cho_solve_banded((self._factor, True), image.ravel()[self._order])
        return solved.reshape(image.shape)


def serves(camera: Camera) -> bool:
    """Return True where K of a frame of independent pixels is factorised: a null space or another array, few pixels."""
    if not camera.has_sharp_footprints:  # a blurred footprint may be as wide as the frame
        return False
    return band_work(camera) <= MOST_WORK and not (camera.is_sliding and not leaves_null_space(camera))


def band_work(camera: Camera) -> float:
    """Return the pixels times the square of the band: half the operations of a factorisation."""
    return camera.unknowns * float(band_width(camera)) ** 2


def band_width(camera: Camera) -> int:
    """Return the width of the band of K for the designed camera, without blur or distortion."""
    widest = max(ceil(lens_type.ratio) for lens_type in camera.types)
    return widest * (min(camera.shape) + 1)
