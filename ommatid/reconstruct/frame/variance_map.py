"""Posterior variance of every pixel of a frame without its covariance, of even noise.

The interior follows from the transfer function, the border from strips along the edges, of whose inverses only the
diagonal is computed. In a shift-invariant camera a pixel far from the edges has the mean of 1 / spectrum as its
variance; near an edge, pixels deeper than some boxes have no effect. If the lens types leave no null space, both are
accurate to 1e-3 or better; otherwise errors are correlated over any distance and the map is approximate.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import one_thread, processors

from ..forms.cholesky import factorise_positive
from .sliding import SlidingCamera, SlidingType
from .window_variances import inverse_diagonal

FINEST = 1024  # frequencies along an axis; a finer grid makes no difference
DEPTH = 9  # of a strip, in boxes of the widest type; half of it is used
STEP = 1e-4  # relative step of a finite difference, and the largest relative error it causes
SIDE = 40  # pixels of a small frame whose middle represents any interior; the cost grows with the sixth power
LONG, SHORT = 60, 44  # of those from which the effect of the length follows
LEAST_SHARE = 0.1  # of a variance in the small frame, which that in a large one is at least
GRID = 128  # pixels of the frame without edges on which the effect of kernels is computed
PLACES = 5  # along each axis, of whose kernels the effect is computed


@dataclass(frozen=True)
class VarianceMap:
    """Maps over the pixels: the diagonal of C, and the parts of Eq. 5 due to the prior and due to the noise."""

    posterior: FloatArray
    missing: FloatArray
    noisy: FloatArray


def variance_map(perturbed: Callable[[float, float], FloatArray], *, noise_as_expected: bool) -> VarianceMap:
    """Return the map from `perturbed`, the diagonal of (K + s P0^-1 + t S)^-1 for small s and t.

    S is H^T Rv^-1 Rvm Rv^-1 H with the actual noise Rvm, so the terms of Eq. 5, C P0^-1 C + C S C, are derivatives.
    noise_as_expected : True if Rvm = Rv; the part of the noise is then the rest of C
    """
    posterior = perturbed(0.0, 0.0)
    missing = (posterior - perturbed(STEP, 0.0)) / STEP
    if noise_as_expected:
        return VarianceMap(posterior, missing, posterior - missing)
    return VarianceMap(posterior, missing, (perturbed(0.0, -STEP) - perturbed(0.0, STEP)) / (2 * STEP))


def sliding_variance_map(
    system: SlidingCamera, actual: tuple[float, ...], posterior: Callable[[SlidingCamera], FloatArray]
) -> VarianceMap:
    """Return the map of a shift-invariant camera whose lens types have the actual noise variances `actual`."""
    ratios = [weight * variance for weight, variance in zip(system.weights, actual, strict=True)]
    largest = max(ratios) or 1.0
    as_expected = np.allclose(ratios, 1.0, rtol=1e-12)

    def perturbed(prior: float, noise: float) -> FloatArray:
        changes = [1 + noise * ratio / largest for ratio in ratios]
        weights = tuple(weight * change for weight, change in zip(system.weights, changes, strict=True))
        return posterior(replace(system, weights=weights, prior=system.prior * (1 + prior)))

    variances = variance_map(perturbed, noise_as_expected=as_expected)
    return variances if as_expected else replace(variances, noisy=largest * variances.noisy)


def posterior_variance(system: SlidingCamera) -> FloatArray:
    """Return the diagonal of K^-1 for independent pixels: (rows, columns)."""
    # Pixels beyond a strip count as known, so at a corner the larger of two variances is the more accurate one.
    border = np.zeros(system.shape)
    with one_thread():  # the blocks are small
        for axis in (1, 0):
            view = border if axis == 0 else border.T
            size = system.shape[axis]
            deep = min(DEPTH * system.widest(axis), size)
            half = (deep + 1) // 2 if deep < size else size
            top = _strip_variance(system, axis, slice(0, deep))
            bottom = _strip_variance(system, axis, slice(size - deep, size))
            for rows, part in ((slice(0, half), top[:half]), (slice(size - half, size), bottom[deep - half :])):
                view[rows] = np.maximum(view[rows], part)
    return np.where(border > 0, border, interior_variance(system))


def unseen_corners(system: SlidingCamera) -> list[tuple[int, int]]:
    """Return the corner pixels, (row, column), where two edges meet that some lens types do not see.

    Errors there reach along both edges to their ends, and no strip shows their variance.
    """
    ends = [
        [
            place
            for place, unseen in (
                (0, any(each.axes[axis].first > 0 for each in system.types)),
                (size - 1, any(each.axes[axis].end < size for each in system.types)),
            )
            if unseen
        ]
        for axis, size in enumerate(system.shape)
    ]
    return [(row, column) for row in ends[0] for column in ends[1]]


def interior_variance(system: SlidingCamera) -> float:
    """Mean of 1 / spectrum over the frequencies of a frame without edges."""
    vertical, horizontal = (
        2 * np.pi * (np.arange(min(size, FINEST)) + 0.5) / min(size, FINEST) for size in system.shape
    )
    total = np.full((vertical.size, horizontal.size), system.prior)
    for means, weight in zip(system.types, system.weights, strict=True):
        total += weight * np.outer(means.vertical.transfer_at(vertical), means.horizontal.transfer_at(horizontal))
    return float(np.mean(1 / total))


def _strip_variance(system: SlidingCamera, axis: int, part: slice) -> FloatArray:
    """The diagonal of the inverse of K in a strip along one edge, (depth, length), by blocks of its columns."""
    prior = float(np.asarray(system.prior))
    depth, length = part.stop - part.start, system.shape[1 - axis]
    wide = max(system.widest(1 - axis) - 1, 1)
    across = [means.axes[axis].gram[part, part].toarray() for means in system.types]
    along = [weight * means.axes[1 - axis].gram for means, weight in zip(system.types, system.weights, strict=True)]
    blocks = [slice(first, last) for first, last in pairwise([*range(0, length, wide), length])]

    def block(row: int, column: int) -> FloatArray:
        parts = [
            np.kron(gram[blocks[row], blocks[column]].toarray(), other)
            for gram, other in zip(along, across, strict=True)
        ]
        values = np.sum(parts, axis=0)
        if row == column:
            values[np.diag_indices_from(values)] += prior
        return values

    return inverse_diagonal(len(blocks), block).reshape(length, depth).T


@dataclass(frozen=True)
class _Place:
    """A place on an axis of a frame whose kernels small frames have.

    at : from 0, the axis's first end, to 1, its last
    pixels, share : those of the axis to which it contributes, and how much: (n,)
    """

    size: int
    at: float
    pixels: NDArray[np.intp]
    share: FloatArray

    def before(self, side: int) -> int:
        """Return the number of pixels before a small frame."""
        return round(self.at * (self.size - side))

    def index(self, side: int) -> NDArray[np.intp]:
        """Return the pixels of a small frame that stand for `pixels`: (n,)."""
        return _small_index(self.size, side)[self.pixels]

    def kept(self, side: int) -> NDArray[np.intp]:
        """Return the pixels whose kernels those of a small frame have: (n,)."""
        return self.before(side) + self.index(side)


class SmallFrames:
    """Small frames with the edges of a large one, whose middle represents any interior, for any prior and any kernels.

    Errors of waves that some lens types do not see reach from edge to edge. Where an edge has as many such waves in a
    frame of any length n, their part in the variance of a pixel falls with 1 / n, which two lengths show. Maps are
    relative to the variances that transfer functions give far from the edges, for the kernels at the same place: where
    kernels vary over the field, small frames have those of nine places, edges and corners among them.

    precision : from a shape to 1 / P0 of independent pixels, or 1 / the spectrum of the prior on that shape
    ratios : of the actual to the expected noise variance of each lens type
    far : True if errors reach from edge to edge; kernels are then those of the middle of the frame
    """

    def __init__(
        self,
        system: SlidingCamera,
        precision: Callable[[tuple[int, int]], float | FloatArray],
        ratios: tuple[float, ...],
        *,
        far: bool,
    ) -> None:
        """Take a shift-invariant camera whose weights are the means of each lens type."""
        self.shape = system.shape
        self._system, self._ratios, self._precision, self._far = system, ratios, precision, far
        self._varies = not far and any(each.varies for each in system.types)
        self._types: dict[tuple[int, tuple[int, ...]], SlidingType] = {}

    def relative(self, scale: float) -> FloatArray:
        """Return the three maps for all weights times `scale`, relative to those of `interior`: (3, rows, columns)."""
        total = np.zeros((3, *self.shape))
        local = self._local(scale)
        sides = [min(LONG if self._far else SIDE, size) for size in self.shape]
        every = list(product(*(self._places(size) for size in self.shape)))
        with ThreadPoolExecutor(processors()) as threads:
            of_places = list(threads.map(partial(self._at, scale), every))
        for places, at in zip(every, of_places, strict=True):
            down, across = places
            kept = (each.kept(side) for each, side in zip(places, sides, strict=True))
            maps = at / np.maximum(_interpolated(local, self.shape, *kept), np.finfo(float).tiny)
            for each, found in zip(total, maps, strict=True):
                each[np.ix_(down.pixels, across.pixels)] += np.outer(down.share, across.share) * found
        return total

    def interior(self, scale: float) -> FloatArray:
        """Return the three maps of a frame without edges for all weights times `scale`: (3, rows, columns)."""
        return _interpolated(self._local(scale), self.shape, *(np.arange(size) for size in self.shape))

    def _at(self, scale: float, places: tuple[_Place, ...]) -> FloatArray:
        """Return the three maps of the pixels that belong to a place from the small frames there."""
        found: list[FloatArray] = []
        shares: list[float] = []
        for lengths in product(*(self._lengths(size) for size in self.shape)):
            sides = tuple(side for side, _ in lengths)
            down, across = (each.index(side) for each, side in zip(places, sides, strict=True))
            found.append(self._small(sides, scale, places)[:, down[:, None], across])
            shares.append(float(np.prod([share for _, share in lengths])))
        total = sum(share * each for share, each in zip(shares, found, strict=True))
        return np.maximum(total, LEAST_SHARE * found[0])

    def _lengths(self, size: int) -> list[tuple[int, float]]:
        """Return the sides of small frames along an axis and their shares in the variances of the large one."""
        if not self._far or size <= LONG:
            return [(min(LONG if self._far else SIDE, size), 1.0)]
        share = (1 / size - 1 / LONG) / (1 / SHORT - 1 / LONG)
        return [(LONG, 1 - share), (SHORT, share)]

    def _small(self, shape: tuple[int, ...], scale: float, places: tuple[_Place, ...]) -> FloatArray:
        rows, columns = shape
        before = places[0].before(rows), places[1].before(columns)
        types: list[SlidingType] = []
        for number, each in enumerate(self._system.types):
            if self._varies and each.varies:
                types.append(each.shortened((rows, columns), before))
                continue
            if (number, shape) not in self._types:  # H^T H is computed once
                self._types[number, shape] = each.shortened((rows, columns), before)
            types.append(self._types[number, shape])
        system = SlidingCamera(tuple(types), self._system.weights, self._precision((rows, columns)))
        return small_map(system, scale, self._ratios)

    def _places(self, size: int) -> list[_Place]:
        """Return the places along an axis whose kernels small frames have."""
        if not self._varies or size <= SIDE:
            return [_Place(size, 0.5, np.arange(size), np.ones(size))]
        along = np.clip((np.arange(size) - SIDE / 2) / (size - SIDE), 0, 1)
        places: list[_Place] = []
        for at, share in (
            (0.0, (2 * along - 1) * (along - 1)),
            (0.5, 4 * along * (1 - along)),
            (1.0, (2 * along - 1) * along),
        ):
            pixels = np.flatnonzero(share)
            places.append(_Place(size, at, pixels, share[pixels]))
        return places

    def _local(self, scale: float) -> FloatArray:
        """Return the three variances far from the edges at places of the frame: (places down, places across, 3)."""
        return np.array([[self._interior(each, scale) for each in line] for line in self._transfers])

    @cached_property
    def _transfers(self) -> list[list[FloatArray]]:
        """Squared transfer functions of the types' kernels at PLACES x PLACES places of the frame, or at its middle."""
        down, across = (np.linspace(0, size, PLACES) if self._varies else np.array([size / 2]) for size in self.shape)
        kernels = [zip(*(each.kernels_at(row, across) for each in self._system.types), strict=True) for row in down]
        return [[np.array([_transfer(kernel) for kernel in each]) for each in line] for line in kernels]

    @cached_property
    def _prior(self) -> float | FloatArray:
        return self._precision((GRID, GRID))

    def _interior(self, transfers: FloatArray, scale: float) -> FloatArray:
        """Return the variances far from the edges by transfer functions, as the maps have them: (3,)."""
        weights, prior = scale * np.asarray(self._system.weights), self._prior
        squares = 1 / np.square(prior + np.tensordot(weights, transfers, axes=1))
        missing = np.mean(prior * squares)
        noisy = np.mean(np.tensordot(weights * self._ratios, transfers, axes=1) * squares)
        return np.array([np.mean(np.sqrt(squares)), missing, noisy], dtype=np.float64)


