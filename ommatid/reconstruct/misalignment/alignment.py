"""H of a misaligned camera fitted to the stack itself: one dense posterior, linearised again.

Sub-imagers see the same image, so their measurements determine their relative positions. With misalignments t in units
of their tolerance and the image f~ of the step before, measurements are about

    g = H(t~) f + D (t - t~) + v,   D = dH/dt f~,

linear in the image f and in t ~ N(0, I), which are unknowns beside the pixels. Their joint posterior yields both, and
is linearised at its mean until that stays within a part of its deviation. H has kinks wherever an edge of a sensor
pixel meets an edge of a texel, as all do in the camera as designed: so dH is a difference over the range of t that is
still unknown. What f~ lacks of f makes D uncertain, and counts as noise of variance dH P dH^T with P what f^ lacks.

The uncertainty of t moves the estimate, and so adds to its error: by the law of total variance, to P of Eq. 5 the
covariance of f^ over the misalignments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import Misalignment

from ..expected_error import Interval
from ..forms.cholesky import factorise_positive
from ..methods.dense_method import DenseMethod
from ..methods.method import Conditions, MethodResult, Value
from ..prior import Prior
from ..problem import gram
from .moments import CAUSE, as_misalignments, misaligned_matrix, tolerances

MAX_ITERATIONS = 30
WHOLE_STEPS = 12  # after which steps are shortened, so that they do not go to and fro across a kink
CONVERGED = 0.1  # change of every misalignment that ends the search, in its standard deviations
NARROWING = 0.8  # factor by which deviations may still shrink when the search ends
MIN_STEP = 1e-5  # of a difference, in tolerances, so that it keeps its digits


@dataclass(frozen=True)
class Alignment:
    """Fitted misalignments of the sub-imagers, in the order of measurements, and their uncertainty.

    misalignments, deviations : fitted, and their standard deviations from the curvature
    matrix : (M, N) H with these misalignments
    covariance : (K, K) of the fitted parameters;  numbers : (K, 2) their sub-imagers and columns of `as_table`
    shifts : (N, K) derivative of the estimate by each of them
    """

    misalignments: tuple[Misalignment, ...]
    deviations: tuple[Misalignment, ...]
    matrix: sparse.csr_array
    covariance: FloatArray
    numbers: NDArray[np.intp]
    shifts: FloatArray

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of every pixel due to the uncertainty of the misalignments: (N,), to first order."""
        return np.einsum("ik,kl,il->i", self.shifts, self.covariance, self.shifts)

    def variance_of_sum(self, weights: FloatArray) -> float:
        """Return the same of a weighted sum of pixels; weights : (N,)."""
        shift = self.shifts.T @ weights
        return float(shift @ self.covariance @ shift)


def align(
    camera: Camera, recorded: FloatArray, noise_variance: FloatArray, prior: Prior, used: BoolArray | None = None
) -> Alignment:
    """Fit the misalignments that are most likely given the camera's tolerance and the measurements.

    recorded, noise_variance : (m,) of the measurements used;  used : (M,) absent: all
    Raises InputError for a camera without tolerance or with lenses of surfaces, and without noise.
    """
    spread = _checked_tolerances(camera, noise_variance)
    chosen = np.ones(camera.measurements, dtype=np.bool_) if used is None else used
    numbers = np.argwhere(spread > 0)
    scores, deviation = np.zeros(len(numbers)), np.ones(len(numbers))
    image, variance = prior.mean, prior.variance
    joint = np.eye(prior.dimension + len(numbers))  # posterior covariance of u and of the scores
    for iteration in range(MAX_ITERATIONS):
        matrix = misaligned_matrix(camera, _table(spread, scores))[chosen]
        changes, uncertainty = _changes(camera, chosen, spread, (scores, deviation), image, variance)
        weights = 1 / (noise_variance + uncertainty)
        joint = _posterior(matrix, changes, weights, prior)
        residual = weights * (recorded - matrix @ prior.mean + changes @ scores)
        mean = joint @ np.concatenate([prior.apply_root_transposed(matrix.T @ residual), changes.T @ residual])
        pixels, step = joint[: prior.dimension, : prior.dimension], mean[prior.dimension :] - scores
        image, variance = prior.mean + prior.apply_root(mean[: prior.dimension]), prior.variance_of(pixels)
        narrower = np.clip(np.sqrt(np.diagonal(joint)[prior.dimension :]), MIN_STEP, 1.0)
        settled = (np.abs(step) <= CONVERGED * narrower) & (narrower > NARROWING * deviation)
        scores, deviation = scores + min(1.0, WHOLE_STEPS / (iteration + 1)) * step, narrower
        if settled.all():
            break
    scale, covariance = spread[tuple(numbers.T)], joint[prior.dimension :, prior.dimension :]
    both = prior.apply_root(joint[: prior.dimension, prior.dimension :])
    table = _table(spread, scores)
    return Alignment(
        as_misalignments(table),
        as_misalignments(_table(spread, np.sqrt(np.diagonal(covariance)))),
        misaligned_matrix(camera, table),
        covariance * np.outer(scale, scale),
        numbers,
        np.linalg.solve(covariance, both.T).T / scale,
    )


