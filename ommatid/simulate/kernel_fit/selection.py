"""The number of terms and of components of a lens type's deviations, and tests of the explanation as a whole.

More terms bring noise, fewer a bias. The sum of both in H f of a typical picture is estimated without bias from the
fit with the most terms and from the scatter of the batches (Mallows 1973, Technometrics 15, 661); the fewest terms that
an F test does not reject would leave a bias of several times the noise. F tests at 0.1 % for all together accept or
reject the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.fitted.kernels import basis

from .deviations import Chart
from .regression import Sums, chance, excess, gram, residual, sums_of

SIGNIFICANCE = 0.001  # at which a correct model is rejected, by all tests together
MOST_DEGREE = 4
HIGHER = 2  # degrees by which a test looks further than the model
MOST_SHOWN = 200  # pixels of the chart for which errors in a picture are computed
PIXELS_PER_TERM = 3  # of the chart, at least


@dataclass(frozen=True, eq=False)
class Candidate:
    """A polynomial for every cell; if it is `as_designed`, all are 0, and their errors those of the sums.

    coefficients : (1 + B, C, P) of the mean and of the batches' deviations;  chances : of each test
    excesses : of each test, the part of its sum of squares that is not noise, in units of the noise
    """

    degree: int
    symmetric: bool
    as_designed: bool
    sums: Sums
    coefficients: FloatArray
    chances: dict[str, float]
    excesses: dict[str, float]

    @property
    def rejected(self) -> list[str]:
        """The tests that it does not pass."""
        single = -np.expm1(np.log1p(-SIGNIFICANCE) / len(self.chances))
        return [name for name, value in self.chances.items() if value < single]

    @property
    def unexplained(self) -> float:
        """Mean square of what it leaves of an entry beside noise, in units of the entry's variance."""
        return self.excesses["all cells"]

    @property
    def shown(self) -> float:
        """The largest excess of the tests of a picture that it does not pass, in units of the noise."""
        return max((self.excesses[name] for name in self.rejected if name.endswith("picture")), default=0.0)


def highest_degree(chart: Chart) -> int:
    """Return the highest degree that the chart's pixels determine, with the terms that tests add."""
    fits = (degree for degree in range(MOST_DEGREE + HIGHER + 1) if _determined(chart, degree))
    return max(fits, default=0)


def _determined(chart: Chart, degree: int) -> bool:
    x = basis(chart.field, degree)
    return len(x) >= PIXELS_PER_TERM * x.shape[1] and np.linalg.matrix_rank(x, tol=1e-6 * len(x) ** 0.5) == x.shape[1]


def choose(chart: Chart) -> Candidate:
    """Return the polynomial of the least expected error.

    That of a lens without symmetry is taken only if it passes all tests and the symmetric one does not, and the design
    if neither does.
    """
    highest = highest_degree(chart)
    sums = sums_of(chart, highest)
    reference, shown = sums.fitted(), _PictureOfChart(chart)
    symmetric = _tested(chart, sums, *_best(sums.symmetric, reference, shown), symmetric=True)
    if not symmetric.rejected:
        return symmetric
    general = _tested(chart, sums, *_best(sums, reference, shown), symmetric=False)
    if not general.rejected:
        return general
    designed = _tested(chart, sums, sums.symmetric.up_to(0), as_designed=True, symmetric=True)
    return symmetric if designed.rejected else designed


def _tested(chart: Chart, sums: Sums, own: Sums, as_designed: bool, symmetric: bool) -> Candidate:
    coefficients = np.zeros_like(own.entries) if as_designed else own.fitted()
    left = residual(sums.up_to(min(own.degree + HIGHER, sums.degree)), coefficients)
    tests = term_sums(chart, left) | residual_sums(chart, coefficients, own.degree)
    chances = {name: chance(products) for name, products in tests.items()}
    excesses = {name: excess(products) for name, products in tests.items()}
    return Candidate(own.degree, symmetric, as_designed, own, coefficients, chances, excesses)


def _best(sums: Sums, reference: FloatArray, shown: _PictureOfChart) -> tuple[Sums, bool]:
    """Return the sums of the degree with the least expected loss, and True if the design has less."""
    none = np.zeros_like(reference)
    losses = [expected_loss(shown(reference, sums.degree), shown(none, sums.degree))]
    for degree in range(min(MOST_DEGREE, sums.degree) + 1):
        coefficients = sums.up_to(degree).fitted()
        padded = np.zeros_like(reference)
        padded[..., : coefficients.shape[-1]] = coefficients
        losses.append(expected_loss(shown(reference - padded, sums.degree), shown(padded, sums.degree)))
    best = int(np.argmin(losses))
    return sums.up_to(max(best - 1, 0)), best == 0