def small_map(system: SlidingCamera, scale: float, ratios: tuple[float, ...]) -> FloatArray:
    """Return the diagonals of C, C P0^-1 C and C S C of a small frame for weights times `scale`: (3, rows, columns)."""
    parts = [scale * weight * each.information for each, weight in zip(system.types, system.weights, strict=True)]
    first, excess = ratios[0], None
    for part, ratio in zip(parts, ratios, strict=True):
        if not np.isclose(ratio, first, rtol=1e-12):
            excess = (ratio - first) * part + (0.0 if excess is None else excess)
    precision = np.sum(parts, axis=0) + prior_precision(system.prior, system.shape)
    return precision_map(precision, system.prior, system.shape, first, excess)


def prior_precision(prior: float | FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return P0^-1 of a small frame as a matrix, (N, N), from 1 / P0 or 1 / its spectrum under the DCT-II."""
    if not isinstance(prior, np.ndarray):
        return prior * np.eye(shape[0] * shape[1])
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    return np.asarray(waves.T @ (prior.ravel()[:, None] * waves), dtype=np.float64)


def precision_map(
    precision: FloatArray, prior: float | FloatArray, shape: tuple[int, int], ratio: float, excess: FloatArray | None
) -> FloatArray:
    """Return the diagonals of C = K^-1, C P0^-1 C and C S C of a small frame: (3, rows, columns).

    precision : (N, N) K;  prior : 1 / P0 or 1 / its spectrum
    ratio, excess : S is `ratio` times H^T Rv^-1 H plus `excess`, (N, N), which None leaves out
    """
    factor, _ = factorise_positive(precision)
    covariance = factor.inverse()
    if isinstance(prior, np.ndarray):
        spread = np.asarray(fft.dctn(covariance.reshape(*shape, -1), 2, axes=(0, 1), norm="ortho"))
        missing = np.einsum("rc,rcn->n", prior, np.square(spread))
    else:
        missing = prior * np.square(covariance).sum(axis=0)
    posterior = np.diagonal(covariance)
    noisy = ratio * (posterior - missing)
    if excess is not None:
        noisy += np.einsum("ij,ij->j", covariance, excess @ covariance)
    return np.array([posterior, missing, noisy], dtype=np.float64).reshape(3, *shape)


def _interpolated(
    local: FloatArray, shape: tuple[int, int], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> FloatArray:
    """Return values at places from edge to edge of a frame, (.., .., n), at some of its pixels: (n, rows, columns)."""
    if local.shape[:2] == (1, 1):
        return np.broadcast_to(local[0, 0, :, None, None], (local.shape[2], rows.size, columns.size))
    down, across = (
        CubicSpline(np.linspace(0, size, PLACES), np.eye(PLACES))(index + 0.5)
        for size, index in zip(shape, (rows, columns), strict=True)
    )
    return np.einsum("ri,ijk,cj->krc", down, local, across, optimize=True)


def _transfer(kernel: FloatArray) -> FloatArray:
    """Return the squared transfer function at the waves of a DCT-II of GRID pixels, of both slants: (2, GRID, GRID)."""
    period = 2 * GRID
    padded = np.pad(kernel, [(0, -size % period) for size in kernel.shape])  # a wider kernel is folded
    folded: FloatArray = padded.reshape(padded.shape[0] // period, period, -1, period).sum(axis=(0, 2))
    spectrum = np.square(np.abs(np.asarray(fft.rfft2(folded))))[:, :GRID]
    return np.stack([spectrum[:GRID], spectrum[-np.arange(GRID)]])


def enlarged(variance: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the map of a small frame for a frame of `shape`."""
    return variance[np.ix_(*(_small_index(*sizes) for sizes in zip(shape, variance.shape, strict=True)))]


def _small_index(size: int, side: int) -> NDArray[np.intp]:
    """Index, on an axis of `side` pixels, of each of `size`: equally far from the nearer edge, or in the middle."""
    index = np.arange(size)
    return index if side >= size else np.where(index < side // 2, index, np.maximum(side - (size - index), side // 2))