def _checked_tolerances(camera: Camera, noise_variance: FloatArray) -> FloatArray:
    """Return the standard deviations of all parameters, (sub-imagers, 6). Raises InputError as `align` does."""
    spread = tolerances(camera)
    if not spread.any():
        raise InputError("estimator.misalignment: 'fit' needs to know what may be misaligned; add a [camera.tolerance]")
    if not (noise_variance > 0).all():
        raise InputError(
            "estimator.misalignment: 'fit' needs noise in every measurement, got some without; set noise.variance or"
            " estimator.noise_variance to a number above 0"
        )
    return spread


def _table(spread: FloatArray, scores: FloatArray) -> FloatArray:
    """Return misalignments, (sub-imagers, 6), from (K,) numbers in units of their tolerances."""
    table = np.zeros_like(spread)
    table[spread > 0] = scores
    return table * spread


def _changes(
    camera: Camera,
    chosen: BoolArray,
    spread: FloatArray,
    around: tuple[FloatArray, FloatArray],
    image: FloatArray,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return D, (m, K), and the variance of dH f by what the image lacks: (m,).

    around : the scores and how far from them differences are taken, (K,) each
    image, variance : (N,) of f and of what it lacks
    """
    owner = np.repeat(np.arange(len(spread)), [rows.stop - rows.start for rows in camera.slices()])[chosen]
    middle, width = (_table(spread, values) for values in around)
    numbers = np.argwhere(spread > 0)
    changes, uncertainty = np.zeros((owner.size, len(numbers))), np.zeros(owner.size)
    for parameter in sorted(set(numbers[:, 1].tolist())):
        step = np.zeros_like(width)
        step[:, parameter] = width[:, parameter]
        # Every row changes with its own sub-imager alone.
        ends = (misaligned_matrix(camera, middle + sign * step)[chosen] for sign in (1.0, -1.0))
        change = sparse.csr_array(0.5 * (next(ends) - next(ends)))
        columns = np.flatnonzero(numbers[:, 1] == parameter)
        index = np.full(len(spread), -1)
        index[numbers[columns, 0]] = columns
        rows = np.flatnonzero(index[owner] >= 0)
        changes[rows, index[owner[rows]]] = (change @ image)[rows] / around[1][index[owner[rows]]]
        uncertainty += change.power(2) @ variance
    return changes, uncertainty


def _posterior(matrix: sparse.csr_array, changes: FloatArray, weights: FloatArray, prior: Prior) -> FloatArray:
    """Return the joint covariance of u and the scores, (K, K) together; weights : (m,) 1 / Rv."""
    pixels = prior.apply_root_transposed(prior.apply_root_transposed(gram(matrix, weights)).T)
    weighted = weights[:, None] * changes
    both = prior.apply_root_transposed(np.asarray(matrix.T @ weighted))
    inner = np.block([[pixels, both], [both.T, changes.T @ weighted]])
    inner[np.diag_indices_from(inner)] += 1.0
    return factorise_positive(inner)[0].inverse()


class AlignedMethod(DenseMethod):
    """H is that of the misalignments which are most likely given the stack."""

    @cached_property
    def alignment(self) -> Alignment:
        """Fitted misalignments and their remaining uncertainty."""
        task = self.task
        prior = task.prior_on(task.shape)
        return align(task.model.camera, task.recorded[task.used], task.expected_noise, prior, task.used)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """H of the measurements used with the fitted misalignments."""
        return self.alignment.matrix[self.task.used]

    def shared(
        self, name: str, conditions: Conditions, make: Callable[[], Value], tolerance: float = 0.0
    ) -> tuple[Value, float | None]:
        """Make every result anew: H is that of this stack."""
        del name, conditions, tolerance
        return make(), None

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error with the given noise; the remaining uncertainty of the fit adds to it."""
        result, alignment = super().result_for_assumed_prior(noise, truth), self.alignment
        added = float(alignment.variance.sum())

        def wider(without: Interval) -> Interval:  # few numbers cause it: it may be almost zero or several times that
            return without.with_added(added, added**2, alignment.variance.size)

        return result.with_error(CAUSE, alignment.variance, alignment.variance_of_sum, wider)
