"""Correlations of an image with wide kernels by Fourier transforms, and their adjoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.processors import processors


@dataclass(frozen=True, eq=False)
class WideCorrelation:
    """Correlation with each of S kernels, sampled at a grid of places and summed with weights of each place.

    shape : of the image;  kernels : (S, W, W)
    top, left : first row of f of each line of places, (a,), and first column, (b,);  may be negative
    shares : S products, (a, P) and (b, P), whose outer product is the weight of a kernel
    """

    shape: tuple[int, int]
    kernels: FloatArray
    top: IntArray
    left: IntArray
    shares: list[tuple[FloatArray, FloatArray]]

    @property
    def _padded(self) -> tuple[int, int]:
        wide = self.kernels.shape[-1]
        rows, columns = (fft.next_fast_len(size + wide - 1, real=True) for size in self.shape)
        return rows, columns

    def _spectrum(self, kernel: FloatArray) -> NDArray[np.complex128]:
        return np.conj(fft.rfft2(kernel, self._padded, workers=processors()))

    def forward(self, image: FloatArray) -> FloatArray:
        """Return the sums at all places: (a, b)."""
        rows, columns = self._padded
        seen = fft.rfft2(image, self._padded, workers=processors())
        places = np.ix_(self.top % rows, self.left % columns)
        out = np.zeros((self.top.size, self.left.size))
        for kernel, (down, across) in zip(self.kernels, self.shares, strict=True):
            every = fft.irfft2(seen * self._spectrum(kernel), self._padded, workers=processors(), overwrite_x=True)
            out += every[places] * (down @ across.T)
        return out

    def adjoint(self, readings: FloatArray) -> FloatArray:
        """Return the image of readings at all places, (a, b): (rows, columns)."""
        rows, columns = self._padded
        down_places, across_places = _selection(self.top % rows, rows), _selection(self.left % columns, columns)
        total: NDArray[np.complex128] = np.zeros((rows, columns // 2 + 1), dtype=np.complex128)
        for kernel, (down, across) in zip(self.kernels, self.shares, strict=True):
            spread: FloatArray = down_places.T @ (readings * (down @ across.T)) @ across_places
            total += np.asarray(fft.rfft2(spread, workers=processors())) * np.conj(self._spectrum(kernel))
        every = fft.irfft2(total, self._padded, workers=processors(), overwrite_x=True)
        return every[: self.shape[0], : self.shape[1]]


def _selection(places: IntArray, size: int) -> sparse.csr_array:
    """Return the matrix that selects places of a line: (places, size)."""
    count = places.size
    return sparse.csr_array((np.ones(count), (np.arange(count), places)), shape=(count, size))
