"""The expected error (Eq. 5) of every pixel of a frame, by the way that its noise, its prior and its lens types allow.

Even noise and an ideal H of boxes are served by the transfer function, any other noise and H of boxes by windows side
by side, lens types that leave a null space by one sweep over the frame. A correlated prior and kernels take the maps of
even noise from transfer functions and from small frames with the same edges, at several levels, between which each
pixel finds that of the measurements near it.

The error of a map is measured at random pixels by exact solutions of the frame's own system. With x = C z, z random
signs at pixels k far from one another and 0 elsewhere, z_k x_k is C_kk: what the others add falls with the distance as
C does (Tang and Saad 2012). So one solution measures the variances of some hundred pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera

from ..methods.method import EstimationTask, is_uniform
from .conjugate_gradients import BandedSystem, FrameSystem, NotReachedError, leaves_null_space
from .sliding import SlidingCamera, is_sliding, sliding_camera
from .variance_map import (
    SmallFrames,
    VarianceMap,
    interior_variance,
    posterior_variance,
    sliding_variance_map,
    unseen_corners,
    variance_map,
)
from .window_variances import (
    BESIDE,
    CORE,
    LENGTH,
    EvenNoise,
    Stencil,
    box_stencil,
    even_couplings,
    frame_variances,
    pixel_numbers,
    stored_stencil,
    whole_variances,
)
from .world_map import by_levels, is_invariant, levels, mean_ratios, world_map

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
EVEN = 1e-3  # relative range of noise variances that count as equal
HALO = 4  # boxes of the widest type around a window, beyond which pixels do not affect a variance
SHORT_HALO = 3  # the same for many pixels: 3e-3 of a variance at worst where the noise varies tenfold
WIDE_HALO = 16  # pixels of f, of windows of correlated pixels
LONG_HALO = 6  # where that is not enough: 2e-2 at worst where the noise varies a thousandfold
WORST, MEAN = 1e-2, 1e-3  # errors of a map at random pixels and of their mean, above which the halo is longer


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
    task : whose unknowns are finer than f's pixels; None: the unknowns are f's pixels
    """

    system: FrameSystem
    noise: FloatArray | None
    accuracy: float
    task: EstimationTask | None = None

    def at(self, pixels: Pixels, posterior: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return Eq. 5 of pixels whose errors are not correlated, (n,); posterior : (N,) about the diagonal of C."""
        signs = np.zeros_like(posterior)
        signs[pixels] = rng.choice([-1.0, 1.0], size=pixels.size)
        finest = EXACT * float(np.sqrt(posterior[pixels].min()))
        weights = signs if self.task is None else self.task.of_unknowns(signs)
        solved = self._solve(weights, finest)
        if self.noise is not None:
            readings = self.system.observation.forward(solved)
            if pixels.size == 1:  # the quadratic form is that of the pixel alone
                missing = float(solved @ self.system.apply_prior_precision(solved))
                return np.array([missing + float(self.noise @ np.square(readings))])
            readings *= self.noise
            right = self.system.observation.adjoint(readings) + self.system.apply_prior_precision(solved)
            smallest = float(np.min((signs * self._of_f(solved))[pixels]))
            solved = self._solve(right, min(finest, EXACT * max(smallest, 0.0) / float(posterior.max()) ** 0.5))
        return (signs * self._of_f(solved))[pixels]

    def _of_f(self, image: FloatArray) -> FloatArray:
        return image if self.task is None else self.task.of_f(image)

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


def world_error_map(
    task: EstimationTask, system: FrameSystem, actual: FloatArray
) -> tuple[VarianceMap, MapCheck, FloatArray | float]:
    """Return the maps of f's pixels in front of a finer world, their error at random pixels, and f's prior variance.

    Errors are correlated far: pixels are taken one at a time.
    """
    if system.bands is None:
        raise TypeError("expected the system of a world finer than f")
    make = partial(world_map, task, system.observation, system.weights, system.bands, actual)
    variances, prior, is_exact = make()
    if is_exact:
        return variances, MapCheck(0.0, 0.0), prior
    noise = None
    if not np.allclose(actual, task.expected_noise, rtol=1e-12):
        noise = system.weights**2 * task.on_all_measurements(actual, 0.0)
    exact = ExactVariances(system, noise, task.settings.accuracy, task)

    def checked(maps: VarianceMap) -> MapCheck:
        variance = np.maximum(maps.missing + maps.noisy, 0.0).ravel()
        return check_map(variance, maps.posterior.ravel(), task.shape_of_f, exact, local=False)

    check = checked(variances)
    if check.worst > 2 * WORST and not is_invariant(task):
        variances, prior, _ = make(WIDE_HALO)
        check = checked(variances)
    return variances, check, prior


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


@dataclass(frozen=True)
class ErrorMap:
    """Maps of the expected error of a frame whose estimator is `system`.

    actual : (measurements used,) noise;  halo : of windows, in boxes of the widest lens type
    small_frames : for a correlated prior or kernels
    """

    task: EstimationTask
    system: FrameSystem
    actual: FloatArray
    halo: int
    small_frames: SmallFrames | None = None

    @classmethod
    def of(cls, task: EstimationTask, system: FrameSystem, actual: FloatArray) -> tuple[ErrorMap, MapCheck]:
        """Return the maps and their error at random pixels; those of windows where it is too large with a long halo."""
        maps = cls(task, system, actual, HALO if task.model.unknowns <= MANY else SHORT_HALO)
        if not isinstance(system, BandedSystem) and not maps._is_local:
            ratios = mean_ratios(task, system.weights, actual)
            far = leaves_null_space(task.model.camera) or bool(unseen_corners(maps._sliding))
            maps = replace(maps, small_frames=SmallFrames(maps._sliding, task.precision_on, ratios, far=far))
        check = maps.checked()
        if check.worst <= WORST and check.mean <= MEAN:
            return maps, check
        if not maps.has_windows:
            return maps, check
        longer = replace(maps, halo=LONG_HALO)
        return longer, longer.checked()

    @property
    def variance(self) -> FloatArray:
        """Eq. 5 of all pixels, (N,)."""
        return np.maximum(self.maps.missing + self.maps.noisy, 0.0).ravel()

    @property
    def has_windows(self) -> bool:
        """True if the maps come from windows."""
        return not isinstance(self.system, BandedSystem) and self._is_local and not self.is_even

    @property
    def _is_local(self) -> bool:
        """True if pixels are independent and H averages over boxes, so that K couples near pixels only."""
        return isinstance(self.system.prior, float) and self._has_boxes

    @cached_property
    def _has_boxes(self) -> bool:
        return self.task.model.camera.has_sharp_footprints

    @cached_property
    def maps(self) -> VarianceMap:
        """Variances of all pixels."""
        if isinstance(self.system, BandedSystem):
            return self._perturbed_map(self._swept)
        if self.small_frames is not None:
            return self._by_levels(self.small_frames)
        return self._with_corners(self._even_map() if self.is_even else self._perturbed_map(self._windows))

    def _with_corners(self, variances: VarianceMap) -> VarianceMap:
        """Replace the variances of corner pixels that some lens types do not see by exact solutions."""
        if not self._is_sliding:
            return variances
        parts = [np.array(part) for part in (variances.posterior, variances.missing, variances.noisy)]
        noise = self.system.weights**2 * self.task.on_all_measurements(self.actual, 0.0)
        for corner in unseen_corners(self._sliding):
            unit = np.zeros(self.task.shape)
            unit[corner] = 1.0
            solved = self.system.solve(unit.ravel(), self.task.settings.accuracy).image
            parts[0][corner] = solved[np.flatnonzero(unit)[0]]
            parts[1][corner] = solved @ self.system.apply_prior_precision(solved)
            parts[2][corner] = noise @ np.square(self.system.observation.forward(solved))
        return VarianceMap(*parts)

    def checked(self) -> MapCheck:
        """Compare the map of Eq. 5 with exact solutions for random pixels."""
        noise = None
        if not self.as_expected:
            noise = self.system.weights**2 * self.task.on_all_measurements(self.actual, 0.0)
        exact = ExactVariances(self.system, noise, self.task.settings.accuracy)
        local = isinstance(self.system.prior, float) and not isinstance(self.system, BandedSystem)
        local = local and not leaves_null_space(self.task.model.camera)
        return check_map(self.variance, self.maps.posterior.ravel(), self.task.shape, exact, local=local)

    @cached_property
    def _is_sliding(self) -> bool:
        return is_sliding(self.task.model.alike, self.task.model.camera.types)

    @cached_property
    def _sliding(self) -> SlidingCamera:
        """The shift-invariant camera like this one, with the mean weight of each lens type."""
        model, slices = self.task.model, self.task.model.camera.type_slices()
        means = tuple(float(self.system.weights[part].mean()) for part in slices)
        return sliding_camera(model.alike, model.camera.types, means, self.system.prior)

    @cached_property
    def as_expected(self) -> bool:
        """True if the actual noise is that which the estimator expects."""
        return np.allclose(self.actual, self.task.expected_noise, rtol=1e-12)

    @cached_property
    def is_even(self) -> bool:
        """True if H is as designed, or nearly so, and both expected and actual noise are even over each lens type."""
        if self._has_boxes and not self.task.model.is_nearly_designed:
            return False
        if not self.task.complete:
            return False
        slices = self.task.model.camera.type_slices()
        return all(_even(values[part]) for values in (self.task.expected_noise, self.actual) for part in slices)

    @cached_property
    def _largest(self) -> float:
        return float(np.max(self.actual / self.task.expected_noise)) or 1.0

    def _perturbed_map(self, posterior: Callable[[FloatArray, float], FloatArray]) -> VarianceMap:
        """Variances for any H and noise from those of perturbed systems."""
        as_expected = self.as_expected
        variances = variance_map(self._by_weights(posterior), noise_as_expected=as_expected)
        return variances if as_expected else replace(variances, noisy=self._largest * variances.noisy)

    def _by_weights(self, posterior: Callable[[FloatArray, float], FloatArray]) -> Callable[[float, float], FloatArray]:
        """Return diag((K + s P0^-1 + t S)^-1), S = H^T Rv^-1 Rvm Rv^-1 H over the largest ratio of Rvm to Rv."""
        weights, prior = self.system.weights, float(np.asarray(self.system.prior))
        ratios = self.task.on_all_measurements(self.actual / self.task.expected_noise, 0.0) / self._largest

        def perturbed(by_prior: float, by_noise: float) -> FloatArray:
            changed = weights * (1 + by_noise * ratios) if by_noise else weights
            return posterior(changed, (1 + by_prior) * prior)

        return perturbed

    def _swept(self, weights: FloatArray, prior: float) -> FloatArray:
        matrix = self.task.model.matrix
        information = matrix.T @ sparse.csr_array(matrix.multiply(weights[:, None]))
        precision = sparse.csr_array(information + prior * sparse.eye_array(matrix.shape[1], format="csr"))
        return whole_variances(precision, self.task.shape, self.task.model.windowed.reach - 1)

    def _windows(self, weights: FloatArray, prior: float) -> FloatArray:
        """Variances from windows for any H of shift-invariant lens types."""
        model = self.task.model
        widths = [ceil(lens_type.ratio) for lens_type in model.camera.types]
        halo = self.halo * max(widths)
        reach = max(widths) - 1 if model.is_nearly_designed else model.windowed.reach - 1

        def source(rows: slice, columns: slice) -> Stencil:
            if model.is_nearly_designed:
                return box_stencil(model.camera, weights, prior, rows, columns)
            pixels = pixel_numbers(model.camera.shape, rows, columns)
            return stored_stencil(self._by_pixel, weights, prior, pixels, reach)

        even = None
        if self._is_sliding and reach >= max(widths) - 1:
            means = tuple(float(weights[part].mean()) for part in model.camera.type_slices())
            system = replace(self._sliding, weights=means, prior=prior)
            even = EvenNoise(even_couplings(widths, means, prior, reach), interior_variance(system))
        return frame_variances(source, model.camera.shape, halo, even)

    @cached_property
    def _by_pixel(self) -> sparse.csc_array:
        return sparse.csc_array(self.task.model.to_sparse())

    def _even_map(self) -> VarianceMap:
        """Variances of noise that is even over each lens type."""
        ratios = mean_ratios(self.task, self.system.weights, self.actual)
        actual = tuple(
            ratio / weight if weight else 0.0 for ratio, weight in zip(ratios, self._sliding.weights, strict=True)
        )
        return sliding_variance_map(self._sliding, actual, posterior_variance)

    def _by_levels(self, small_frames: SmallFrames) -> VarianceMap:
        """Variances of uneven noise from those of even noise, at the level of the measurements of each pixel.

        Of noise that is not even the means are those of the weights, and of the actual noise with squared weights.
        """
        level = np.log(levels(self.task, self.system.observation, self.system.weights))
        return by_levels(
            level,
            lambda value: small_frames.interior(float(np.exp(value))),
            lambda value: small_frames.relative(float(np.exp(value))),
        )


def window_memory(camera: Camera) -> int:
    """Return the bytes that variances from windows take, for the ideal H: two long edges, one slab, its windows."""
    widest = max(ceil(lens_type.ratio) for lens_type in camera.types)
    halo = LONG_HALO * widest
    lines, longest = max(widest - 1, 1), max(camera.shape)
    slab = min(LENGTH + 2 * halo, longest)
    offsets = (2 * lines + 1) ** 2 // 2 + 1

    def sweep(length: int, broad: int) -> int:
        return 2 * 8 * length * lines * min(broad, longest) ** 2  # an inverse and a link per block of lines

    windows = processors() * sweep(slab, CORE + 2 * halo)
    return 2 * sweep(longest, 2 * halo + BESIDE) + 8 * offsets * slab * longest + windows


def _even(values: FloatArray) -> bool:
    return is_uniform(values) or bool(np.ptp(values) <= EVEN * values.min())
