"""The prior that a stack's measurements support, and the noise if asked for: the mean over their posterior.

The spectrum of a picture is taken for that of natural ones (Field 1987), with three unknown numbers,

    s(w) = c (1 / l^2 + |w|^2)^(-a/2),

the exponent a from 0, independent pixels as in Wood et al., to 4, smooth shadings. The measurements of a window have,
with an unknown level of deviation L, the density

    g - H f0 ~ N(0, C),   C = H P(c, l, a) H^T + L^2 H 1 1^T H^T + t Rv,

t = 1 where the noise is known; Rv holds, too, what wide point spreads see beside the window, by one rank. The variance
of a pixel, c, has before the stack the density that windows of natural pictures have. H P H^T, diagonalised once for
each l and a, gives the evidence for every c and t; the windows count as independent (Stein, Chi and Welty 2004). All of
them may lie in flat parts, bright and dark ones. Where the noise is known, and means over parts of the image vary by
far more than the fitted spectrum allows, these are measurements beside those of the windows.

Few measurements and much noise leave the numbers open, above all how much the image holds at frequencies that no lens
sees. So the prior is the mean of these spectra, weighted by their evidence: its covariance is that of images whose
numbers are drawn from the posterior, and Eq. 5 holds on average over them. The exponents and lengths lie on a grid; c,
and t where the noise is fitted, on one that is refined where the evidence is.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from math import ceil, exp, log
from typing import NamedTuple

import numpy as np
from scipy import fft, linalg

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.tables.estimation import PriorTable

from .coarse_model import CoarseModel
from .methods.method import EstimationTask
from .prior import FittedPrior, SpectralTerm, averaged_spectrum, natural_spectrum, spectrum_of

LENGTHS = (1.5, 4.0, 10.0, 25.0)  # pixels of f
EXPONENTS = (1.0, 2.0, 3.0, 4.0)  # and 0, which has no length
WINDOW = 16  # pixels of f, side of a window
WHOLE = 22  # pixels of f, side of the largest image that is one window, and
WHOLE_WIDE = 32  # of one in front of wide footprints
WIDEST = 24  # pixels of f, side of the widest window of larger ones
NATURAL_EXPONENT, NATURAL_LENGTH = 2.0, 10.0  # of a picture that is not known; pixels of f
SMOOTH, ROUGH = 10.0, 74.0  # grey levels, deviations of a window's pixels outside of which they are rarer
PER_AXIS = 3  # windows along an axis
MOST = 400  # measurements of a window of more pixels
LEAST = 10  # measurements, for three numbers
COARSE, FINE = 1.0, 40  # step of logarithms at first, number of steps after each refinement
REACH = 18.0  # logarithms from the mean square to either end
BEYOND = 12.0  # units of log evidence below the largest, where the grid ends
SEEN = 7.0  # units of log evidence by which an image must be more likely than none
ROUNDING = 1 / 12  # variance of the noise of a picture's pixel, in squared grey levels
PARTS, FEWEST_PARTS = 16, 4  # along an axis, of whose means the image at large is judged
SAMPLES = 4  # along a side of such a part
MOST_EXCESS = 20.0  # mean square of their waves relative to the fitted prior's; 7 of natural pictures, 200 of a horizon
KEPT = 1e-3  # share of the variance, from which a term is kept
REFINEMENTS = 2
LEAST_NOISE = 1e-6  # of the known noise, that is fitted in addition to it
ROUNDS, CONVERGED = 5, 0.02  # of the distribution of noise of which a part is known; its last relative change
UNIFORM = 1e3  # of the largest known noise, beside which it is nearly uniform


@dataclass(frozen=True)
class PriorFit:
    """The fitted prior and noise variance, None for what was known.

    numbers : of a picture's spectrum, and the noise: the mean of each logarithm and its standard deviation, by name;
        variance of a pixel in a window, correlation length in pixels of f, exponent, noise variance
    measurements : number used; if they are few, or equal the prior's mean, there is no fit and pixels are independent
    doubtful : True if a number lies at the end of its range, or if noise that is fitted explains the measurements alone
    flat : True if noise that is known explains the measurements alone
    """

    prior: FittedPrior | None
    noise_variance: float | None
    numbers: dict[str, tuple[float, float]]
    measurements: int
    doubtful: bool = False
    flat: bool = False


class NaturalSpectrum(NamedTuple):
    """A spectrum on a window's grid, (rows, columns) of mean 1 unless it is known, its numbers, and a weight."""

    values: FloatArray
    term: SpectralTerm
    weight: int


