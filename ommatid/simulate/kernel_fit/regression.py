"""Entries of H of a chart's sensor pixels, and least squares of the kernels on polynomials of the field.

Entries are taken in coordinates relative to the footprints of their pixels. Every cell of the kernels is fitted from
sums over the pixels of the chart. A lens that is symmetric about its axis shows the same picture mirrored at mirrored
positions of the field, and transposed at transposed ones, on a grid of squares exactly. Averaging the sums over these
eight operations gives the fit of all pixels and their images at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy import sparse, stats

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.memory import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernels import KernelPlaces, basis, terms
from ommatid.scenes.lens_type import LensType

from ..calibration.point_sources import Responses

LEAST_RAYS = 20.0  # in a cell, of all pixels: the fewest that its weight assumes, since few rays are not Gaussian
LEAST_SCATTER = 1e-3  # of independent rays' variance: the least that a weight assumes
Turn = tuple[bool, ...]  # mirrored down, mirrored across, transposed before
SUPPORT = 0.01  # share of the chart's information on a term, below which a cell seen by few pixels does without it


@dataclass(frozen=True, eq=False)
class Chart:
    """Rows of H of n sensor pixels of a lens type, each of C = W^2 cells of the kernels.

    pixels : (n,) among those of the type;  values : (n, C), 0 beside the target
    inside : (n, C), True for cells on the target;  batches : (B, n, C) deviations of the batches from `values`
    rays : per pixel
    """

    places: KernelPlaces
    pixels: IntArray
    values: FloatArray
    inside: BoolArray
    batches: Float32Array
    rays: int

    @cached_property
    def field(self) -> FloatArray:
        """Positions (u, v) of the footprints: (n, 2)."""
        return self.places.positions(self.pixels)

    @cached_property
    def sub_imagers(self) -> IntArray:
        """The sub-imager of each pixel, numbered within the type: (n,)."""
        rows, columns = self.places.lens_type.pixels
        return self.pixels // (rows * columns)

    @cached_property
    def share(self) -> FloatArray:
        """Share of the pixels that see each cell: (C,)."""
        return self.inside.mean(axis=0)

    @cached_property
    def weights(self) -> FloatArray:
        """Inverse variances of a cell of one row, pooled over all rows: (C,), 0 for cells that no row has."""
        seen = self.inside.sum(axis=0)
        count = len(self.batches)
        squares = np.zeros(seen.size)
        for batch in self.batches:
            squares += np.square(batch, dtype=np.float64).sum(axis=0)
        variance = squares / (count * (count - 1)) / np.maximum(seen, 1)
        rate = (np.maximum(self.values.sum(axis=0) * self.rays, 0.0) + LEAST_RAYS) / np.maximum(seen * self.rays, 1)
        single = LEAST_RAYS / np.maximum(seen * self.rays, 1) / self.rays
        floor = np.maximum(single, LEAST_SCATTER * rate / self.rays)
        return np.where(seen > 0, 1 / np.maximum(variance, floor), 0.0)


def chart_of(responses: Responses, camera: Camera, lens_type: LensType, pixels: IntArray | None = None) -> Chart | None:
    """Return the chart of a lens type, or None if one of its pixels is dark.

    pixels : of the type, that the chart holds; None: those with light
    """
    matrix = responses.matrix[camera.type_slices()[camera.types.index(lens_type)]]
    counts = np.diff(matrix.indptr)
    pixels = np.flatnonzero(counts) if pixels is None else pixels
    if not pixels.size or not counts[pixels].all():
        return None
    places = KernelPlaces(camera, lens_type, _margin(camera, lens_type, matrix))
    size = places.width**2
    needed = pixels.size * size * (8 + 4 * len(responses.batches) + 1)
    check_memory(2 * needed, f"the kernels of lens type {lens_type.name}", "calibrate with calibration.fit = 'none'")
    cell = _cells(places, matrix)
    index = np.full(counts.size, -1)
    index[pixels] = np.arange(pixels.size)
    row = index[np.repeat(np.arange(counts.size), counts)]
    first = responses.matrix.indptr[camera.type_slices()[camera.types.index(lens_type)].start]
    stored = slice(int(first), int(first) + matrix.nnz)
    values = np.zeros((pixels.size, size))
    batches = np.zeros((len(responses.batches), pixels.size, size), dtype=np.float32)
    values[row, cell] = matrix.data
    for batch, entries in zip(batches, responses.batches[:, stored], strict=True):
        batch[row, cell] = entries
    down, across = (
        (cells >= 0) & (cells < size) for cells, size in zip(places.cells(pixels), camera.shape, strict=True)
    )
    inside = (down[:, :, None] & across[:, None]).reshape(pixels.size, size)
    return Chart(places, pixels, values, inside, batches, responses.passes * responses.samples)


def _offsets(places: KernelPlaces, matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Return row and column of each entry, from the corner of its pixel's kernel: (nnz,) each."""
    pixel = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    row, column = places.lines(pixel)
    down, across = np.divmod(matrix.indices.astype(np.int64), places.camera.columns)
    return down - places.starts[0][row], across - places.starts[1][column]


