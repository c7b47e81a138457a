"""Approximate inverse of the precision of a frame: as if the camera saw the image reflected at its edges, and strips.

Far from the edges the precision K = H^T Rv^-1 H + P0^-1 of a camera whose sub-imagers see the same everywhere is the
same at every pixel. M, the precision of readings that continue beyond the edges, where they see the image reflected, is
diagonal under the cosine transform (DCT-II), as the prior is. K lacks these readings: M exceeds it near the edges. In a
strip along an edge K is diagonal under the cosine transform along the edge, with a small matrix for each frequency, so
that

    P = M^-1 + sum over edges of R_e^T (K_e^-1 - M_e^-1) R_e
             + sum over corners of R_c^T (K_c^-1 - sum over both edges of K_e,c^-1 + M_c^-1) R_c,

with K_e and M_e the two on a strip, R_e the choice of its pixels, and alike at a corner, where K_e,c is what the strip
takes for K there: so every place counts once (an additive Schwarz method; Smith, Bjorstad and Gropp 1996). Where noise
is uneven, K is about S M S with S the root of the local weight over the mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.observation import Observation

DEPTH = 16  # pixels of a strip
WORKERS = -1  # threads of a transform: all cores; each row belongs to one thread, so results do not change
LEAST = 1e-12  # of the eigenvalues of a strip's correction, relative to the largest of K_e^-1


@dataclass(frozen=True)
class Preconditioner:
    """P, for a camera that is like the one whose precision is K.

    weights : mean of 1 / Rv of each part of `alike`
    prior : 1 / P0 of independent pixels, or 1 / its spectrum, (rows, columns), under the DCT-II
    scale : (rows, columns) S, 1 where noise is even
    """

    alike: Observation = field(repr=False)
    weights: tuple[float, ...]
    prior: float | FloatArray
    scale: FloatArray | float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frame."""
        return self.alike.shape

    @cached_property
    def spectrum(self) -> FloatArray:
        """Eigenvalues of M: (rows, columns)."""
        total: FloatArray = np.zeros(self.shape)
        for part, weight in zip(self.alike.parts, self.weights, strict=True):
            total += weight * part.information()
        return total + self.prior

    def solve(self, image: FloatArray) -> FloatArray:
        """Return approximately K^-1 r, (rows, columns): symmetric positive definite, as conjugate gradients need."""
        scaled = image / self.scale
        waves = fft.dctn(scaled, 2, norm="ortho", workers=WORKERS)
        waves /= self.spectrum
        solution: FloatArray = np.asarray(fft.idctn(waves, 2, norm="ortho", workers=WORKERS, overwrite_x=True))
        for strip in self._strips:
            strip.add(scaled, solution)
        for rows, columns, excess in self._corners:
            near = scaled[rows, columns]
            solution[rows, columns] += (excess @ near.ravel()).reshape(near.shape)
        return solution / self.scale

    @cached_property
    def _strips(self) -> tuple[_Strip, ...]:
        """Strips along the top, bottom, left and right."""
        return tuple(self._strip(axis, last=last) for axis, last in product((0, 1), (False, True)))

    def _strip(self, axis: int, *, last: bool) -> _Strip:
        part = _edge(self.shape[axis], last=last)
        precision = self._precision(axis, part)
        whole = _restricted(self.spectrum, axis, part)
        values, vectors = np.linalg.eigh(np.linalg.inv(precision) - np.linalg.inv(whole))
        values = np.where(values > LEAST * values[:, -1:], values, 0.0)
        return _Strip(axis, part, (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2))

    def _precision(self, axis: int, part: slice) -> FloatArray:
        """K_e of a strip: (length, depth, depth)."""
        precision = self._prior_on(axis, part)
        for each, weight in zip(self.alike.parts, self.weights, strict=True):
            precision += weight * each.edge_information(axis, part)
        return precision

    def _prior_on(self, axis: int, part: slice) -> FloatArray:
        """P0^-1 of a strip: (length, depth, depth)."""
        if isinstance(self.prior, np.ndarray):
            return _restricted(self.prior, axis, part)
        depth = part.stop - part.start
        return np.tile(self.prior * np.eye(depth), (self.shape[1 - axis], 1, 1))

    @cached_property
    def _corners(self) -> list[tuple[slice, slice, FloatArray]]:
        """Rows and columns of each corner, and what it adds to P there: (pixels, pixels)."""
        found: list[tuple[slice, slice, FloatArray]] = []
        for bottom, right in product((False, True), repeat=2):
            rows, columns = (_edge(size, last=last) for size, last in zip(self.shape, (bottom, right), strict=True))
            exact = _along(self._prior_on(0, rows), columns)
            for each, weight in zip(self.alike.parts, self.weights, strict=True):
                exact += weight * each.corner_information(rows, columns)
            along_row = _along(self._precision(0, rows), columns)
            along_column = _turned(_along(self._precision(1, columns), rows), rows, columns)
            whole = _along(_restricted(self.spectrum, 0, rows), columns)
            first, second, third, fourth = (np.linalg.inv(each) for each in (exact, along_row, along_column, whole))
            found.append((rows, columns, first - second - third + fourth))
        return found


