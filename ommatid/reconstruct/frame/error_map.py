"""The expected error (Eq. 5) of every pixel of a frame, in the way that its camera and its noise allow, and checked.

Of few pixels the map is exact. If all lens types see the same everywhere, transfer functions and small frames give it
(`variance_map`); where that is rough, and for every other camera, windows side by side do. K that is factorised gives
it by one sweep.

The error of a map is measured at random pixels by exact solutions of the frame's own system. With x = C z, z random
signs at pixels k far from one another and 0 elsewhere, z_k x_k is C_kk: what the others add falls with the distance as
C does (Tang and Saad 2012). So one solution measures the variances of some hundred pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.observation import Entries

from ..methods.method import EstimationTask
from .conjugate_gradients import BandedFactor, FrameSystem, NotReachedError
from .reading_space import ReadingSpace
from .readings import leaves_null_space
from .swept import swept_maps
from .variance_map import EVEN_EDGES, VarianceMap, Way, frame_map, is_narrow, mean_ratios, ways_to_edges
from .windows import HALOS, Windows, by_windows, has_few_windows, of_mean_kernels, varies_over_field, windows_map

Pixels = NDArray[np.intp]

SPACING = 80  # rows or columns between two pixels of a set, at least
MOST = 200  # pixels of a set
TRIALS = 2000  # random pixels that are tried for it
EDGE = 4  # pixels: how near the edges the first of a set lie
SETS = 2  # of few pixels; one of many
EDGES = 4  # sets of frames so small that a set has a pixel or two
SINGLE = 6  # pixels where errors are correlated over any distance, and each needs a solution of its own
FEW_SINGLE = 2  # of many pixels
MANY = 250_000
NO_VARIANCE = 1.0  # error of a map with pixels whose variance is not a positive number
EXACT = 1e-3  # relative accuracy of a solution
MOST_EXACT = 45  # pixels of f along an axis of a frame whose map is exact
MOST_READINGS = 3600  # of such a frame where the world is finer
UNCHECKED = 2e-2  # error of the fastest map
SPREAD = 0.2  # of logarithms of the levels of noise, above which windows start with a longer halo, as behind blur
ROUGH = 2e-2  # error of a variance at random pixels above which another map is tried


@dataclass(frozen=True)
class MapCheck:
    """The difference of a map from exact variances at random pixels, relative: the largest, and that of the mean."""

    worst: float
    mean: float


@dataclass(frozen=True)
class ExactVariances:
    """Exact variances of some pixels of a frame.

    noise : (M,) Rvm / Rv^2, None where the actual noise Rvm is the expected one
    accuracy : that of solutions in posterior standard deviations, if EXACT is out of reach
    """

    system: FrameSystem
    noise: FloatArray | None
    accuracy: float
    task: EstimationTask

    def at(self, pixels: Pixels, posterior: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return Eq. 5 of pixels whose errors are not correlated, (n,); posterior : (N,) about the diagonal of C."""
        signs = np.zeros_like(posterior)
        signs[pixels] = rng.choice([-1.0, 1.0], size=pixels.size)
        finest = EXACT * float(np.sqrt(posterior[pixels].min()))
        solved = self._solve(self.task.of_unknowns(signs), finest)
        if self.noise is not None:
            readings = self.system.observation.forward(solved)
            if pixels.size == 1:  # the quadratic form is that of the pixel alone
                missing = float(solved @ self.system.apply_prior_precision(solved))
                return np.array([missing + float(self.noise @ np.square(readings))])
            readings *= self.noise
            right = self.system.observation.adjoint(readings) + self.system.apply_prior_precision(solved)
            smallest = float(np.min((signs * self.task.of_f(solved))[pixels]))
            solved = self._solve(right, min(finest, EXACT * max(smallest, 0.0) / float(posterior.max()) ** 0.5))
        return (signs * self.task.of_f(solved))[pixels]

    def _solve(self, right: FloatArray, accuracy: float) -> FloatArray:
        try:
            return self.system.solve(right, min(accuracy, self.accuracy)).image
        except NotReachedError:
            return self.system.solve(right, self.accuracy).image


def check_map(
    variance: FloatArray, posterior: FloatArray, shape: tuple[int, int], exact: ExactVariances, *, local: bool
) -> MapCheck:
    """Compare a map of Eq. 5, (N,), with exact solutions; posterior : (N,) the map of the diagonal of C.

    local : False where errors are correlated over any distance, so that pixels are taken one at a time
    """
    rng = probe(Purpose.ERROR_MAP)
    ratios: list[FloatArray] = []
    many, few = variance.size > MANY, max(shape) < 2 * SPACING  # so few that sets have a pixel or two
    for number in range((1 if many else EDGES if few else SETS) if local else (FEW_SINGLE if many else SINGLE)):
        pixels = spread_pixels(shape, rng, edges=local or bool(number % 2), first=number)
        if not local:
            pixels = pixels[:1]
        ratios.append(variance[pixels] / exact.at(pixels, posterior, rng) - 1)
    ratio = np.concatenate(ratios)
    worst = float(np.abs(ratio).max())
    if not (np.isfinite(variance) & (variance > 0)).all():
        worst = max(worst, NO_VARIANCE)
    if not local:
        return MapCheck(worst, worst)
    return MapCheck(worst, min(worst, abs(float(ratio.mean())) + 2 * float(ratio.std()) / ratio.size**0.5))


@dataclass(frozen=True)
class ErrorMap:
    """The maps of a frame, their error at random pixels, and the prior variance of f's pixels."""

    variances: VarianceMap
    check: MapCheck
    prior: FloatArray | float


