"""The variance of every pixel of a frame without its covariance: the interior from the transfer function, the border
from strips along the edges, whose inverses are wanted on the diagonal alone.

Where a camera sees the same everywhere, a pixel far from the edges has the mean of 1 / spectrum for its variance; near
an edge, what lies deeper than some boxes makes no difference any more. Where the lens types leave no null space both
hold to 1e-3 and better; else errors go together over any distance, and the map is a rough one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ommatid.runtime.processors import one_thread

from ..forms.cholesky import factorise_positive
from .preconditioner import BoxMeans, Preconditioner
from .selected_inverse import inverse_diagonal

Vector = NDArray[np.float64]
Image = NDArray[np.float64]

FINEST = 1024  # frequencies along an axis: a finer grid changes nothing
DEPTH = 9  # of a strip, in boxes of the widest type: half of it is used
STEP = 1e-4  # relative, of a derivative: so much of it is lost at most
SIDE = 44  # pixels, of a small frame whose middle is as good as any; the cost grows with the sixth power


def posterior_map(frame: Preconditioner) -> Image:
    """The diagonal of K^-1 for independent pixels: (rows, columns)."""
    # A strip takes what lies beyond it for known, so that of two in a corner the larger variance is nearer.
    border = np.zeros(frame.shape)
    with one_thread():  # the blocks are small
        for axis in (1, 0):
            view = border if axis == 0 else border.T
            size = frame.shape[axis]
            deep = min(DEPTH * max(means[axis].width for means in frame.types), size)
            half = (deep + 1) // 2 if deep < size else size
            top, bottom = _strip(frame, axis, slice(0, deep)), _strip(frame, axis, slice(size - deep, size))
            for place, part in ((slice(0, half), top[:half]), (slice(size - half, size), bottom[deep - half :])):
                view[place] = np.maximum(view[place], part)
    return np.where(border > 0, border, _interior(frame))


def _interior(frame: Preconditioner) -> float:
    """Mean of 1 / spectrum over the frequencies of a frame without edges."""
    down, across = (2 * np.pi * (np.arange(min(size, FINEST)) + 0.5) / min(size, FINEST) for size in frame.shape)
    total = np.full((down.size, across.size), frame.prior)
    for (one, other), weight in zip(frame.types, frame.weights, strict=True):
        total += weight * np.outer(one.transfer_at(down), other.transfer_at(across))
    return float(np.mean(1 / total))


@dataclass(frozen=True)
class VarianceMap:
    """Of every pixel: the diagonal of C, and the two parts of Eq. 5, what the prior and what the noise brings."""

    posterior: Image
    missing: Image
    noisy: Image


def maps(moved: Callable[[float, float], Image], *, as_told: bool) -> VarianceMap:
    """From `moved`, the diagonal of (K + s P0^-1 + t S)^-1 for small s and t.

    S is H^T Rv^-1 Rvm Rv^-1 H, Rvm the noise as it is, so that Eq. 5, C P0^-1 C + C S C, consists of derivatives.
    as_told : whether noise is what is expected, for then its part is what is left of C
    """
    posterior = moved(0.0, 0.0)
    missing = (posterior - moved(STEP, 0.0)) / STEP
    if as_told:
        return VarianceMap(posterior, missing, posterior - missing)
    return VarianceMap(posterior, missing, (moved(0.0, -STEP) - moved(0.0, STEP)) / (2 * STEP))


def sliding_maps(
    frame: Preconditioner, actual: tuple[float, ...], make: Callable[[Preconditioner], Image]
) -> VarianceMap:
    """Where the noise of each type really has the variances `actual`."""
    shares = [weight * variance for weight, variance in zip(frame.weights, actual, strict=True)]
    most = max(shares) or 1.0

    def moved(prior: float, noise: float) -> Image:
        changes = [1 + noise * share / most for share in shares]
        weights = tuple(weight * change for weight, change in zip(frame.weights, changes, strict=True))
        return make(replace(frame, weights=weights, prior=frame.prior * (1 + prior)))

    found = maps(moved, as_told=np.allclose(shares, 1.0, rtol=1e-12))
    return found if np.allclose(shares, 1.0, rtol=1e-12) else replace(found, noisy=most * found.noisy)


def _strip(frame: Preconditioner, axis: int, place: slice) -> Image:
    """The diagonal of the inverse of K in a strip along one edge, (depth, length), by blocks of its columns."""
    prior = float(np.asarray(frame.prior))
    deep, length = place.stop - place.start, frame.shape[1 - axis]
    wide = max(max(means[1 - axis].width for means in frame.types) - 1, 1)
    through = [means[axis].gram[place, place].toarray() for means in frame.types]
    along = [weight * means[1 - axis].gram for means, weight in zip(frame.types, frame.weights, strict=True)]
    ends = [*range(0, length, wide), length]
    blocks = [slice(first, last) for first, last in pairwise(ends)]

    def block(rows: slice, columns: slice) -> Image:
        parts = [np.kron(one[rows, columns].toarray(), other) for one, other in zip(along, through, strict=True)]
        return np.sum(parts, axis=0)

    def block_of(one: int, other: int) -> Image:
        if one != other:
            return block(blocks[one], blocks[other])
        own = block(blocks[one], blocks[one])
        own[np.diag_indices_from(own)] += prior
        return own

    return inverse_diagonal(len(blocks), block_of).reshape(length, deep).T


def small_map(frame: Preconditioner, precision: Image) -> Image:
    """The same where pixels go together: from a small frame with the same edges, its interior repeated.

    precision : 1 / the prior's spectrum on a frame of `small_shape`
    """
    shape = small_shape(frame.shape)
    down, across = (np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape)
    waves = np.kron(down, across)
    total = waves.T @ (precision.ravel()[:, None] * waves)
    for pair, weight in zip(frame.types, frame.weights, strict=True):
        one, other = (_shortened(means, size).gram.toarray() for means, size in zip(pair, shape, strict=True))
        total += weight * np.kron(one, other)
    factor, _ = factorise_positive(total)
    variance = np.diagonal(factor.inverse()).reshape(shape)
    return variance[np.ix_(*(_spots(*sizes) for sizes in zip(frame.shape, shape, strict=True)))]


def small_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the small frame that stands for one of `shape`."""
    return min(SIDE, shape[0]), min(SIDE, shape[1])


def _shortened(means: BoxMeans, size: int) -> BoxMeans:
    return replace(means, end=size - (means.size - means.end), size=size)


def _spots(size: int, side: int) -> NDArray[np.intp]:
    """Where on an axis of `side` pixels each of `size` stands: as far from the nearer edge, or in the middle."""
    place = np.arange(size)
    return place if side >= size else np.where(place < side // 2, place, np.maximum(side - (size - place), side // 2))