def _along(blocks: FloatArray, part: slice) -> FloatArray:
    """Return a strip's matrix, (length, depth, depth) by frequencies along it, on a part of its length."""
    length, depth, _ = blocks.shape
    waves = np.asarray(fft.dct(np.eye(length)[:, part], 2, axis=0, norm="ortho"))
    size = waves.shape[1]
    pairs = (waves[:, :, None] * waves[:, None, :]).reshape(length, size * size)
    found = (blocks.reshape(length, -1).T @ pairs).reshape(depth, depth, size, size)
    return found.transpose(0, 2, 1, 3).reshape(depth * size, depth * size)


def _turned(matrix: FloatArray, rows: slice, columns: slice) -> FloatArray:
    """Return the matrix of a window whose pixels were numbered by columns, with those numbered by rows."""
    tall, wide = rows.stop - rows.start, columns.stop - columns.start
    return matrix.reshape(wide, tall, wide, tall).transpose(1, 0, 3, 2).reshape(tall * wide, tall * wide)


def _edge(size: int, *, last: bool) -> slice:
    """Return the pixels of a strip at the first or last end of an axis; strips at both ends do not overlap."""
    depth = min(DEPTH, size // 2)
    return slice(size - depth, size) if last else slice(0, depth)


def _restricted(spectrum: FloatArray, axis: int, part: slice) -> FloatArray:
    """Return a matrix that is diagonal under the DCT-II on a strip, by frequencies along it: (length, depth, depth)."""
    across = spectrum if axis == 0 else spectrum.T
    size, depth = across.shape[0], part.stop - part.start
    waves = np.asarray(fft.dct(np.eye(size)[:, part], 2, axis=0, norm="ortho"))  # (frequencies, depth)
    pairs = (waves[:, :, None] * waves[:, None, :]).reshape(size, depth * depth)
    return (across.T @ pairs).reshape(-1, depth, depth)


@dataclass(frozen=True)
class _Strip:
    """K_e^-1 - M_e^-1 of a strip: (length, depth, depth), by frequencies along the edge."""

    axis: int
    part: slice
    excess: FloatArray

    def add(self, right: FloatArray, solution: FloatArray) -> None:
        """Add R^T (K_e^-1 - M_e^-1) R r to the solution."""
        source, target = (right, solution) if self.axis == 0 else (right.T, solution.T)
        waves: FloatArray = np.asarray(fft.dct(source[self.part], 2, axis=1, norm="ortho", workers=WORKERS))
        waves = np.asarray(np.einsum("kij,jk->ik", self.excess, waves))
        target[self.part] += np.asarray(fft.idct(waves, 2, axis=1, norm="ortho", workers=WORKERS))
