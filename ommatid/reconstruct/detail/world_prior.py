"""The prior of the world on its own grid, finer than f, and what f leaves open of it.

The world w has the covariance P, and f = A w averages it over F x F pixels. Given f, the best linear estimate of w is

    w0 + B (f - f0),   B = P A^T (A P A^T)^-1,   with covariance P - B A P.

P is diagonal in the cosine waves of the world, and A P A^T in those of f: each of these sums a band of the former.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors
from ommatid.scenes.tables.estimation import PriorTable

from ..prior import averaged_spectrum, coloured, cosine_waves, spectrum_of

COLUMNS = 64  # of P A^T and P H^T that are computed at once


@dataclass(frozen=True)
class WorldPrior:
    """Covariance P of a world `detail` times finer than f, whose shape is `shape`; `spectrum` as of `spectrum_of`."""

    shape: tuple[int, int]
    detail: int
    spectrum: FloatArray

    @classmethod
    def of(cls, table: PriorTable, shape: tuple[int, int], pitch: float, detail: int) -> WorldPrior:
        """Return the prior of a [prior] table of correlated pixels; shape, pitch : of f. Refuses kind "fit"."""
        fine = shape[0] * detail, shape[1] * detail
        return cls(shape, detail, np.asarray(spectrum_of(table, fine, pitch / detail)))

    @property
    def fine_shape(self) -> tuple[int, int]:
        """Rows and columns of the world."""
        return self.shape[0] * self.detail, self.shape[1] * self.detail

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of every pixel of the world, the diagonal of P: (pixels of the world,)."""
        vertical, horizontal = (np.square(cosine_waves(size)) for size in self.fine_shape)
        return np.asarray(vertical @ self.spectrum @ horizontal.T).ravel()

    def apply(self, images: FloatArray) -> FloatArray:
        """Return P X: (pixels of the world, q) to (pixels of the world, q)."""
        product = np.empty(images.shape)
        for start in range(0, images.shape[1], COLUMNS):
            part = np.ascontiguousarray(images[:, start : start + COLUMNS].T).reshape(-1, *self.fine_shape)
            product[:, start : start + COLUMNS] = _filtered(part, self.spectrum).reshape(len(part), -1).T
        return product

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw a world less its mean: (pixels of the world,)."""
        return coloured(self.spectrum, rng.normal(size=self.fine_shape)).ravel()

    @cached_property
    def averages(self) -> FloatArray:
        """P A^T, the covariances of the world's pixels with those of f: (pixels of the world, N)."""
        return self.apply(np.asarray(averaging(self.shape, self.detail).T.toarray(), dtype=np.float64))

    @cached_property
    def interpolation(self) -> FloatArray:
        """B, from deviations of f to those of the world: (pixels of the world, N)."""
        images = self.averages.reshape(-1, *self.shape)
        return _filtered(images, 1 / averaged_spectrum(self.spectrum, self.detail)).reshape(self.averages.shape)

    @cached_property
    def unresolved(self) -> FloatArray:
        """Variance of every pixel of the world given f, the diagonal of P - B A P: (pixels of the world,)."""
        explained = np.einsum("ij,ij->i", self.interpolation, self.averages)
        return np.maximum(self.variance - explained, 0.0)


def _filtered(images: FloatArray, spectrum: FloatArray) -> FloatArray:
    """Return C^T diag(s) C of images: (q, rows, columns)."""
    waves = fft.dctn(images, 2, axes=(1, 2), norm="ortho", workers=processors())
    waves *= spectrum
    return np.asarray(fft.idctn(waves, 2, axes=(1, 2), norm="ortho", workers=processors(), overwrite_x=True))


def averaging(shape: tuple[int, int], detail: int) -> sparse.csr_array:
    """Return A, the averages over detail x detail pixels of the world: (N, pixels of the world)."""
    rows, columns = (sparse.kron(sparse.eye_array(size), np.full((1, detail), 1 / detail)) for size in shape)
    return sparse.csr_array(sparse.kron(rows, columns, format="csr"))


def repetition(shape: tuple[int, int], detail: int) -> sparse.csr_array:
    """Return the world made of f's pixels, each repeated detail x detail times: (pixels of the world, N)."""
    return sparse.csr_array(averaging(shape, detail).T * float(detail**2))


def world_of(image: FloatArray, spectrum: FloatArray, detail: int) -> FloatArray:
    """Return the likeliest world less its mean, P A^T (A P A^T)^-1 f, of an image, (rows, columns), less its mean."""
    waves = np.asarray(fft.dctn(image, 2, norm="ortho")) / averaged_spectrum(spectrum, detail)
    averages = np.kron(np.asarray(fft.idctn(waves, 2, norm="ortho")), np.full((detail, detail), detail**-2.0))
    spread = np.asarray(fft.dctn(averages, 2, norm="ortho")) * spectrum
    return np.asarray(fft.idctn(spread, 2, norm="ortho")).ravel()
