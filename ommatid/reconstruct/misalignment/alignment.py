"""Fit the misalignments of a camera to a stack that it recorded of an unknown image.

Sub-imagers see the same image, so their measurements determine their relative positions. The fit maximises the marginal
likelihood within the tolerance (`likelihood`). The remaining uncertainty moves the estimate, and so adds to its error:
by the law of total variance, to P of Eq. 5 the covariance of f^ over the misalignments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import Misalignment

from ..prior import Prior
from .likelihood import LikelihoodPoint, MisalignedRecording, ParameterDerivatives, likelihood_at
from .robust_noise import as_misalignments, misaligned_matrix, tolerances

MAX_PIXELS = 4000  # of f: beyond, its dense matrices take too long
MAX_ITERATIONS = 40
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-6, 1e6
CONVERGED = 0.1  # change of the value that ends the search; one standard deviation of one parameter is worth 0.5
MIN_STEP = 1e-5  # of a difference, in tolerances, so that it keeps its digits
NARROWING = 0.8  # factor by which steps may still shrink when the search ends
COOLING, COLD = 0.25, 0.1  # factor on the additional noise per iteration; share of Rv below which it is dropped
LEAPS = (-1.0, -0.3, -0.1, 0.1, 0.3, 1.0)  # tolerances, across a kink
MAX_LEAPS = 6  # tried with exact values


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
    converged: bool

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
    Raises InputError for a frame, for a camera without tolerance or with lenses of surfaces, and without noise.
    """
    recording = misaligned_recording(camera, recorded, noise_variance, prior, used)
    derivatives, converged = _search(recording)
    covariance = np.asarray(linalg.inv(_at_least_one(derivatives.curvature())))
    scale, table = recording.tolerances[tuple(recording.free.T)], recording.table(derivatives.point.scores)
    return Alignment(
        as_misalignments(table),
        as_misalignments(recording.table(np.sqrt(np.diagonal(covariance)))),
        misaligned_matrix(camera, table),
        covariance * np.outer(scale, scale),
        recording.free,
        derivatives.shifts / scale,
        converged,
    )


def misaligned_recording(
    camera: Camera, recorded: FloatArray, noise_variance: FloatArray, prior: Prior, used: BoolArray | None = None
) -> MisalignedRecording:
    """Return the data of the search; arguments and errors are those of `align`."""
    if camera.unknowns > MAX_PIXELS:
        raise InputError(
            f"estimator.misalignment: 'fit' serves up to {MAX_PIXELS} pixels of f, got {camera.rows} x"
            f" {camera.columns}; take 'robust', or fit a smaller crop of the target"
        )
    spread = tolerances(camera)
    if not spread.any():
        raise InputError("estimator.misalignment: 'fit' needs to know what may be misaligned; add a [camera.tolerance]")
    if not (noise_variance > 0).all():
        raise InputError(
            "estimator.misalignment: 'fit' needs noise in every measurement, got some without; set noise.variance or"
            " estimator.noise_variance to a number above 0"
        )
    chosen = np.ones(camera.measurements, dtype=np.bool_) if used is None else used
    owner = np.repeat(np.arange(len(spread)), [rows.stop - rows.start for rows in camera.slices()])[chosen]

    def matrix_of(table: FloatArray) -> sparse.csr_array:
        return misaligned_matrix(camera, table)[chosen]

    return MisalignedRecording(recorded, noise_variance, owner, prior, matrix_of, spread)


def _search(recording: MisalignedRecording) -> tuple[ParameterDerivatives, bool]:
    """Return the derivatives at the point of least value, and True if the search converged.

    The method is that of Levenberg and Marquardt. At first misalignment itself counts as noise, less and less of it as
    it becomes known, and derivatives are differences over what is still unknown: otherwise parameters settle on the
    wrong side of a kink of H.
    """
    point = likelihood_at(recording, np.zeros(len(recording.free)))
    steps, damping = np.ones(point.scores.size), INITIAL_DAMPING
    extra = _variance_of_misalignment(point.derivatives(steps))
    for _ in range(MAX_ITERATIONS):
        extra *= COOLING if extra > COLD * float(recording.noise_variance.min()) else 0.0
        point = likelihood_at(replace(recording, noise_variance=recording.noise_variance + extra), point.scores)
        derivatives = point.derivatives(steps)
        curvature = _at_least_one(derivatives.curvature(whole=False))
        better, damping = _step(point, derivatives.gradient, curvature, damping)
        narrower = np.clip(np.sqrt(np.diagonal(linalg.inv(curvature))), MIN_STEP, 1.0)
        settled = extra == 0 and bool(np.all(narrower > NARROWING * steps)) and point.value - better.value < CONVERGED
        point, steps = better, narrower
        if settled:
            leapt = _leap(point)
            if leapt is None:
                return point.derivatives(steps), True
            point = leapt
    return likelihood_at(recording, point.scores).derivatives(steps), False


def _leap(point: LikelihoodPoint) -> LikelihoodPoint | None:
    """Return a better point that one parameter alone reaches across a kink, or None.

    Of all leaps, those that the derivatives rank best are evaluated.
    """
    recording, size = point.recording, point.scores.size
    leaps: list[tuple[float, int, float]] = []
    for leap in LEAPS:
        derivatives = point.derivatives(np.full(size, leap), one_sided=True)
        expected = leap * derivatives.gradient + 0.5 * leap**2 * np.diagonal(derivatives.curvature(whole=False))
        leaps += [(float(expected[index]), index, leap) for index in range(size)]
    for _, index, leap in sorted(leaps)[:MAX_LEAPS]:
        scores = point.scores.copy()
        scores[index] += leap
        other = likelihood_at(recording, scores)
        if other.value < point.value:
            return other
    return None


def _variance_of_misalignment(derivatives: ParameterDerivatives) -> float:
    """Return the mean variance of a measurement due to misalignment within the tolerance."""
    variance = derivatives.point.recording.prior.variance
    squares = [float((change.power(2) @ variance).mean()) for change in derivatives.by_parameter.values()]
    return sum(squares)


def _step(
    point: LikelihoodPoint, gradient: FloatArray, curvature: FloatArray, damping: float
) -> tuple[LikelihoodPoint, float]:
    """Return a better point, or the same where there is none, and the damping to start with next time."""
    while damping < MAX_DAMPING:
        damped = curvature + damping * np.diag(np.diagonal(curvature))
        scores = point.scores - linalg.solve(damped, gradient, assume_a="pos")
        better = likelihood_at(point.recording, scores)
        if better.value < point.value:
            return better, max(damping / 10, MIN_DAMPING)
        damping *= 10
    return point, INITIAL_DAMPING


def _at_least_one(curvature: FloatArray) -> FloatArray:
    """Return the curvature with eigenvalues raised to 1, the tolerance's own."""
    values, vectors = linalg.eigh(0.5 * (curvature + curvature.T))
    return (vectors * np.maximum(values, 1.0)) @ vectors.T
