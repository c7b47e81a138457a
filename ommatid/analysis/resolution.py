"""Resolution of an estimate: modulation transfer function and edge response from its averaging kernels, power spectra.

Frequencies are in cycles per pixel of f, up to 0.5; distances in pixels of f. The spectrum of white noise of variance
s^2 is s^2 at all frequencies, and the mean of a spectrum over all frequencies is the mean square of the image. A Hann
window suppresses the leakage of the edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.model import Model

from .averaging_kernel import ErrorWindow

FREQUENCIES = 51
HALF_WIDTH = 8  # of the edge response, in pixels
LOW, HIGH = 0.1, 0.9  # of the edge, between which its width is measured
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


@dataclass(frozen=True)
class EdgeResponse:
    """An image of a step from 0 to 1 at distance 0: (K,) distances in pixels and values."""

    distances: FloatArray
    values: FloatArray

    @property
    def width(self) -> float | None:
        """Distance from 10 % to 90 % of the step, None where the response does not reach them."""
        total = self.values[-1] - self.values[0]
        if total <= 0:
            return None
        relative = (self.values - self.values[0]) / total
        ends = [_rise_to(self.distances, relative, level) for level in (LOW, HIGH)]
        return None if ends[0] is None or ends[1] is None else ends[1] - ends[0]


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


def edge_response(kernels: FloatArray, centres: FloatArray) -> EdgeResponse:
    """Return the mean response to an edge between two columns and between two rows, at positions beside the edge.

    A pixel of f has one value: that of an edge through it is the share of its width beyond the edge.
    """
    distances = np.arange(1 - 2 * HALF_WIDTH, 2 * HALF_WIDTH, dtype=np.float64) / 2
    responses: list[FloatArray] = []
    for axis in (1, 0):
        lines = kernels.sum(axis=2 - axis)
        places = np.arange(lines.shape[1], dtype=np.float64)
        for line, centre in zip(lines, centres[:, axis], strict=True):
            # At distance d the edge lies at centre - d: what is beyond it is 1.
            shares = np.clip(places - (centre - distances[:, None]) + 0.5, 0, 1)
            responses.append(shares @ line)
    return EdgeResponse(distances, np.mean(responses, axis=0))


def of_window(window: ErrorWindow) -> tuple[Transfer, EdgeResponse]:
    """Return both for the central pixels of a window."""
    pixels = window.centre
    kernels = window.kernels(pixels)
    centres = positions(pixels, window.size[1])
    return transfer(kernels, centres), edge_response(kernels, centres)


def positions(pixels: IntArray, columns: int) -> FloatArray:
    """Return row and column of pixels by their indices: (k, 2)."""
    return np.stack([pixels // columns, pixels % columns], axis=1).astype(np.float64)


def _rise_to(distances: FloatArray, values: FloatArray, level: float) -> float | None:
    """Return the first distance at which the values rise to a level, by linear interpolation."""
    above = np.flatnonzero(values >= level)
    if not above.size or above[0] == 0:
        return None
    index = int(above[0])
    share = (level - values[index - 1]) / (values[index] - values[index - 1])
    return float(distances[index - 1] + share * (distances[index] - distances[index - 1]))


def of_sub_image(model: Model, window: ErrorWindow, name: str) -> tuple[Transfer, EdgeResponse] | None:
    """Return both for the footprint of a sensor pixel of a sub-imager, the one next to the middle of the window.

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
    footprint, centre = footprints[nearest : nearest + 1], centroids[nearest : nearest + 1]
    return transfer(footprint, centre), edge_response(footprint, centre)


MOST_BINS = 24
FEWEST_BINS = 4
NYQUIST = 0.5  # cycles per pixel


@dataclass(frozen=True)
class RadialSpectrum:
    """Mean power in rings of frequencies up to 0.5 cycles per pixel: (B,) mean frequencies and powers."""

    frequencies: FloatArray
    powers: FloatArray


def radial_spectrum(image: FloatArray) -> RadialSpectrum:
    """Return the radial spectrum of an image, (rows, columns), about its mean. Missing values count as the mean."""
    known = np.isfinite(image)
    values = np.where(known, image, image[known].mean() if known.any() else 0.0).astype(np.float64)
    across, along = (np.square(np.sin(np.pi * (np.arange(int(size)) + 0.5) / size)) for size in values.shape)
    weights = np.multiply.outer(across, along)
    values = (values - float((weights * values).sum() / weights.sum())) * weights
    power = np.square(np.abs(np.fft.fft2(values))) / np.square(weights).sum()
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(size) for size in values.shape), indexing="ij"))
    bins = int(np.clip(min(values.shape) // 4, FEWEST_BINS, MOST_BINS))
    ring = np.minimum((radius / NYQUIST * bins).astype(np.int64), bins)  # the last holds what is beyond
    ring[0, 0] = bins
    counts = np.bincount(ring.ravel(), minlength=bins + 1)[:bins]
    totals = [np.bincount(ring.ravel(), part.ravel(), minlength=bins + 1)[:bins] for part in (radius, power)]
    shown = counts > 0
    return RadialSpectrum(totals[0][shown] / counts[shown], totals[1][shown] / counts[shown])


def crossing(signal: RadialSpectrum, error: RadialSpectrum) -> float | None:
    """Return the first frequency at which the error is as strong as the signal, None if it never is."""
    weaker = np.flatnonzero(error.powers >= signal.powers)
    return float(error.frequencies[weaker[0]]) if weaker.size else None
