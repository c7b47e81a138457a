"""Radial power spectra of images and of their errors, in the squared units of f.

The spectrum of white noise of variance s^2 is s^2 at all frequencies, and the mean of a spectrum over all frequencies
is the mean square of the image. A Hann window suppresses the leakage of the edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray

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
    weights = np.multiply.outer(*(_hann(size) for size in values.shape))
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


def _hann(size: int) -> FloatArray:
    return np.square(np.sin(np.pi * (np.arange(size) + 0.5) / size))