class Evidence(NamedTuple):
    """What the evidence of a window depends on.

    values : (k,) eigenvalues of H K H^T, whitened;  residual, light : (k,) g - H f0 and L H 1 along its eigenvectors
    beside : of what no image of the window reaches: squares of both, their product, and the number of measurements
    """

    values: FloatArray
    residual: FloatArray
    light: FloatArray
    beside: tuple[float, float, float, int]

    def log(self, scales: FloatArray, noises: FloatArray) -> FloatArray:
        """Return the log evidence, without constants, of multiples of K and of the noise: (scales, noises)."""
        total = scales[:, None, None] * self.values + noises[:, None]
        squares, lights, products, count = self.beside
        residual = np.sum(self.residual**2 / total, axis=2) + squares / noises
        light = 1 + np.sum(self.light**2 / total, axis=2) + lights / noises
        mixed = np.sum(self.residual * self.light / total, axis=2) + products / noises
        determinant = np.log(total).sum(axis=2) + count * np.log(noises) + np.log(light)
        return -0.5 * (determinant + residual - mixed**2 / light)


@dataclass(frozen=True)
class Window:
    """Whitened measurements of a window, turned so that no more are left than the window has pixels.

    waves : (k, rows, columns) H C^T on the grid of the unknowns;  residual, light, beside : as of `Evidence`
    """

    waves: FloatArray
    residual: FloatArray
    light: FloatArray
    beside: tuple[float, float, float, int]

    @classmethod
    def of(cls, matrix: FloatArray, shape: tuple[int, int], residual: FloatArray, light: FloatArray) -> Window:
        """Turn measurements; matrix : (m, pixels), residual and light : (m,)."""
        waves = np.asarray(fft.dctn(matrix.reshape(-1, *shape), 2, axes=(1, 2), norm="ortho"), dtype=np.float64)
        count = matrix.shape[0] - matrix.shape[1]
        if count <= 0:
            return cls(waves, residual, light, (0.0, 0.0, 0.0, 0))
        turn, kept = linalg.qr(waves.reshape(matrix.shape), mode="economic", check_finite=False)
        turned = turn.T @ residual, turn.T @ light
        left = residual - turn @ turned[0], light - turn @ turned[1]
        beside = float(left[0] @ left[0]), float(left[1] @ left[1]), float(left[0] @ left[1]), count
        return cls(np.asarray(kept, dtype=np.float64).reshape(-1, *shape), *turned, beside)

    def evidence(self, spectrum: NaturalSpectrum) -> Evidence:
        """Return the evidence of images with a spectrum."""
        flat = self.waves.reshape(len(self.waves), -1)
        covariance = (flat * spectrum.values.ravel()) @ flat.T
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)  # of NumPy, which lets other threads run
        return Evidence(np.maximum(values, 0.0), vectors.T @ self.residual, vectors.T @ self.light, self.beside)


@dataclass(frozen=True)
class Place:
    """A window, in pixels of the unknowns, and the measurements that count for it.

    numbers : (m,);  light, residual : (m,) H 1 and g - H f0
    """

    rows: slice
    columns: slice
    numbers: IntArray
    light: FloatArray
    residual: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def window(self, task: EstimationTask, noise: FloatArray) -> Window:
        """Return the measurements, whitened for `noise`, (measurements used,), and for what they see beside the window.

        That is an average over many pixels, about the same for all of them, by as much as they lose of the light.
        """
        fine = _unknowns(task)
        matrix = np.asarray(fine.windowed.rows_on(self.numbers, self.rows, self.columns).toarray())
        deviation = np.sqrt(noise[task.among_used(self.numbers)])
        beside = (self.light - matrix.sum(axis=1)) * float(np.mean(self.residual**2)) ** 0.5 / deviation
        square = float(beside @ beside)
        share = (1 - (1 + square) ** -0.5) / square if square else 0.0

        def white(values: FloatArray) -> FloatArray:
            scaled = (values.T / deviation).T
            return scaled - share * np.multiply.outer(beside, beside @ scaled)

        level = task.prior.level_deviation * self.light
        return Window.of(white(matrix), self.shape, white(self.residual), white(level))


