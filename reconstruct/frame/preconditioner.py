"""The posterior of a camera that sees the same everywhere, all but solved: a sine transform, and strips at the border.

Where the sub-imagers of a type are m x m and one pixel apart, its sensor pixels are all the averages over boxes of m x
m pixels that lie in what it sees. With noise of one variance for each type and independent pixels, the precision

    K = sum over types of (G x G') / variance + 1 / P0,   G = D^T D, D sliding means along one axis,

is Toeplitz but for the border. In its place M, of the same averages over an image continued with opposite sign beyond
its edges, is diagonal under the sine transform (DST-II), and K differs from M near the border alone. So three steps
give K^-1 r to a few parts in a hundred or better: solve K exactly in strips along the border, M on what is left, and
the strips once more (a symmetric multiplicative Schwarz method; Smith, Bjorstad and Gropp 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, sparse

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

Vector = NDArray[np.float64]
Image = NDArray[np.float64]

DEPTH = 5  # of a strip, in boxes of the widest type: what it leaves is a hundredth at a noise variance of 1e-2
WORKERS = -1  # threads of a transform: all cores; each row is transformed by one of them, so results do not change


@dataclass(frozen=True)
class BoxMeans:
    """All means over `width` neighbours on an axis of `size` pixels that begin at `first` and end before `end`."""

    width: int
    first: int
    end: int
    size: int

    @cached_property
    def gram(self) -> sparse.csr_array:
        """G = D^T D: (size, size), banded."""
        count = self.end - self.first - self.width + 1
        offsets = list(range(self.first, self.first + self.width))
        means = sparse.diags_array([1 / self.width] * self.width, offsets=offsets, shape=(count, self.size))
        return sparse.csr_array(means.T @ means)

    @cached_property
    def continued(self) -> sparse.csr_array:
        """The same of all means of the axis continued with opposite sign: Toeplitz less what its ends mirror."""
        reach = self.width - 1
        kernel = (self.width - np.abs(np.arange(-reach, reach + 1))) / self.width**2
        toeplitz = sparse.lil_array(
            sparse.diags_array(kernel, offsets=list(range(-reach, reach + 1)), shape=self._square)
        )
        for i in range(reach):
            for j in range(reach - i):
                share = (reach - i - j) / self.width**2
                toeplitz[i, j] -= share
                toeplitz[self.size - 1 - i, self.size - 1 - j] -= share
        return sparse.csr_array(toeplitz)

    @property
    def _square(self) -> tuple[int, int]:
        return self.size, self.size

    @cached_property
    def transfer(self) -> Vector:
        """Eigenvalues of `continued` under the sine transform: (size,)."""
        return self.transfer_at(np.pi * (np.arange(self.size) + 1) / self.size)

    def transfer_at(self, angle: Vector) -> Vector:
        """The squared transfer function of a mean, at angles above 0 and below 2 pi a pixel."""
        return np.square(np.sin(self.width * angle / 2) / (self.width * np.sin(angle / 2)))

    @property
    def rims(self) -> tuple[int, int]:
        """How many pixels from either end the two differ."""
        return self.first + self.width - 1, self.size - self.end + self.width - 1


@dataclass(frozen=True)
class Preconditioner:
    """K of a whole frame; each type has its means along rows and columns and its weight, 1 / variance of the noise.

    prior : 1 / P0 of independent pixels, or its spectrum, (rows, columns), under the sine transform
    """

    types: tuple[tuple[BoxMeans, BoxMeans], ...]
    weights: tuple[float, ...]
    prior: float | Image

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frame."""
        return self.types[0][0].size, self.types[0][1].size

    @cached_property
    def spectrum(self) -> Image:
        """Eigenvalues of M: (rows, columns)."""
        total = np.zeros(self.shape)
        for (down, across), weight in zip(self.types, self.weights, strict=True):
            total += weight * np.outer(down.transfer, across.transfer)
        total += self.prior
        return total

    def solve(self, image: Image) -> Image:
        """About K^-1 r, (rows, columns): symmetric and positive, so that conjugate gradients can lean on it."""
        left = np.array(image, dtype=np.float64)
        if not isinstance(self.prior, float):
            return self._transformed(left)
        found = np.zeros(self.shape)
        for strip in self._strips:
            strip.correct(found, left, self.prior)
        step = self._transformed(left)
        found += step
        left = self._rim_of(step)
        for strip in reversed(self._strips):
            strip.correct(found, left, self.prior)
        return found

    def _transformed(self, image: Image) -> Image:
        waves = fft.dstn(image, 2, workers=WORKERS)
        waves /= self.spectrum
        return np.asarray(fft.idstn(waves, 2, workers=WORKERS, overwrite_x=True))

    def _rim_of(self, image: Image) -> Image:
        """(M - K) f, which is not zero in a rim alone."""
        left = np.zeros(self.shape)
        for one in self._rim:
            left[one.window] = one.apply(image)
        return left

    @cached_property
    def _rim(self) -> tuple[_Window, ...]:
        (rows, columns), (tall, broad) = self.shape, self._rims
        inner = slice(tall[0], rows - tall[1])
        windows = [
            (slice(0, tall[0]), slice(0, columns)),
            (slice(rows - tall[1], rows), slice(0, columns)),
            (inner, slice(0, broad[0])),
            (inner, slice(columns - broad[1], columns)),
        ]
        return tuple(_Window.of(self, window) for window in windows)

    @cached_property
    def _rims(self) -> tuple[tuple[int, int], tuple[int, int]]:
        ends = [[means[axis].rims for means in self.types] for axis in (0, 1)]
        return tuple((max(end[0] for end in axis), max(end[1] for end in axis)) for axis in ends)  # type: ignore[return-value]

    @cached_property
    def _strips(self) -> tuple[_Strip, ...]:
        """Top, bottom, left and right."""
        strips: list[_Strip] = []
        for axis in (0, 1):
            size = self.shape[axis]
            depth = min(DEPTH * max(means[axis].width for means in self.types), size // 2)
            ends = slice(0, depth), slice(size - depth, size)
            strips += [_Strip.of(self, float(np.asarray(self.prior)), axis, place) for place in ends]
        return tuple(strips)


@dataclass(frozen=True)
class _Window:
    """(M - K) in a window of the frame: of each type what is to be applied to the rows and to the columns near it."""

    window: tuple[slice, slice]
    near: tuple[slice, slice]
    parts: tuple[tuple[sparse.csr_array, sparse.csr_array], ...]

    @staticmethod
    def of(whole: Preconditioner, window: tuple[slice, slice]) -> _Window:
        reach = [max(means[axis].width for means in whole.types) - 1 for axis in (0, 1)]
        near = (
            slice(max(window[0].start - reach[0], 0), min(window[0].stop + reach[0], whole.shape[0])),
            slice(max(window[1].start - reach[1], 0), min(window[1].stop + reach[1], whole.shape[1])),
        )
        parts: list[tuple[sparse.csr_array, sparse.csr_array]] = []
        for (down, across), weight in zip(whole.types, whole.weights, strict=True):
            for share, one, other in (
                (weight, down.continued, across.continued),
                (-weight, down.gram, across.gram),
            ):
                parts.append((share * one[window[0], near[0]], sparse.csr_array(other[window[1], near[1]])))
        return _Window(window, near, tuple(parts))

    def apply(self, image: Image) -> Image:
        nearby = image[self.near]
        return sum((level @ (upright @ nearby).T for upright, level in self.parts), np.zeros(self._turned)).T

    @property
    def _turned(self) -> tuple[int, int]:
        rows, columns = self.window
        return columns.stop - columns.start, rows.stop - rows.start


@dataclass(frozen=True)
class _Strip:
    """K in a strip along one edge, factorised; pixels stand across the strip first, which keeps its band narrow."""

    axis: int
    place: slice
    near: slice
    factor: Vector
    parts: tuple[tuple[sparse.csr_array, sparse.csr_array], ...]

    @staticmethod
    def of(whole: Preconditioner, prior: float, axis: int, place: slice) -> _Strip:
        depth, length = place.stop - place.start, whole.shape[1 - axis]
        reach = max(means[1 - axis].width for means in whole.types) - 1
        side = max(means[axis].width for means in whole.types) - 1
        band = np.zeros((reach * depth + min(side, depth - 1) + 1, length, depth))
        for means, weight in zip(whole.types, whole.weights, strict=True):
            along, through = means[1 - axis].gram, means[axis].gram[place, place].toarray()
            for far in range(means[1 - axis].width):
                column = weight * along.diagonal(-far)
                for down in range(1 - means[axis].width, means[axis].width):
                    below = far * depth + down
                    if below < 0 or abs(down) >= depth:
                        continue
                    entries = np.diagonal(through, -down)
                    across = slice(max(-down, 0), max(-down, 0) + entries.size)
                    band[below, : column.size, across] += column[:, None] * entries
        band[0] += prior
        flat = band.reshape(band.shape[0], length * depth)
        near = slice(max(place.start - side, 0), min(place.stop + side, whole.shape[axis]))
        parts = [
            (sparse.csr_array(weight * means[axis].gram[near, place]), means[1 - axis].gram)
            for means, weight in zip(whole.types, whole.weights, strict=True)
        ]
        factor = linalg.cholesky_banded(flat, overwrite_ab=True, lower=True, check_finite=False)
        return _Strip(axis, place, near, factor, tuple(parts))

    def correct(self, found: Image, left: Image, prior: float) -> None:
        """Solve for what is left in the strip, and take what that explains from what is left, also beside the strip."""
        mine, other = (found, left) if self.axis == 0 else (found.T, left.T)
        depth, length = self.place.stop - self.place.start, other.shape[1]
        right = np.ascontiguousarray(other[self.place].T).ravel()
        solved = linalg.cho_solve_banded((self.factor, True), right, overwrite_b=True, check_finite=False)
        step = solved.reshape(length, depth)
        mine[self.place] += step.T
        other[self.place] -= prior * step.T
        for through, along in self.parts:
            other[self.near] -= through @ (along @ step).T


def is_sliding(kind: LensType) -> bool:
    """Whether a type's sensor pixels are all the averages over boxes that lie in what it sees."""
    return kind.step == 1 and kind.ratio.denominator == 1 and kind.array == (int(kind.ratio), int(kind.ratio))


def preconditioner_for(camera: Camera, weights: tuple[float, ...], prior: float | Image) -> Preconditioner:
    """K of a camera all of whose types slide. Raises ValueError if one does not."""
    types: list[tuple[BoxMeans, BoxMeans]] = []
    for kind in camera.types:
        if not is_sliding(kind):
            raise ValueError(f"lens type '{kind.name}' does not see every box of {kind.ratio} x {kind.ratio} pixels")
        ends = [int(first + span) for first, span in zip(kind.origin, kind.span, strict=True)]
        sizes = camera.shape
        down, across = (
            BoxMeans(int(kind.ratio), first, end, size)
            for first, end, size in zip(kind.origin, ends, sizes, strict=True)
        )
        types.append((down, across))
    return Preconditioner(tuple(types), weights, prior)
