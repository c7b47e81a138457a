"""Fit of an exponential prior by the evidence of the measurements of a window in the middle of the image.

It serves worlds finer than f, of whose prior detail tells as well, so that the evidence is that of Hf w + v, and large
images behind kernels, of which no tile holds a whole one. With P = v K(length) the covariance of the measurements is
v Hf K Hf^T + Rv: whitened by Rv and diagonalised once for each length, it gives the evidence for every v at once.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cache
from math import exp, log

import numpy as np
from scipy import linalg, optimize, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model
from ommatid.scenes.tables.estimation import PriorTable

from ..detail.detailed_model import DetailedModel
from ..detail.world_prior import WorldPrior
from ..methods.method import EstimationTask
from .prior_fit import MAX_LENGTH, MIN_LENGTH, MIN_MEASUREMENTS, RANGE, PriorFit

LENGTHS = (0.5, 1.5, 4.0, 10.0, 25.0, 60.0)  # pixels of f, from which the search starts
MOST = 700  # measurements whose covariance is diagonalised
WIDE = 24  # pixels of f of a window whose measurements see more than it
SPARSE = 0.1  # share of entries of H, from which products with it as a dense matrix are faster
STEP = 0.2  # of the logarithm of the length, for the curvature
TOLERANCE = 0.02  # of the logarithm of the length, far below what the evidence can distinguish


@dataclass(frozen=True)
class WindowEvidence:
    """Measurements in units of their noise, and the rows of H that they see, on the world's grid.

    matrix : (m, pixels of the window's world) whitened;  residual : (m,) whitened;  shape : of the window, pixels of f
    """

    matrix: sparse.csr_array
    residual: FloatArray
    shape: tuple[int, int]
    detail: int

    def spectrum(self, logarithm: float) -> tuple[FloatArray, FloatArray]:
        """Return the eigenvalues of Hf K Hf^T and the squared residuals along its eigenvectors; of log(length in f)."""
        table = PriorTable.model_construct(kind="exponential", variance=1.0, correlation_length=exp(logarithm))
        prior = WorldPrior.of(table, self.shape, 1.0, self.detail)
        dense = np.asarray(self.matrix.toarray(), dtype=np.float64)
        spread = prior.apply(dense.T)
        covariance = np.asarray((self.matrix if self.matrix.nnz < SPARSE * dense.size else dense) @ spread)
        values, vectors = linalg.eigh((covariance + covariance.T) / 2, check_finite=False, driver="evd")
        return np.maximum(values, 0.0), np.square(vectors.T @ self.residual)

    def best_variance(
        self, spectrum: tuple[FloatArray, FloatArray], bounds: tuple[float, float]
    ) -> tuple[float, float]:
        """Return the logarithm of the variance of largest evidence, and minus twice the logarithm of that evidence."""
        best = float(optimize.fminbound(lambda value: self.score(spectrum, float(value)), *bounds, xtol=1e-6))
        return best, self.score(spectrum, best)

    def deviations(self, variance: float, length: float) -> tuple[float, float]:
        """Return the standard deviations of both logarithms from the curvature of the evidence, NaN if it has none."""
        steps = (-STEP, 0.0, STEP)
        spectra = [self.spectrum(length + step) for step in steps]
        score = np.array([[self.score(spectrum, variance + step) / 2 for step in steps] for spectrum in spectra])
        mixed = (score[2, 2] - score[2, 0] - score[0, 2] + score[0, 0]) / 4
        curvature = np.array(
            [
                [score[1, 2] - 2 * score[1, 1] + score[1, 0], mixed],
                [mixed, score[2, 1] - 2 * score[1, 1] + score[0, 1]],
            ]
        )
        if np.linalg.eigvalsh(curvature).min() <= 0:
            return float("nan"), float("nan")
        by_variance, by_length = np.sqrt(np.diagonal(np.linalg.inv(curvature))) * STEP
        return float(by_variance), float(by_length)

    @staticmethod
    def score(spectrum: tuple[FloatArray, FloatArray], logarithm: float) -> float:
        """Return minus twice the logarithm of the evidence, without constants, of a log variance."""
        values, squares = spectrum
        total = exp(logarithm) * values + 1.0
        return float(np.log(total).sum() + (squares / total).sum())


def fit_by_window(task: EstimationTask) -> PriorFit:
    """Fit variance and correlation length, in pixels of f, of the prior of f or of the world.

    task : its model on f's grid, its expected noise all of the noise but that of detail
    Raises InputError where measurements are too few, or have no noise.
    """
    evidence = window_evidence(task)
    bounds = _variance_bounds(evidence)

    @cache
    def best(logarithm: float) -> tuple[float, float]:
        return evidence.best_variance(evidence.spectrum(logarithm), bounds)

    ends = log(MIN_LENGTH), log(MAX_LENGTH * max(evidence.shape))
    grid = [ends[0], *(log(length) for length in LENGTHS if length < exp(ends[1])), ends[1]]
    start = min(range(1, len(grid) - 1), key=lambda number: best(grid[number])[1])
    around = grid[start - 1], grid[start + 1]
    length = float(optimize.fminbound(lambda value: best(float(value))[1], *around, xtol=TOLERANCE))
    variance = best(length)[0]
    spread = evidence.deviations(variance, length)
    distances = (length - ends[0], ends[1] - length, variance - bounds[0], bounds[1] - variance)
    return PriorFit(
        variance=exp(variance),
        length=exp(length),
        noise_variance=None,
        spread=spread,
        measurements=evidence.residual.size,
        doubtful=min(distances) < TOLERANCE or not np.isfinite(spread).all(),
    )


def window_evidence(task: EstimationTask) -> WindowEvidence:
    """Return the evidence of the measurements inside a window in the middle of the image, MOST of them at most."""
    model, offset = task.model, np.zeros(task.model.measurements)
    if isinstance(model, DetailedModel):
        model, offset = model.fine, model.offset
    detail = model.camera.rows // task.shape[0]
    if not (task.expected_noise > 0).all():
        raise InputError(
            "a prior cannot be fitted to measurements without noise; set estimator.noise_variance to a number above 0"
        )
    rows, columns, inside = _window(model, task, detail)
    if inside.size < MIN_MEASUREMENTS:
        raise InputError(
            f"a fit of the prior or the noise takes {MIN_MEASUREMENTS} measurements or more, got {inside.size}"
        )
    matrix = model.windowed.rows_on(inside, rows, columns)
    light = model.forward(np.ones(model.unknowns))[inside]
    residual = (task.recorded + offset)[inside] - task.prior.mean * light
    beside = np.square(light - np.asarray(matrix.sum(axis=1)).ravel()) * float(np.mean(np.square(residual)))
    deviation = np.sqrt(task.on_all_measurements(task.expected_noise, 1.0)[inside] + beside)
    whitened = sparse.csr_array(sparse.diags_array(1 / deviation) @ matrix)
    shape = (rows.stop - rows.start) // detail, (columns.stop - columns.start) // detail
    return WindowEvidence(whitened, residual / deviation, shape, detail)


def _window(fine: Model, task: EstimationTask, detail: int) -> tuple[slice, slice, IntArray]:
    """Return the largest window in the middle with at most MOST used measurements inside, and these.

    Where blur reaches so far that it holds too few, a window of WIDE pixels and the measurements of its middle; the
    light that these receive from beside it counts as noise.
    """

    def within(side: int) -> tuple[slice, slice, IntArray]:
        rows, columns = _middle(task.shape, side, detail)
        inside = fine.windowed.measurements_inside(rows, columns)
        return rows, columns, inside[task.used[inside]]

    sides = range(1, max(task.shape) + 1)
    found = within(max(bisect_right(sides, MOST, key=lambda side: within(side)[2].size), 1))
    if MIN_MEASUREMENTS <= found[2].size <= MOST:
        return found
    rows, columns = _middle(task.shape, WIDE, detail)
    down, across = (part.start + np.array([0.25, 0.75]) * (part.stop - part.start) for part in (rows, columns))
    row, column = fine.camera.middles
    near = (row > down[0]) & (row < down[1]) & (column > across[0]) & (column < across[1])
    return rows, columns, np.flatnonzero(near & task.used)


def _middle(shape: tuple[int, int], side: int, detail: int) -> tuple[slice, slice]:
    """Return a window of at most `side` pixels of f in the middle, in pixels of the world."""
    sides = [min(side, size) for size in shape]
    rows, columns = (
        slice((size - part) // 2 * detail, ((size - part) // 2 + part) * detail)
        for size, part in zip(shape, sides, strict=True)
    )
    return rows, columns


def _variance_bounds(evidence: WindowEvidence) -> tuple[float, float]:
    square = float(np.mean(np.square(evidence.residual)))
    if square == 0:
        raise InputError("the measurements equal those of the prior's mean to the last digit: nothing can be fitted")
    seen = float(np.square(evidence.matrix.sum(axis=1)).mean())
    return log(square / seen) - log(RANGE), log(square / seen) + log(RANGE)
