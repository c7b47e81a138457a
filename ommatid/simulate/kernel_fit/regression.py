"""Least squares of the kernels' cells on polynomials of the field.

Every cell is fitted from sums over the pixels of the chart. A lens that is symmetric about its axis shows the same
picture mirrored at mirrored positions of the field, and transposed at transposed ones if pixels are open by squares.
Averaging the sums over these operations, eight or four, gives the fit of all pixels and their images at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import special

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.fitted.kernels import basis, terms

from ..calibration.fit.chart import freedom_of
from .deviations import Chart

Turn = tuple[bool, ...]  # mirrored down, mirrored across, transposed before
SUPPORT = 0.01  # share of the chart's information on a term, below which a cell seen by few pixels does without it


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the pixels of a chart, with P terms of a polynomial.

    products : (C, P, P) of two terms over the pixels that see a cell;  entries : (k, C, P) of terms and entries, those
    of the mean first, then those of the batches' deviations;  whole : (P, P) of two terms over all pixels
    core : w, of the w^2 cells before those of the rings;  is_square : True if pixels are open by squares
    """

    products: FloatArray
    entries: FloatArray
    whole: FloatArray
    degree: int
    core: int
    is_square: bool

    @property
    def symmetric(self) -> Sums:
        """The mean over the chart and its images."""
        products, entries, whole = (np.zeros_like(each) for each in (self.products, self.entries, self.whole))
        turns = [*product((False, True), (False, True), (False, True) if self.is_square else (False,))]
        for index, sign, turn in _operations(self.degree, turns):
            signs = sign[:, None] * sign
            products += self._turned(self.products, turn, 0)[:, index[:, None], index] * signs
            entries += self._turned(self.entries, turn, 1)[..., index] * sign
            whole += self.whole[index[:, None], index] * signs
        return replace(self, products=products / len(turns), entries=entries / len(turns), whole=whole / len(turns))

    def _turned(self, sums: FloatArray, turn: Turn, axis: int) -> FloatArray:
        """Transpose and then mirror the cells of the core, which lie along an axis; the rings stay as they are."""
        mirrored_down, mirrored_across, transposed = turn
        core, rings = np.split(sums, [self.core**2], axis=axis)
        grid = core.reshape(*sums.shape[:axis], self.core, self.core, *sums.shape[axis + 1 :])
        grid = grid.swapaxes(axis, axis + 1) if transposed else grid
        mirrored = [axis + beside for beside, wanted in enumerate((mirrored_down, mirrored_across)) if wanted]
        return np.concatenate([np.flip(grid, tuple(mirrored)).reshape(core.shape), rings], axis=axis)

    def up_to(self, degree: int) -> Sums:
        """The sums of the terms up to a lower degree."""
        count = len(terms(degree))
        products, entries, whole = (each[..., :count] for each in (self.products, self.entries, self.whole))
        return replace(self, products=products[:, :count], entries=entries, whole=whole[:count], degree=degree)

    @property
    def inverses(self) -> FloatArray:
        """Pseudo-inverses of `products`, (C, P, P), without what the pixels that see a cell say little about."""
        values, vectors = np.linalg.eigh(self.whole)
        kept = values > 1e-9 * values[-1]
        root = vectors[:, kept] / np.sqrt(values[kept])
        values, vectors = np.linalg.eigh(root.T @ self.products @ root)
        inverse = np.divide(1.0, values, out=np.zeros_like(values), where=values > SUPPORT)
        back = root @ vectors
        return np.asarray((back * inverse[:, None, :]) @ back.swapaxes(1, 2))

    def fitted(self) -> FloatArray:
        """Coefficients of all cells: (k, C, P)."""
        return np.einsum("kcp,cpq->kcq", self.entries, self.inverses, optimize=True)


def sums_of(chart: Chart, degree: int) -> Sums:
    """Return the sums of a chart for polynomials up to a degree."""
    x = basis(chart.field, degree)
    count, (pixels, cells) = x.shape[1], chart.inside.shape
    pairs = (x[:, :, None] * x[:, None]).reshape(pixels, -1)
    products = (pairs.T @ np.square(chart.inside)).T.reshape(cells, count, count)
    entries = [(x.T @ (each * chart.inside)).T for each in (chart.values, *chart.batches)]
    return Sums(products, np.array(entries), x.T @ x, degree, chart.core, chart.is_square)


def residual(sums: Sums, coefficients: FloatArray) -> Sums:
    """Return the sums of what coefficients of a lower degree, (k, C, P'), leave."""
    count = coefficients.shape[-1]
    explained = np.einsum("cpq,kcq->kcp", sums.products[:, :, :count], coefficients, optimize=True)
    return replace(sums, entries=sums.entries - explained)


def gram(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the products of (k, ...) arrays, summed over all but the first axis: (k, k)."""
    return left.reshape(len(left), -1) @ right.reshape(len(right), -1).T


def chance(products: FloatArray) -> float:
    """Return the probability of a sum of squares at least as large as that of the mean if only noise is in it.

    products : (1 + B, 1 + B) of the mean and of the deviations of the batches, as of `gram`
    An F test with the effective degrees of freedom of the noise, as of `freedom_of`.
    """
    noise, free = products[1:, 1:], len(products) - 2
    trace, freedom = float(np.trace(noise)) / free, freedom_of(noise)
    if trace <= 0:
        return 1.0
    ratio = float(products[0, 0]) / (trace / (free + 1))
    return float(special.fdtrc(freedom, freedom * free, ratio))


def excess(products: FloatArray) -> float:
    """Return the part of a sum of squares that is not noise, in units of the noise; parameters as of `chance`."""
    free = len(products) - 2
    noise = float(np.trace(products[1:, 1:])) / (free * (free + 1))
    return float(products[0, 0]) / noise - 1 if noise > 0 else 0.0


def _operations(degree: int, turns: Sequence[Turn]) -> Iterator[tuple[IntArray, FloatArray, Turn]]:
    """Yield the term and the sign that each term becomes, and the mirrorings down, across and the transposition."""
    pairs = terms(degree)
    for turn in turns:
        mirrored_down, mirrored_across, transposed = turn
        index = np.array([pairs.index((b, a) if transposed else (a, b)) for a, b in pairs])
        sign = np.array([(-1.0) ** (a * mirrored_down + b * mirrored_across) for a, b in pairs])
        yield index, sign, turn
