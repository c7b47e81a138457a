"""Contrast of the true image from a noisy estimate, on which the effect of the errors of H depends.

An estimate shows the contrast of the image and that of its own noise, and loses some of the finest. Its power spectrum
is F = T S + N, with S that of the image, T the power transfer of the estimator, which a similar image shows, and N
that of the noise, which random noise shows. The estimate is filtered so that its spectrum becomes S: each wave keeps
its place in the image and gets the power that is due. Where noise hides S, a power law continues it, as spectra of
images follow one (Field 1987, J. Opt. Soc. Am. A 4, 2379).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, ndimage

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.model import Model

from ..methods.method import EstimationTask, Method, PosteriorOperators, total_variance
from .attenuation import FIRST_ORDER, Attenuation

BINS = 12  # of frequency
FEWEST_WAVES = 8  # in a bin
SIGNAL = 0.5  # excess over the noise, relative, from which a bin is determined
FAINT = 1e-12  # power relative to the largest, below which a bin is empty
FITTED = 5  # bins at the end of the determined range that fix the power law
TRANSFER = (0.25, 1.2)  # range of T: beyond it, it is chance, or waves that no lens type shows
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of two placements of the uncertainty of H
LEAST = 0.05  # of the residual's share of the noise
NEIGHBOURHOOD = 11  # pixels, over which the power of a band is averaged
MANY = 100_000  # pixels above which one noise image is enough
FEW = 10_000  # pixels below which four are taken


@dataclass(frozen=True)
class Contrast:
    """An image, (N,), with the contrast of the true one, and noise images as the estimate's, (N,) each.

    attenuation : of the estimate by errors of H's entries, None where these were left out
    """

    image: FloatArray
    noise: tuple[FloatArray, ...]
    attenuation: Attenuation | None

    def calibration(self, method: Method, by_cause: dict[str, FloatArray]) -> FloatArray:
        """Return the variance, (measurements used,), that the uncertainty of H adds for the true image.

        by_cause : (measurements used,) noise variances, with those that the uncertainty of H adds as "calibration"
        """
        task = method.task
        first, second = (values[task.used] for values in _placements(task.model, method.image, self.image, self.noise))
        share = 0.5
        if task.model.camera.detail == 1 and self.attenuation is not None:  # else the residual shows detail, too
            rest = np.maximum(total_variance(by_cause) - by_cause["calibration"], 0.0)
            squares = _residual(method) / np.maximum(self.attenuation.residual_share, LEAST)
            share = likeliest_share(squares, rest, first, second)
        return (1 - share) * first + share * second


def true_contrast(method: Method, operators: PosteriorOperators, actual: FloatArray, *, attenuated: bool) -> Contrast:
    """Return the contrast of the image that a method has estimated.

    actual : (measurements used,) noise variances;  attenuated : True if entries of H have errors of their own
    """
    task, waves = method.task, Waves(method.task.shape)
    rng, root = probe(Purpose.CONTRAST), np.sqrt(actual)
    whites = _white_noise(task, rng)
    noise = tuple(operators.gain(root * white) for white in whites)
    deviation = method.image - task.prior.mean
    excess, determined = _excess(waves, deviation, noise)
    attenuation = Attenuation.of(method, operators, whites, noise, root) if attenuated else None
    if attenuation is None or attenuation.strength(noise[0]) <= FIRST_ORDER:
        first = _placed(waves, deviation, noise, continued(waves.frequencies, excess, determined))
        excess = excess / _transfer(waves, first, operators, attenuation)
    spectrum = continued(waves.frequencies, excess, determined)
    return Contrast(task.prior.mean + _placed(waves, deviation, noise, spectrum), noise, attenuation)


def _white_noise(task: EstimationTask, rng: np.random.Generator) -> list[FloatArray]:
    """Draw normal numbers, (measurements used,) each, for as many noise images as the size of the image needs."""
    count = 1 if task.model.unknowns > MANY else 2 if task.model.unknowns > FEW else 4
    return [rng.normal(size=task.expected_noise.size) for _ in range(count)]


def _excess(waves: Waves, deviation: FloatArray, noise: tuple[FloatArray, ...]) -> tuple[FloatArray, BoolArray]:
    """Return the power of an estimate beyond that of its noise, (bins,), and the bins in which it is determined."""
    by_noise = np.mean([waves.power(image) for image in noise], axis=0)
    excess = waves.power(deviation) - by_noise
    return excess, excess > by_noise * np.maximum(SIGNAL, 4 / np.sqrt(waves.counts))


def _placements(
    model: Model, estimate: FloatArray, image: FloatArray, noise: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the variance that H's uncertainty adds, (M,), placed as by the estimate and as by the image.

    Either has the sum of the image's. The estimate shows more where its noise is small, the image where it is large.
    """
    placed, whole = model.variance_from_model(estimate, noise), model.variance_from_model(image)
    total = float(placed.sum())
    return placed * (float(whole.sum()) / total) if total > 0 else whole, whole


