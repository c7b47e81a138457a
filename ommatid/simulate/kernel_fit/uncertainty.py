"""Directions in which the learnt kernels are uncertain, by fits to errors drawn from the scatter of the batches.

A draw gives every pixel of the chart a random combination of its batches' deviations, which has the covariance of the
pixel's errors; the fit to it is a draw of the kernels' error. Kept are the directions that change images most, of a
typical picture, whose values are correlated over a few pixels.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.fitted.kernels import basis

from .chart import Chart
from .regression import Sums
from .selection import Candidate, Components
from .typical_picture import seen

DRAWS = 64
SHARE = 0.99  # of the expected variance of H f that the directions describe; they are scaled to all of it
KERNELS = 0.999  # of that variance that the common kernels of the directions describe
MOST_DIRECTIONS, MOST_KERNELS = 16, 32


def error_directions(chart: Chart, candidate: Candidate, parts: Components) -> tuple[FloatArray, FloatArray]:
    """Return the kernels, (E, C), and the coefficients, (q, E, P), of errors of variance 1 each."""
    errors = _projected(chart, _draws(chart, candidate) @ parts.triangle, parts)
    draws, cells, count = errors.shape
    shown = seen(errors.swapaxes(1, 2) * chart.share**0.5).reshape(draws, -1)
    values, vectors = np.linalg.eigh(shown @ shown.T)
    total = float(values.sum())
    if total <= 0:
        return np.zeros((0, cells)), np.zeros((0, 0, count))
    kept = _needed(values, SHARE, MOST_DIRECTIONS)
    scale = (total / values[-kept:].sum() / draws) ** 0.5
    directions = np.asarray(np.tensordot(vectors[:, -kept:].T * scale, errors, axes=1), dtype=np.float64)
    terms = directions.swapaxes(1, 2).reshape(-1, cells)
    shown = seen(terms * chart.share**0.5)
    values, vectors = np.linalg.eigh(shown @ shown.T)
    vectors = vectors[:, -_needed(values, KERNELS, MOST_KERNELS) :]
    shares = vectors.reshape(kept, count, -1).swapaxes(1, 2)
    kernels: FloatArray = np.asarray(vectors.T @ terms, dtype=np.float64)
    return kernels, np.asarray(shares @ np.linalg.inv(parts.triangle), dtype=np.float64)


def _draws(chart: Chart, candidate: Candidate) -> FloatArray:
    """Return coefficients of the kernels' errors: (draws, C, P)."""
    rng, count = np.random.default_rng(0), len(chart.batches)
    x = basis(chart.field, candidate.degree)
    entries = np.zeros((DRAWS, chart.inside.shape[1], x.shape[1]))
    for batch in chart.batches:
        for draw in entries:
            weights = rng.normal(size=len(x))[:, None] / (count * (count - 1)) ** 0.5
            draw += ((x * weights).T @ batch).T
    own = Sums(candidate.sums.products, entries, candidate.sums.whole, candidate.degree)
    if not candidate.symmetric:
        return own.fitted()
    symmetric = Sums(candidate.sums.products, entries, candidate.sums.whole, candidate.degree).symmetric
    return Sums(own.products, symmetric.entries, own.whole, own.degree).fitted()


def _projected(chart: Chart, errors: FloatArray, parts: Components) -> FloatArray:
    """Return the part of errors, (draws, C, P) of orthonormal terms, that changes the mean or the components."""
    root = np.sqrt(chart.weights * chart.share)
    varying = errors[..., 1:].swapaxes(1, 2) * root
    rest = varying - parts.field @ (parts.field.T @ varying)
    rest = rest - (rest @ parts.cells.T) @ parts.cells
    changed = np.divide(varying - rest, root, out=np.zeros_like(varying), where=root > 0)
    return np.concatenate([errors[..., :1], changed.swapaxes(1, 2)], axis=2)


def _needed(values: FloatArray, share: float, most: int) -> int:
    """Return how many of the largest of rising values add up to a share of their sum."""
    left: FloatArray = np.cumsum(values[::-1], dtype=np.float64)
    return min(int(np.searchsorted(left, share * float(left[-1]))) + 1, most)
