"""Modulation transfer function of an estimate, from its averaging kernels, and of a sensor pixel.

Frequencies are in cycles per pixel of f, up to 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.model import Model

from .averaging_kernel import ErrorWindow

FREQUENCIES = 51
HALF = 0.5  # of the contrast, at which resolution is stated


@dataclass(frozen=True)
class Transfer:
    """Share of a wave's contrast that an image keeps, by frequency: waves along the rows and along the columns.

    frequencies : (F,);  horizontal, vertical : (F,), of waves whose phase changes along a row, and along a column
    """

    frequencies: FloatArray
    horizontal: FloatArray
    vertical: FloatArray

    @property
    def half(self) -> float | None:
        """The frequency at which the mean of both falls to half, None if it never does."""
        mean = (self.horizontal + self.vertical) / 2
        below = np.flatnonzero(mean < HALF)
        if not below.size:
            return None
        index = int(below[0])
        if index == 0:
            return 0.0
        before, after = mean[index - 1], mean[index]
        share = (before - HALF) / (before - after)
        step = self.frequencies[index] - self.frequencies[index - 1]
        return float(self.frequencies[index - 1] + share * step)


def transfer(kernels: FloatArray, centres: FloatArray) -> Transfer:
    """Return the transfer function of kernels, averaged over them: the modulus of their mean Fourier transform.

    kernels : (k, rows, columns);  centres : (k, 2), row and column to which the phases refer
    """
    frequencies = np.linspace(0, 0.5, FREQUENCIES)
    moduli: list[FloatArray] = []
    for axis in (1, 0):
        lines = kernels.sum(axis=2 - axis)
        distances = np.arange(lines.shape[1], dtype=np.float64) - centres[:, axis, None]
        waves = np.exp(-2j * np.pi * frequencies[:, None, None] * distances)
        moduli.append(np.abs((waves * lines).sum(axis=2).mean(axis=1)))
    return Transfer(frequencies, moduli[0], moduli[1])


def of_window(window: ErrorWindow) -> Transfer:
    """Return the transfer function of the central pixels of a window."""
    pixels = window.centre
    return transfer(window.kernels(pixels), positions(pixels, window.size[1]))


def positions(pixels: IntArray, columns: int) -> FloatArray:
    """Return row and column of pixels by their indices: (k, 2)."""
    return np.stack([pixels // columns, pixels % columns], axis=1).astype(np.float64)


def of_sub_image(model: Model, window: ErrorWindow, name: str) -> Transfer | None:
    """Return that of the footprint of a sensor pixel of a sub-imager, the one next to the middle of the window.

    None where no footprint lies inside the window.
    """
    camera = model.camera
    index = next((index for index, sub in enumerate(camera.sub_imagers) if sub.name == name), None)
    if index is None:
        return None
    part, inside = camera.slices()[index], model.windowed.measurements_inside(window.rows, window.columns)
    chosen = np.flatnonzero((inside >= part.start) & (inside < part.stop))
    footprints = model.windowed.submatrix(window.rows, window.columns)[chosen].toarray().reshape(-1, *window.size)
    sums = footprints.sum(axis=(1, 2))
    footprints = footprints[sums > 0] / sums[sums > 0, None, None]
    if not footprints.size:
        return None
    centroids = np.stack(
        [
            (footprints.sum(axis=2) * np.arange(window.size[0])).sum(axis=1),
            (footprints.sum(axis=1) * np.arange(window.size[1])).sum(axis=1),
        ],
        axis=1,
    )
    middle = (np.array(window.size) - 1) / 2
    nearest = int(np.argmin(np.square(centroids - middle).sum(axis=1)))
    return transfer(footprints[nearest : nearest + 1], centroids[nearest : nearest + 1])
