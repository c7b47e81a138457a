"""Averaging kernel and correlation of the errors of an estimate, computed on a window of the image.

With C = (H^T Rv^-1 H + P0^-1)^-1 the posterior covariance (Wood et al. 2005, Eq. 5), the rows of
A H = C H^T Rv^-1 H are the averaging kernels: pixel j of the estimate is the sum over i of (A H)_ji f_i, plus prior
mean and noise (Rodgers 2000, 2.4). Both are local, so that a window with all measurements inside it has those of the
image in its centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from ommatid.reconstruct.noise import known_noise
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.prior import FittedPrior, prior_of
from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import one_thread
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

MOST_PIXELS = 1300  # of an image that is one window
SIDE = 29  # of the window of a larger image, in pixels
CENTRE = 6  # side of the block of central pixels over which kernels are averaged, in pixels
LEAST_NOISE = 1e-12  # of the prior's variance, where the measurements have no noise


@dataclass(frozen=True)
class ErrorWindow:
    """Posterior covariance C, (n, n), and H^T Rv^-1 H, (n, n), of the n pixels of a window of the image.

    rows, columns : the window in the image;  shape : of the image
    root : L of the prior, P0 = L L^T, (n, k);  noise : harmonic mean of the variances of the measurements
    """

    rows: slice
    columns: slice
    shape: tuple[int, int]
    covariance: FloatArray
    information: FloatArray
    root: FloatArray
    noise: float

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    @property
    def is_whole(self) -> bool:
        """True if the window is the image."""
        return self.size == self.shape

    @property
    def centre(self) -> IntArray:
        """Indices in the window of the central block of pixels."""
        spans = [np.arange(max(0, (size - CENTRE) // 2), min(size, (size + CENTRE) // 2)) for size in self.size]
        return (spans[0][:, None] * self.size[1] + spans[1]).ravel()

    def kernels(self, pixels: IntArray) -> FloatArray:
        """Return the averaging kernels of pixels of the window, (k, rows, columns)."""
        return (self.covariance[pixels] @ self.information).reshape(-1, *self.size)

    @cached_property
    def correlated_pixels(self) -> float:
        """Sum over the window of the squared correlation with a central pixel, its own 1 included, on average."""
        deviation = np.sqrt(self.covariance.diagonal())
        centre = self.centre
        correlation = self.covariance[centre] / (deviation[centre, None] * deviation)
        return float(np.square(correlation).sum(axis=1).mean())

    def degrees_of_freedom(self, pixels: IntArray) -> float:
        """Return those of the mean squared error over pixels of the image: as many independent errors vary as much.

        For Gaussian errors tr(C)^2 / tr(C^2) (Satterthwaite 1946) where the window is the image, else a lower bound
        for a correlation that is everywhere that of the centre.
        """
        if not self.is_whole:
            return max(1.0, pixels.size / self.correlated_pixels)
        part = self.covariance[np.ix_(pixels, pixels)]
        return float(np.trace(part)) ** 2 / float(np.square(part).sum())


@one_thread()
def error_window(stack: Stack, model: Model, estimate: FloatArray, report: RunReport) -> ErrorWindow | None:
    """Return the window of a run with its known noise, None where no measurement lies inside it or `why_none` says so.

    model : of f;  estimate : (rows, columns), at which the noise by the uncertainty of H is taken
    """
    if why_none(stack.scene):
        return None
    rows, columns = (_window(size, *stack.camera.shape) for size in stack.camera.shape)
    inside = model.windowed.measurements_inside(rows, columns)
    noise = _noise(stack, model, estimate, report)[inside]
    known = np.isfinite(stack.values[inside]) & np.isfinite(noise)
    if not known.any():
        return None
    scene = stack.scene
    size = rows.stop - rows.start, columns.stop - columns.start
    prior = prior_of(_prior(scene, report), size, stack.camera.target_pitch)
    variance = float(prior.variance.mean())
    if variance <= 0:
        return None
    whitened = model.windowed.submatrix(rows, columns)[np.flatnonzero(known)].toarray()
    variances = np.maximum(noise[known], LEAST_NOISE * variance)
    whitened /= np.sqrt(variances)[:, None]
    information = whitened.T @ whitened
    root = np.diag(prior.root) if prior.independent else prior.root
    covariance = posterior_covariance(root, information)
    mean = float(1 / np.mean(1 / variances))
    return ErrorWindow(rows, columns, stack.camera.shape, covariance, information, root, mean)


def why_none(scene: Scene) -> str:
    """Return what is left out without the kernels of an estimator, as a sentence, "" where they are known.

    An estimator that fits H to the stack has another H, and errors that are correlated within a sub-imager.
    """
    misalignment = scene.estimator.misalignment
    if misalignment == "trust":
        return ""
    return (
        "Transfer function, intervals of the measured errors and the effect of another lens type"
        f" are not computed for `estimator.misalignment = '{misalignment}'`, whose errors are correlated otherwise."
    )


def posterior_covariance(root: FloatArray, information: FloatArray) -> FloatArray:
    """Return (P0^-1 + H^T Rv^-1 H)^-1 for P0 = L L^T, which may be singular: L (I + L^T H^T Rv^-1 H L)^-1 L^T.

    root : L;  information : H^T Rv^-1 H
    """
    inner = np.eye(root.shape[1]) + root.T @ information @ root
    half = linalg.solve_triangular(linalg.cholesky(inner, lower=True), root.T, lower=True)
    return half.T @ half


def _window(size: int, height: int, width: int) -> slice:
    """Return the rows or columns of the window: all of them in a small image, else the central ones."""
    if height * width <= MOST_PIXELS:
        return slice(0, size)
    shown = min(size, SIDE)
    return slice((size - shown) // 2, (size - shown) // 2 + shown)


def _noise(stack: Stack, model: Model, estimate: FloatArray, report: RunReport) -> FloatArray:
    """Return the variances that the estimator assumes, (M,)."""
    assumed = stack.scene.estimator.noise_variance
    if assumed == "fit" and "noise_variance" in report.diagnostics.fit:
        return np.full(stack.values.size, report.diagnostics.fit["noise_variance"].value)
    if isinstance(assumed, int | float):
        return np.full(stack.values.size, float(assumed))
    total = np.sum([np.asarray(part) for part in known_noise(stack).values()], axis=0)
    return total + model.variance_from_model(estimate.ravel()) if model.variance.any() else total


def _prior(scene: Scene, report: RunReport) -> PriorTable:
    """Return the prior as assumed, or as the run fitted it."""
    prior = scene.assumed_prior
    if prior.kind != "fit":
        return prior
    if not report.diagnostics.fit_terms:
        return prior.model_copy(update={"kind": "independent"})
    return FittedPrior.of(prior, report.diagnostics.fit_terms)