def _cells(places: KernelPlaces, matrix: sparse.csr_array) -> IntArray:
    down, across = _offsets(places, matrix)
    return down * places.width + across


def _margin(camera: Camera, lens_type: LensType, matrix: sparse.csr_array) -> int:
    """Return the pixels of f beyond a footprint that light reaches on any side."""
    last = int(lens_type.ratio) - 1
    offsets = _offsets(KernelPlaces(camera, lens_type, 0), matrix)
    return max(max(-int(offset.min()), int(offset.max()) - last, 0) for offset in offsets)


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the pixels of a chart, with P terms of a polynomial.

    products : (C, P, P) of two terms over the pixels that see a cell;  entries : (k, C, P) of terms and entries, those
    of the mean first, then those of the batches' deviations;  whole : (P, P) of two terms over all pixels
    """

    products: FloatArray
    entries: FloatArray
    whole: FloatArray
    degree: int

    @property
    def symmetric(self) -> Sums:
        """The mean over the chart and its seven images."""
        size = round(len(self.products) ** 0.5)
        products, entries, whole = (np.zeros_like(each) for each in (self.products, self.entries, self.whole))
        for index, sign, turn in _operations(self.degree):
            signs = sign[:, None] * sign
            turned = _turned(self.products.reshape(size, size, *self.whole.shape), turn, (0, 1))
            products += turned.reshape(self.products.shape)[:, index[:, None], index] * signs
            grid = self.entries.reshape(-1, size, size, index.size)
            entries += _turned(grid, turn, (1, 2)).reshape(self.entries.shape)[..., index] * sign
            whole += self.whole[index[:, None], index] * signs
        return Sums(products / 8, entries / 8, whole / 8, self.degree)

    def up_to(self, degree: int) -> Sums:
        """The sums of the terms up to a lower degree."""
        count = len(terms(degree))
        return Sums(self.products[:, :count, :count], self.entries[..., :count], self.whole[:count, :count], degree)

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
    products = (pairs.T @ chart.inside.astype(np.float64)).T.reshape(cells, count, count)
    entries = [(x.T @ each).T for each in (chart.values, *chart.batches)]
    return Sums(products, np.array(entries), x.T @ x, degree)


def residual(sums: Sums, coefficients: FloatArray) -> Sums:
    """Return the sums of what coefficients of a lower degree, (k, C, P'), leave."""
    count = coefficients.shape[-1]
    explained = np.einsum("cpq,kcq->kcp", sums.products[:, :, :count], coefficients, optimize=True)
    return Sums(sums.products, sums.entries - explained, sums.whole, sums.degree)


def gram(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the products of (k, ...) arrays, summed over all but the first axis: (k, k)."""
    return left.reshape(len(left), -1) @ right.reshape(len(right), -1).T


def chance(products: FloatArray) -> float:
    """Return the probability of a sum of squares at least as large as that of the mean if only noise is in it.

    products : (1 + B, 1 + B) of the mean and of the deviations of the batches, as of `gram`
    An F test with the effective degrees of freedom (tr S)^2 / tr S^2 (Bai and Saranadasa 1996, Statistica Sinica 6).
    """
    noise, free = products[1:, 1:], len(products) - 2
    trace, square = float(np.trace(noise)) / free, float(np.square(noise).sum()) / free**2
    if trace <= 0:
        return 1.0
    squares = free**2 / ((free - 1) * (free + 2)) * (square - trace**2 / free)
    freedom = max(1.0, trace**2 / max(squares, trace**2 * 1e-9))
    ratio = float(products[0, 0]) / (trace / (free + 1))
    return float(stats.f.sf(ratio, freedom, freedom * free))


def excess(products: FloatArray) -> float:
    """Return the part of a sum of squares that is not noise, in units of the noise; parameters as of `chance`."""
    free = len(products) - 2
    noise = float(np.trace(products[1:, 1:])) / (free * (free + 1))
    return float(products[0, 0]) / noise - 1 if noise > 0 else 0.0


def _operations(degree: int) -> Iterator[tuple[IntArray, FloatArray, Turn]]:
    """Yield the term and the sign that each term becomes, and the mirrorings down, across and the transposition."""
    pairs = terms(degree)
    for turn in product((False, True), repeat=3):
        mirrored_down, mirrored_across, transposed = turn
        index = np.array([pairs.index((b, a) if transposed else (a, b)) for a, b in pairs])
        sign = np.array([(-1.0) ** (a * mirrored_down + b * mirrored_across) for a, b in pairs])
        yield index, sign, turn


def _turned(grid: FloatArray, turn: Turn, axes: tuple[int, int]) -> FloatArray:
    """Transpose and then mirror the cells."""
    mirrored_down, mirrored_across, transposed = turn
    grid = grid.swapaxes(*axes) if transposed else grid
    mirrored = [axis for axis, wanted in zip(axes, (mirrored_down, mirrored_across), strict=True) if wanted]
    return np.flip(grid, tuple(mirrored))