@dataclass(frozen=True)
class _Picture:
    """A window of a picture, (rows, columns) less the prior's mean, with the noise of its rounding."""

    image: FloatArray
    level: float
    noise: float = ROUNDING

    def evidence(self, spectrum: NaturalSpectrum) -> Evidence:
        """Return the evidence of a spectrum: the waves of the picture are independent."""
        return self._evidence(spectrum.values)

    def _evidence(self, spectrum: FloatArray) -> Evidence:
        """Return the evidence of a spectrum on the grid of the picture, (rows, columns)."""
        light = np.zeros(self.image.size)
        light[0] = self.level * light.size**0.5
        parts = self.waves.ravel() / self.noise**0.5, light / self.noise**0.5
        return Evidence(spectrum.ravel() / self.noise, *parts, (0, 0, 0, 0))

    @property
    def waves(self) -> FloatArray:
        """The picture by its cosine waves."""
        return np.asarray(fft.dctn(self.image, 2, norm="ortho"), dtype=np.float64)


@dataclass(frozen=True)
class _PartMeans(_Picture):
    """Means over parts of f, (rows, columns) less the prior's mean; their noise is small beside their differences.

    side : pixels of the unknowns along a side of a part;  pitch : of these pixels
    """

    side: int = 1
    pitch: float = 1.0

    @classmethod
    def of(cls, task: EstimationTask) -> _PartMeans | None:
        """Return that of a task, from readings spread over the pixels that they see; None of an image of few parts."""
        fine, detail = _unknowns(task), _detail(task)
        widest = max(each.ratio for each in fine.camera.types)  # what a reading sees but for the tails of a blur
        side = detail * max(min(task.shape) // PARTS, ceil(widest / detail))
        shape = fine.camera.rows // side, fine.camera.columns // side
        if min(shape) < FEWEST_PARTS:
            return None
        weights = task.on_all_measurements(1 / task.expected_noise, 0.0)
        light = fine.forward(np.ones(fine.unknowns))
        recorded = np.where(task.used, task.recorded, 0.0) - task.prior.mean * light
        seen, sums = (
            means_over(fine.adjoint(weights * each).reshape(fine.camera.shape), side) for each in (light, recorded)
        )
        if not (seen > 0).all():
            return None
        image, noise = sums / seen, max(float(np.mean(1 / seen)) / side**2, ROUNDING)
        return cls(image, task.prior.level_deviation, noise, side, task.model.camera.target_pitch / detail)

    def evidence(self, spectrum: NaturalSpectrum) -> Evidence:
        """Return the evidence of a spectrum, whose means over parts are independent waves."""
        return self._evidence(self.spectrum_of([spectrum.term]))

    def spectrum_of(self, terms: Sequence[SpectralTerm]) -> FloatArray:
        """Return the spectrum of means over parts, (rows, columns), of a few samples each: finer waves hardly count."""
        count = min(self.side, SAMPLES)
        shape = self.image.shape[0] * count, self.image.shape[1] * count
        every = [natural_spectrum(shape, self.pitch * self.side / count, term) for term in terms]
        return averaged_spectrum(np.sum(every, axis=0), count)

    def excess(self, prior: FittedPrior) -> float:
        """Return by how much the means vary more than images of a prior, in mean squares of waves; 1 is expected."""
        squares = np.square(self.waves) / (self.spectrum_of(prior.terms) + self.noise)
        return float(squares.ravel()[1:].mean())


def means_over(image: FloatArray, side: int) -> FloatArray:
    """Return means over side x side pixels, without what is left at the far ends: (rows, columns)."""
    rows, columns = (size - size % side for size in image.shape)
    return averaged(image[:rows, :columns], side)


def _unknowns(task: EstimationTask) -> Model:
    """Return the model of the pixels that have the prior, of f or of a finer world."""
    return task.model.fine if isinstance(task.model, CoarseModel) else task.model


def places_of(task: EstimationTask) -> list[Place]:
    """Return the windows whose measurements count: the whole of a small image, else up to nine over it."""
    fine, detail = _unknowns(task), _detail(task)
    side = max(WINDOW, 2 * -(-fine.windowed.reach // detail))
    light = fine.forward(np.ones(fine.unknowns))
    residual = task.recorded - task.prior.mean * light
    found: list[Place] = []
    for rows, columns in product(*(_spread(size, side, detail) for size in task.shape)):
        numbers = _numbers(task, fine, rows, columns)
        found.append(Place(rows, columns, numbers, light[numbers], residual[numbers]))
    return found


def _spread(size: int, side: int, detail: int) -> list[slice]:
    """Return windows of one axis in the middle of equal parts of it, in pixels of the unknowns; one of a short axis."""
    if size <= max(WHOLE, min(side, WHOLE_WIDE)):
        return [slice(0, size * detail)]
    side = min(side, WIDEST)
    count = min(size // side, PER_AXIS)
    starts = [int((number + 0.5) * size / count - side / 2) for number in range(count)]
    return [slice(start * detail, (start + side) * detail) for start in starts]


def _numbers(task: EstimationTask, fine: Model, rows: slice, columns: slice) -> IntArray:
    """Return the used measurements inside a window; if they are few, those of its middle that see more than it."""
    inside = fine.windowed.measurements_inside(rows, columns)
    found = inside[task.used[inside]]
    if found.size < LEAST:
        middles = zip(fine.camera.middles, (rows, columns), strict=True)
        near = [abs(middle - (part.start + part.stop) / 2) < (part.stop - part.start) / 4 for middle, part in middles]
        found = max(found, np.flatnonzero(near[0] & near[1] & task.used), key=len)
    pixels = (rows.stop - rows.start) * (columns.stop - columns.start)
    if found.size <= MOST or found.size > pixels:
        return found
    return found[np.linspace(0, found.size - 1, MOST).astype(int)]


def _detail(task: EstimationTask) -> int:
    """Return how many times finer than f the unknowns are."""
    return _unknowns(task).camera.rows // task.shape[0]


def _spectra(shape: tuple[int, int], pitch: float, detail: int) -> list[NaturalSpectrum]:
    """Return the spectra of natural pictures on a window's grid of this shape; pitch : of f."""
    found: list[NaturalSpectrum] = []
    for exponent, length in _grid():
        term = SpectralTerm(1.0, exponent, length * pitch)
        values = natural_spectrum(shape, pitch / detail, term)
        term = term._replace(density=float(1 / values.mean()))
        found.append(NaturalSpectrum(values / values.mean(), term, 1 if exponent else len(LENGTHS)))
    return found


def _grid() -> list[tuple[float, float]]:
    """Return exponents and lengths in pixels of f."""
    return [(0.0, LENGTHS[0]), *product(EXPONENTS, LENGTHS)]


def _known(task: EstimationTask, shape: tuple[int, int]) -> NaturalSpectrum:
    """Return the prior of the task on a window's grid of this shape."""
    of_grid = task.model.camera.target_pitch / _detail(task)
    values = np.broadcast_to(np.asarray(spectrum_of(task.prior, shape, of_grid)), shape)
    return NaturalSpectrum(values, SpectralTerm(1.0, 0.0, of_grid), 1)


class ScalePosterior(NamedTuple):
    """The posterior of the logarithms of the multiples of K and of the noise.

    mass, best : logarithms of the evidence, integrated and largest;  at_end : True if that is at the end of the range
    means : of both multiples;  moments : of both logarithms, the means of themselves and of their squares
    """

    mass: float
    best: float
    at_end: bool
    means: tuple[float, float]
    moments: FloatArray

    @classmethod
    def of(
        cls, evidence: list[Evidence], ranges: tuple[FloatArray, FloatArray], *, prior_known: bool
    ) -> ScalePosterior:
        """Integrate over grids of the logarithms, which are refined where the evidence is."""

        def scores() -> FloatArray:
            scales, noises = np.exp(grids[0]), np.exp(grids[1])
            before = np.zeros(scales.size) if prior_known else _contrasts(scales)
            return np.sum([part.log(scales, noises) for part in evidence], axis=0) + before[:, None]

        grids, found, at_end = list(ranges), np.zeros((1, 1)), False
        for number in range(REFINEMENTS + 1):
            found = scores()
            if not number:
                place = np.unravel_index(int(np.argmax(found)), found.shape)
                at_end = any(grid.size > 1 and at in (0, grid.size - 1) for at, grid in zip(place, grids, strict=True))
            if number < REFINEMENTS:
                near = found > found.max() - BEYOND
                grids = [_refined(grid, near.any(axis=1 - axis)) for axis, grid in enumerate(grids)]
        weights = np.exp(found - found.max())
        cell = float(np.prod([grid[1] - grid[0] for grid in grids if grid.size > 1]))
        shares = [weights.sum(axis=1 - axis) / weights.sum() for axis in range(2)]
        means = [float(share @ np.exp(grid)) for share, grid in zip(shares, grids, strict=True)]
        moments = [[share @ grid, share @ grid**2] for share, grid in zip(shares, grids, strict=True)]
        best = float(found.max())
        return cls(best + log(weights.sum() * cell), best, at_end, (means[0], means[1]), np.array(moments))


def _contrasts(variances: FloatArray) -> FloatArray:
    """Return the log density of a window's log variance in natural pictures."""
    return -np.log1p(SMOOTH / np.sqrt(variances)) - 2 * np.log1p(variances / ROUGH**2)


def _refined(grid: FloatArray, near: BoolArray) -> FloatArray:
    """Return a finer grid of the part that is near the largest evidence."""
    if grid.size == 1:
        return grid
    places = np.flatnonzero(near)
    ends = max(places[0] - 1, 0), min(places[-1] + 1, grid.size - 1)
    return np.linspace(grid[ends[0]], grid[ends[1]], FINE)


def fit_prior(task: EstimationTask, *, prior_known: bool = False, noise_known: bool = True) -> PriorFit:
    """Fit what is not known of a task's prior and noise; its expected noise is all of the noise, or the known part.

    Raises InputError where measurements have no noise that is known, and where they are too few to fit the noise, or
    the prior of a world finer than f.
    """
    if noise_known and not (task.expected_noise > 0).all():
        raise InputError(
            "a prior cannot be fitted to measurements without noise; set estimator.noise_variance to 'fit' or to a"
            " number above 0"
        )
    places = places_of(task)
    count = sum(place.numbers.size for place in places)
    little = count < LEAST or not any(place.residual.any() for place in places)
    if little and noise_known and _detail(task) == 1:
        return PriorFit(None, None, {}, count)
    if little:
        raise InputError(
            f"a fit takes {LEAST} measurements or more that differ from those of the prior's mean, got {count};"
            " give prior.kind and estimator.noise_variance"
        )
    if noise_known:
        overview = None if prior_known or len(places) == 1 else _PartMeans.of(task)
        return _Measured.of(task, places, task.expected_noise, prior_known=prior_known).fit_beside(overview)
    # A multiple of the whole noise is fitted, whose distribution over the measurements is uniform at first.
    known = task.expected_noise

    def fitted(unknown: float) -> PriorFit:
        return _Measured.of(task, places, known + unknown, prior_known=prior_known).fit(noise_known=False)

    fit = fitted(UNIFORM * float(known.max()) or 1.0)
    for _ in range(ROUNDS if np.ptp(known) else 0):
        before = fit.noise_variance or LEAST_NOISE * float(known.mean())
        fit = fitted(before)
        if abs((fit.noise_variance or 0.0) - before) < CONVERGED * before:
            break
    return fit


def fit_picture(picture: FloatArray, detail: int, pitch: float, table: PriorTable) -> FittedPrior | None:
    """Return the prior that a picture itself supports, None of a picture that equals the prior's mean everywhere.

    picture : (rows, columns) of the world, so many times finer than f;  pitch : of f;  table : its mean and its level
    """
    rows, columns = (_spread(size // detail, WINDOW, detail) for size in picture.shape)
    windows = [
        _Picture(picture[down, across] - table.mean, table.level_deviation) for down, across in product(rows, columns)
    ]
    if not any(window.image.any() for window in windows):
        return None
    spectra, side = (
        _spectra(windows[0].image.shape, pitch, detail),
        detail * max(min(picture.shape) // detail // PARTS, 1),
    )
    known, overview = np.full(1, ROUNDING), None
    if len(windows) > 1 and min(picture.shape) >= FEWEST_PARTS * side:
        means = means_over(picture, side) - table.mean
        overview = _PartMeans(means, table.level_deviation, ROUNDING, side, pitch / detail)
    measured = _Measured(table, known, known, picture.size, spectra, _evidence(windows, spectra), prior_known=False)
    return measured.fit_beside(overview).prior


def natural_prior(table: PriorTable, pitch: float) -> FittedPrior:
    """Return a prior of natural pictures with the variance, mean and level of a [prior] table; pitch : of f."""
    shape = (WINDOW, WINDOW)
    one = SpectralTerm(1.0, NATURAL_EXPONENT, NATURAL_LENGTH * pitch)
    density = table.variance / float(natural_spectrum(shape, pitch, one).mean())
    return FittedPrior.of(table, (one._replace(density=density),), table.variance)


@dataclass(frozen=True)
class _Measured:
    """What windows of a task, or of a picture, say of each spectrum.

    table : its mean and its level;  known : (measurements used,) noise, or the part of it that is known
    noise : (measurements used,), of which a multiple is fitted where it is not known
    spectra, evidence : for each of them the evidence of all windows;  prior_known : True for the task's own spectrum
    """

    table: PriorTable
    known: FloatArray
    noise: FloatArray
    measurements: int
    spectra: list[NaturalSpectrum]
    evidence: list[list[Evidence]]
    prior_known: bool

    @classmethod
    def of(cls, task: EstimationTask, places: list[Place], noise: FloatArray, *, prior_known: bool) -> _Measured:
        """Take the measurements of places."""
        windows = [place.window(task, noise) for place in places if place.numbers.size]
        shape, pitch = places[0].shape, task.model.camera.target_pitch
        spectra = [_known(task, shape)] if prior_known else _spectra(shape, pitch, _detail(task))
        count = sum(place.numbers.size for place in places)
        known = task.expected_noise
        return cls(task.prior, known, noise, count, spectra, _evidence(windows, spectra), prior_known)

    def fit_beside(self, means: _PartMeans | None) -> PriorFit:
        """Return the fit for known noise; means over parts of the image count where they vary by far more."""
        fit = self.fit(noise_known=True)
        if means is None or fit.prior is None or means.excess(fit.prior) <= MOST_EXCESS:
            return fit
        pairs = zip(self.evidence, self.spectra, strict=True)
        evidence = [[*each, means.evidence(spectrum)] for each, spectrum in pairs]
        return replace(self, evidence=evidence).fit(noise_known=True)

    def fit(self, *, noise_known: bool) -> PriorFit:
        """Return the fit of the prior, and of a multiple of the noise."""
        posteriors, shares, at_end, flat = _posteriors(
            self.evidence, self.spectra, prior_known=self.prior_known, noise_known=noise_known
        )
        multiple = float(shares @ [each.means[1] for each in posteriors])
        # Known noise and a variance n have multiples of the whole whose mean is 1 + (n - the last n) mean(1 / noise).
        last = float(self.noise[0] - self.known[0])
        noise_variance = last + (multiple - 1) / float(np.mean(1 / self.noise))
        numbers = {} if self.prior_known else _numbers_of(self.spectra, posteriors, shares)
        if not noise_known:
            numbers["noise_variance"] = noise_variance, _moments(shares, [each.moments[1] for each in posteriors])[1]
        return PriorFit(
            prior=None if self.prior_known else _mean_prior(self.table, self.spectra, posteriors, shares),
            noise_variance=None if noise_known else max(noise_variance, 0.0),
            numbers=numbers,
            measurements=self.measurements,
            doubtful=at_end and not flat if noise_known else at_end or flat or noise_variance < 0,
            flat=noise_known and flat,
        )


def _evidence(windows: Sequence[Window | _Picture], spectra: list[NaturalSpectrum]) -> list[list[Evidence]]:
    """Return for every spectrum the evidence of all windows."""

    def evidence(spectrum: NaturalSpectrum) -> list[Evidence]:
        return [window.evidence(spectrum) for window in windows]

    with one_thread(), ThreadPoolExecutor(processors()) as threads:
        return list(threads.map(evidence, spectra))


def _posteriors(
    every: list[list[Evidence]], spectra: list[NaturalSpectrum], *, prior_known: bool, noise_known: bool
) -> tuple[list[ScalePosterior], FloatArray, bool, bool]:
    """Return the posterior for every spectrum, and its share of the evidence.

    Then whether a number lies at the end of its range, and whether noise alone explains the measurements.
    """
    fixed, square = np.zeros(1), float(np.mean(np.concatenate([part.residual for part in every[0]]) ** 2))
    noises = fixed if noise_known else log(square) + np.arange(-2 * REACH, 3 * COARSE, COARSE)
    nothing = float(np.sum([part.log(fixed, np.exp(noises)) for part in every[0]], axis=0).max())
    posteriors: list[ScalePosterior] = []
    for evidence in every:
        seen = float(np.mean(np.concatenate([part.values for part in evidence])))
        scales = fixed if prior_known else log(square / seen) + np.arange(-REACH, REACH, COARSE)
        posteriors.append(ScalePosterior.of(evidence, (scales, noises), prior_known=prior_known))
    masses = [log(spectrum.weight) + each.mass for spectrum, each in zip(spectra, posteriors, strict=True)]
    shares = np.exp(np.array(masses) - max(masses))
    best = posteriors[int(np.argmax(shares))]
    return posteriors, shares / shares.sum(), best.at_end, not prior_known and best.best - nothing < SEEN


def _mean_prior(
    table: PriorTable, spectra: list[NaturalSpectrum], posteriors: list[ScalePosterior], shares: FloatArray
) -> FittedPrior:
    """Return the prior whose spectrum is the mean of all, without those that hardly add to it."""
    variances = shares * [each.means[0] for each in posteriors]
    total = float(variances.sum())
    terms = tuple(
        spectrum.term._replace(density=float(variance) * spectrum.term.density)
        for spectrum, variance in zip(spectra, variances, strict=True)
        if variance > KEPT * total
    )
    return FittedPrior.of(table, terms, total)


def _numbers_of(
    spectra: list[NaturalSpectrum], posteriors: list[ScalePosterior], shares: FloatArray
) -> dict[str, tuple[float, float]]:
    """Return variance, exponent, and the correlation length of spectra that have one, with relative deviations.

    Spectra that hardly add to them are left out.
    """
    shares = np.where(shares > KEPT, shares, 0.0)
    shares = shares / shares.sum()
    variance, by_variance = _moments(shares, [each.moments[0] for each in posteriors])
    exponents = np.array([spectrum.term.exponent for spectrum in spectra])
    exponent = float(shares @ exponents)
    numbers = {
        "variance": (exp(variance), by_variance),
        "exponent": (exponent, float(shares @ (exponents - exponent) ** 2) ** 0.5 / exponent if exponent else 0.0),
    }
    if shares[exponents > 0].any():
        long = shares * (exponents > 0) / shares[exponents > 0].sum()
        logs = np.log([length for _, length in _grid()])
        length, by_length = _moments(long, [(each, each**2) for each in logs])
        numbers["correlation_length"] = exp(length), by_length
    return numbers


def _moments(shares: FloatArray, moments: Sequence[Sequence[float] | FloatArray]) -> tuple[float, float]:
    """Return mean and standard deviation of a mixture; moments : means of its parts, and of their squares."""
    mean, square = shares @ np.array(moments)
    return float(mean), float(max(square - mean**2, 0.0)) ** 0.5