def expected_loss(dropped: FloatArray, kept: FloatArray) -> float:
    """Return the squared bias of what is dropped and the variance of what is kept: (1 + B, ...) each.

    Both for the mean and the deviations of the batches, in coordinates whose squares add up to the loss.
    """
    count = len(dropped) - 1
    bias, noise, variance = np.square(dropped[0]).sum(), np.square(dropped[1:]).sum(), np.square(kept[1:]).sum()
    return float(bias + (variance - noise) / (count * (count - 1)))


class _PictureOfChart:
    """Kernels at some pixels of a chart, cut off at the target's edge, as a typical picture shows them."""

    def __init__(self, chart: Chart) -> None:
        """Choose the pixels."""
        some = np.unique(np.linspace(0, len(chart.pixels) - 1, MOST_SHOWN).round().astype(np.int64))
        self._chart, self._field, self._inside = chart, chart.field[some], chart.inside[some]

    def __call__(self, coefficients: FloatArray, degree: int) -> FloatArray:
        """Return coefficients, (k, C, P), in coordinates whose squares are the variance of H f: (k, n, C + 1)."""
        x = basis(self._field, degree)
        return np.array([self._chart.seen((x @ each.T) * self._inside) for each in coefficients])


def term_sums(chart: Chart, left: Sums) -> dict[str, FloatArray]:
    """Return the sums of squares of polynomials that explain most of a residual: of all cells, and in a picture."""
    fitted = left.fitted()
    shown = chart.seen((fitted @ np.linalg.cholesky(left.whole)).swapaxes(1, 2) * chart.share**0.5)
    return {
        "terms": gram(fitted * chart.weights[:, None], left.entries),
        "terms in a picture": gram(shown, shown),
    }


def residual_sums(chart: Chart, coefficients: FloatArray, degree: int) -> dict[str, FloatArray]:
    """Return the sums of squares of the residuals of all cells, and of their means over each sub-imager."""
    x = basis(chart.field, degree)
    every: list[FloatArray] = []
    means: list[FloatArray] = []
    shown: list[FloatArray] = []
    root = np.sqrt(chart.weights)
    counts = _by_sub_imager(chart, chart.inside)
    for entries, each in zip((chart.values, *chart.batches), coefficients, strict=True):
        left = entries - chart.inside * (x @ each.T)
        every.append(left * root)
        mean = _by_sub_imager(chart, left) / np.sqrt(np.maximum(counts, 1.0))
        means.append(mean * root)
        shown.append(chart.seen(mean))
    tests = {"all cells": _gram(every)}
    if len(counts) > 1:
        tests["sub-imagers"] = _gram(means)
        tests["sub-imagers in a picture"] = _gram(shown)
    return tests


def _gram(parts: list[FloatArray]) -> FloatArray:
    flat = [part.ravel() for part in parts]
    return np.array([[np.dot(a, b) for b in flat] for a in flat], dtype=np.float64)


def _by_sub_imager(chart: Chart, values: FloatArray) -> FloatArray:
    _, index = np.unique(chart.sub_imagers, return_inverse=True)
    total = np.zeros((int(index.max()) + 1, values.shape[1]))
    np.add.at(total, index, values)
    return total


@dataclass(frozen=True, eq=False)
class Components:
    """Kernels of a candidate in fewer numbers.

    triangle : L of the chart's products of terms G = n L L^T: x L^-T are orthonormal terms, the constant first
    field : (P - 1, R) orthonormal polynomials;  cells : (R, C) orthonormal kernels times the root of their weights
    strengths : (R,) singular values, in standard deviations of the noise of one cell
    """

    triangle: FloatArray
    field: FloatArray
    cells: FloatArray
    strengths: FloatArray


def components(chart: Chart, candidate: Candidate) -> Components:
    """Return the principal components of the variation over the field, as many as have the least expected loss."""
    triangle = np.linalg.cholesky(candidate.sums.whole / len(chart.pixels)).astype(np.float64)
    root = np.sqrt(chart.weights * chart.share)
    varying = (candidate.coefficients @ triangle)[..., 1:].swapaxes(1, 2) * root
    count = varying.shape[1]
    if count == 0:
        empty = np.zeros((0, 0)), np.zeros((0, root.size)), np.zeros(0)
        return Components(triangle, *empty)
    field, strengths, cells = np.linalg.svd(varying[0], full_matrices=False)
    losses = [_loss_of_rank(chart, varying, field[:, :kept], cells[:kept]) for kept in range(count + 1)]
    kept = int(np.argmin(losses))
    pixels = len(chart.pixels) ** 0.5
    return Components(triangle, field[:, :kept], cells[:kept], strengths[:kept] * pixels)


def _loss_of_rank(chart: Chart, varying: FloatArray, field: FloatArray, cells: FloatArray) -> float:
    """Return the expected loss of keeping some components."""
    rest = varying - field @ (field.T @ varying)
    rest = rest - (rest @ cells.T) @ cells
    root = np.sqrt(chart.weights)
    dropped, kept = (
        chart.seen(np.divide(part, root, out=np.zeros_like(part), where=root > 0)) for part in (rest, varying - rest)
    )
    return expected_loss(dropped, kept)