def _residual(method: Method) -> FloatArray:
    """Return the squares of g - H f^, (measurements used,)."""
    task = method.task
    return np.square(task.recorded[task.used] - task.observe(method.image))


def likeliest_share(squares: FloatArray, rest: FloatArray, first: FloatArray, second: FloatArray) -> float:
    """Return the share of `second` in a mean with `first` by which normal errors of these squares are likeliest.

    rest : variance of the errors without either
    """

    def unlikelihood(share: float) -> float:
        variance = rest + (1 - share) * first + share * second
        known = variance > 0
        return float(np.sum(np.log(variance[known]) + squares[known] / variance[known]))

    return min(SHARES, key=unlikelihood)


def _placed(waves: Waves, deviation: FloatArray, noise: tuple[FloatArray, ...], spectrum: FloatArray) -> FloatArray:
    """Return the estimate less its prior's mean with another spectrum, its power placed where it exceeds the noise.

    In each band of frequency the square of the estimate and that of the noise are averaged over a neighbourhood, whose
    share of power that is no noise scales the estimate there.
    """
    placed = np.full(deviation.size, deviation.mean())
    for band, (power, count) in enumerate(zip(spectrum, waves.counts, strict=True)):
        wave = waves.band(deviation, band)
        by_noise = sum((_local_mean(np.square(waves.band(image, band))) for image in noise), np.zeros(waves.shape))
        local = _local_mean(np.square(wave))
        excess = local - by_noise / len(noise)
        signal = np.divide(excess, local, out=np.zeros_like(local), where=excess > 0)
        wave = np.sqrt(signal) * wave
        placed += (wave * (power * count / (float(np.square(wave).sum()) or 1.0)) ** 0.5).ravel()
    return placed


def _local_mean(squares: FloatArray) -> FloatArray:
    return np.asarray(ndimage.uniform_filter(squares, NEIGHBOURHOOD, mode="reflect"))


def _transfer(
    waves: Waves, image: FloatArray, operators: PosteriorOperators, attenuation: Attenuation | None
) -> FloatArray:
    """Return the power transfer from an image to its estimate, with noisy H if it attenuates, by bin of frequency."""
    seen = image - operators.hidden(image)
    power, whole = waves.power(seen), waves.power(image)
    if attenuation is not None:
        first, second = attenuation.halves(image)
        power += waves.power(first, second) - waves.power(seen, first + second)
    seen_well = whole > FAINT * whole.max(initial=0.0)  # a target of one pixel has no waves
    return np.clip(np.divide(power, whole, out=np.ones_like(whole), where=seen_well), *TRANSFER)


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
        ordered: FloatArray = np.sort(self._frequency, axis=None)[1:]
        if not ordered.size:
            return np.full(self.shape, -1)
        edges, last = [0.0], 0
        ratio = float(ordered[-1] / ordered[0])
        for step in range(1, BINS):
            edge = float(ordered[0]) * ratio ** (step / BINS)
            place = int(np.count_nonzero(ordered < edge))
            if place - last >= FEWEST_WAVES and ordered.size - place >= FEWEST_WAVES:
                edges.append(edge)
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

    def band(self, image: FloatArray, number: int) -> FloatArray:
        """Return the waves of one bin of an image, (N,): (rows, columns)."""
        return np.asarray(fft.idctn(np.where(self._bins == number, self._transform(image), 0.0), 2, norm="ortho"))

    def _transform(self, image: FloatArray) -> FloatArray:
        return np.asarray(fft.dctn(image.reshape(self.shape), 2, norm="ortho"))