def error_map(task: EstimationTask, system: FrameSystem, actual: FloatArray, *, quick: bool = False) -> ErrorMap:
    """Return the map of the estimator that `system` is.

    actual : (measurements used,) noise
    quick : True takes the fastest map, unchecked, though it is rough: that of a similar shift-invariant camera
    """
    prior = system.bands.prior_variance
    if isinstance(system.similar, ReadingSpace):
        maps = VarianceMap(*system.similar.moments.variances(task.expected_noise, actual, task.shape_of_f))
        rounding = system.similar.rounding(maps.posterior.ravel())
        return ErrorMap(maps, MapCheck(rounding, rounding), prior)
    if _is_small(task, actual.size):
        whole = Windows(task, actual, task.shape_of_f).map(task.model.applied, (0, 0))
        return ErrorMap(VarianceMap(*whole), MapCheck(0.0, 0.0), prior)
    if quick:
        return ErrorMap(_fastest_map(task, system, actual), MapCheck(UNCHECKED, UNCHECKED), prior)
    noise = None
    if not np.allclose(actual, task.expected_noise, rtol=1e-12):
        noise = system.weights**2 * task.on_all_measurements(actual, 0.0)
    exact = ExactVariances(system, noise, task.settings.accuracy, task)
    local = isinstance(system.prior, float) and not leaves_null_space(task.model.camera)
    found: list[ErrorMap] = []
    for maps in _maps(task, system, actual):
        check = check_map(maps.variance, maps.posterior.ravel(), task.shape_of_f, exact, local=local)
        found.append(ErrorMap(maps, check, prior))
        if check.worst <= ROUGH:
            break
    return min(found, key=lambda each: each.check.worst)


def _is_small(task: EstimationTask, readings: int) -> bool:
    few = task.finer == 1 or readings <= MOST_READINGS
    return few and max(task.shape_of_f) <= MOST_EXACT


def _fastest_map(task: EstimationTask, system: FrameSystem, actual: FloatArray) -> VarianceMap:
    if isinstance(system.similar, BandedFactor):
        return next(_maps(task, system, actual))
    return map_by_bands(task, system, actual, ways_to_edges(task, system.bands)[0], quick=True)


def map_by_bands(
    task: EstimationTask, system: FrameSystem, actual: FloatArray, way: Way, *, quick: bool = False
) -> VarianceMap:
    """Return the map of the shift-invariant camera like that of a system; arguments as of `frame_map`."""
    ratios, level = mean_ratios(task, system.weights, actual), np.log(system.levels(task.of_f))
    return frame_map(task, system.bands, ratios, level, way, quick=quick)


def _maps(task: EstimationTask, system: FrameSystem, actual: FloatArray) -> Iterator[VarianceMap]:
    """Yield maps from the fastest to the most accurate one."""
    if isinstance(system.similar, BandedFactor):
        ratios = task.on_all_measurements(actual / task.expected_noise, 0.0)
        prior, reach = float(np.asarray(system.prior)), task.model.windowed.reach
        yield VarianceMap(*swept_maps(system.similar.matrix, system.weights, ratios, prior, task.shape, reach))
        return
    few, narrow = task.model.unknowns <= MANY, is_narrow(task)
    level, applied = np.log(system.levels(task.of_f)), task.model.applied
    uneven = float(np.ptp(level)) > EVEN_EDGES
    varies = varies_over_field(applied)
    all_windows = few and task.finer == 1
    if is_invariant(task) and not (narrow and uneven) and not (varies and all_windows):
        for way in ways_to_edges(task, system.bands):
            maps = map_by_bands(task, system, actual, way)
            yield by_windows(maps, task, applied, actual, of_mean_kernels(applied)) if varies else maps
        if not (all_windows and uneven):
            return
    elif task.finer > 1 and task.shape_of_f[0] * task.shape_of_f[1] > MANY:  # all windows would take an hour
        maps = map_by_bands(task, system, actual, "edges")
        yield by_windows(maps, task, applied, actual)
        return
    far = has_few_windows(task) or not task.model.camera.has_sharp_footprints or level.std() > SPREAD
    halos = HALOS[int(far) :]
    for halo in halos if few and not narrow else halos[:1]:
        yield windows_map(task, system.weights, system.bands, actual, halo)


def is_invariant(task: EstimationTask) -> bool:
    """Return True if every lens type sees the same everywhere: m x m sub-imagers one pixel of f apart, and one H."""
    model = task.model
    types, parts = model.camera.types, model.applied.parts
    alike = len(parts) == len(types) and not any(isinstance(part, Entries) for part in parts)
    alike = alike or (model.camera.tolerance is None and model.is_nearly_designed)
    return alike and all(each.finer(Fraction(1, task.finer)).is_sliding for each in types)


def spread_pixels(shape: tuple[int, int], rng: np.random.Generator, *, edges: bool, first: int = 0) -> Pixels:
    """Return random pixels of a frame that lie SPACING rows or columns apart, (n,); with `edges` some lie near them.

    first : number of the edge that the first pixel lies near
    """
    rows, columns = shape
    trials = np.stack([rng.integers(rows, size=TRIALS), rng.integers(columns, size=TRIALS)], axis=1)
    for number in range(4 if edges else 0):
        axis, end = divmod((first + number) % 4, 2)
        near = int(rng.integers(min(EDGE, shape[axis])))
        trials[number, axis] = shape[axis] - 1 - near if end else near
    chosen = [trials[0]]
    for pixel in trials[1:]:
        if len(chosen) < MOST and (np.abs(np.array(chosen) - pixel).max(axis=1) >= SPACING).all():
            chosen.append(pixel)
    return np.array([row * columns + column for row, column in chosen], dtype=np.intp)
