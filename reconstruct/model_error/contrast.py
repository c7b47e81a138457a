"""Contrast of the true image from a noisy estimate, on which the effect of the errors of H depends.

An estimate shows the contrast of the image and that of its own noise, and loses some of the finest. Its power spectrum
is F = T S + N, with S that of the image, T the power transfer of the estimator, which one random image shows, and N
that of the noise, which random noise shows. The estimate is filtered so that its spectrum becomes S: each wave keeps
its place in the image and gets the power that is due. Where noise hides S, a power law continues it, as spectra of
images follow one (Field 1987, J. Opt. Soc. Am. A 4, 2379).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.scenes.model import Model

from ..methods.method import Method, PosteriorOperators
from .attenuation import Attenuation

SEED = 20260403  # of random images and noise, different from those of the other analyses
BINS = 12  # of frequency
FEWEST_WAVES = 8  # in a bin
SIGNAL = 0.5  # excess over the noise, relative, from which a bin is determined
FITTED = 5  # bins at the end of the determined range that fix the power law
TRANSFER = (0.05, 1.2)  # range of T: beyond it, it is chance
MANY = 100_000  # pixels above which one noise image is enough
FEW = 10_000  # pixels below which four are taken


@dataclass(frozen=True)
class Contrast:
    """An image, (N,), with the contrast of the true one, and noise images as the estimate's, (N,) each.

    calibration : (measurements used,) variance that the uncertainty of H adds for the true image
    """

    image: FloatArray
    noise: tuple[FloatArray, ...]
    calibration: FloatArray


def true_contrast(method: Method, operators: PosteriorOperators, actual: FloatArray) -> Contrast:
    """Return the contrast of the image that a method has estimated; actual : (measurements used,) noise variances."""
    task = method.task
    rng, waves = np.random.default_rng(SEED), Waves(task.shape)
    count = 1 if task.model.unknowns > MANY else 2 if task.model.unknowns > FEW else 4
    whites = [rng.normal(size=actual.size) for _ in range(count)]
    root = np.sqrt(actual)
    noise = tuple(operators.gain(root * white) for white in whites)
    deviation = method.image - task.prior.mean
    power, by_noise = waves.power(deviation), np.mean([waves.power(image) for image in noise], axis=0)
    excess = power - by_noise
    determined = excess > by_noise * np.maximum(SIGNAL, 4 / np.sqrt(waves.counts))
    first = continued(waves.frequencies, excess, determined)
    attenuation = Attenuation.of(method, operators, whites, noise, root)
    transfer = _transfer(waves, waves.draw(first, rng), operators, task.model, attenuation, task.used)
    spectrum = continued(waves.frequencies, excess / transfer, determined)
    filtered = waves.scaled(deviation, np.sqrt(spectrum / np.maximum(power, np.finfo(np.float64).tiny)))
    image = task.prior.mean + filtered
    return Contrast(image, noise, _calibration(task.model, method.image, image, noise)[task.used])


def _calibration(model: Model, estimate: FloatArray, image: FloatArray, noise: tuple[FloatArray, ...]) -> FloatArray:
    """Return the variance that H's uncertainty adds, (M,): placed as by the estimate, in sum as by the image."""
    placed, whole = model.variance_from_model(estimate, noise), model.variance_from_model(image)
    total = float(placed.sum())
    return placed * (float(whole.sum()) / total) if total > 0 else placed


def _transfer(
    waves: Waves,
    image: FloatArray,
    operators: PosteriorOperators,
    model: Model,
    attenuation: Attenuation,
    used: BoolArray,
) -> FloatArray:
    """Return the power transfer from an image to its estimate with noisy H, by bin of frequency."""
    seen = operators.gain(model.forward(image)[used])
    first, second = attenuation.halves(image)
    power = waves.power(seen) - waves.power(seen, first + second) + waves.power(first, second)
    return np.clip(power / np.maximum(waves.power(image), np.finfo(np.float64).tiny), *TRANSFER)


def continued(frequencies: FloatArray, spectrum: FloatArray, determined: BoolArray) -> FloatArray:
    """Return a spectrum, (bins,), whose bins that are not determined follow the power law of those next to them.

    The power law falls or is flat; without any determined bin the spectrum is 0.
    """
    index = np.flatnonzero(determined)[-FITTED:]
    if not index.size:
        return np.zeros_like(spectrum)
    logarithms = np.log(frequencies[index]), np.log(spectrum[index])
    slope = min(float(np.polyfit(*logarithms, 1)[0]), 0.0) if index.size > 1 else 0.0
    middle = float(np.mean(logarithms[1]) - slope * np.mean(logarithms[0]))
    return np.where(determined, spectrum, np.exp(middle + slope * np.log(frequencies)))


@dataclass(frozen=True)
class Waves:
    """The waves of the DCT-II of an image of `shape`, in bins of frequency; the mean is in none."""

    shape: tuple[int, int]

    @cached_property
    def _frequency(self) -> FloatArray:
        rows, columns = (np.arange(count) / count for count in self.shape)
        return np.hypot(rows[:, None], columns)

    @cached_property
    def _bins(self) -> IntArray:
        """Index of the bin of each wave, (rows, columns); the mean has -1."""
        ordered = np.sort(self._frequency.ravel())[1:]
        if not ordered.size:
            return np.full(self.shape, -1)
        edges, last = [0.0], 0
        for edge in np.geomspace(ordered[0], ordered[-1], BINS + 1)[1:-1]:
            place = int(np.searchsorted(ordered, edge))
            if place - last >= FEWEST_WAVES and ordered.size - place >= FEWEST_WAVES:
                edges.append(float(edge))
                last = place
        bins = np.searchsorted(edges, self._frequency, side="right") - 1
        bins[0, 0] = -1
        return bins

    @cached_property
    def counts(self) -> FloatArray:
        """Number of waves in each bin, (bins,)."""
        return np.bincount(self._bins.ravel() + 1)[1:].astype(np.float64)

    @cached_property
    def frequencies(self) -> FloatArray:
        """Mean frequency of each bin, (bins,)."""
        return np.bincount(self._bins.ravel() + 1, weights=self._frequency.ravel())[1:] / self.counts

    def power(self, image: FloatArray, other: FloatArray | None = None) -> FloatArray:
        """Return the mean power of a wave in each bin, (bins,), or the cross power of two images, (N,)."""
        waves = self._transform(image)
        product = waves * (waves if other is None else self._transform(other))
        return np.bincount(self._bins.ravel() + 1, weights=product.ravel())[1:] / self.counts

    def draw(self, spectrum: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw an image with mean 0 and a spectrum, (bins,): (N,)."""
        return self.scaled(rng.normal(size=self.shape).ravel(), np.sqrt(spectrum), mean=0.0)

    def scaled(self, image: FloatArray, factors: FloatArray, mean: float = 1.0) -> FloatArray:
        """Return an image with every wave multiplied by the factor of its frequency, and its mean by `mean`."""
        scale = np.zeros(self.shape)
        positive = factors > 0
        if positive.any():
            known = np.log(self.frequencies[positive]), np.log(factors[positive])
            scale = np.exp(np.interp(np.log(np.maximum(self._frequency, 1e-300)), *known))
        scale[0, 0] = mean
        return np.asarray(fft.idctn(scale * self._transform(image), 2, norm="ortho")).ravel()

    def _transform(self, image: FloatArray) -> FloatArray:
        return np.asarray(fft.dctn(image.reshape(self.shape), 2, norm="ortho"))
