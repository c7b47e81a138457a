"""Approximate inverse of the precision of a shift-invariant camera: a sine transform, and strips at the border.

If a lens type has m x m sub-imagers one pixel apart, its sensor pixels are all the averages over boxes of m x m pixels
inside its field. With one noise variance per lens type and independent pixels, the precision

    K = sum over types of (G x G') / variance + 1 / P0,   G = D^T D, D moving averages along one axis,

is Toeplitz except at the border. M, the same sum for an image continued antisymmetrically beyond its edges, is diagonal
under the sine transform (DST-II) and differs from K near the border only. Three steps approximate K^-1 r to a few
percent or better: solve K exactly in strips along the border, M for the remaining residual, and the strips again
(a symmetric multiplicative Schwarz method; Smith, Bjorstad and Gropp 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

Pair = tuple[sparse.csr_array, sparse.csr_array]

DEPTH = 5  # of a strip, in boxes of the widest type: the error is a percent at a noise variance of 1e-2
WORKERS = -1  # threads of a transform: all cores; each row belongs to one thread, so results do not change


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
    def mirrored_gram(self) -> sparse.csr_array:
        """G of all means of the antisymmetrically continued axis: Toeplitz minus the mirrored terms at the ends."""
        reach = self.width - 1
        kernel = (self.width - np.abs(np.arange(-reach, reach + 1))) / self.width**2
        offsets = list(range(-reach, reach + 1))
        toeplitz = sparse.lil_array(sparse.diags_array(kernel, offsets=offsets, shape=(self.size, self.size)))
        for i in range(reach):
            for j in range(reach - i):
                share = (reach - i - j) / self.width**2
                toeplitz[i, j] -= share
                toeplitz[self.size - 1 - i, self.size - 1 - j] -= share
        return sparse.csr_array(toeplitz)

    @cached_property
    def transfer(self) -> FloatArray:
        """Eigenvalues of `mirrored_gram` under the sine transform: (size,)."""
        return self.transfer_at(np.pi * (np.arange(self.size) + 1) / self.size)

    def transfer_at(self, angle: FloatArray) -> FloatArray:
        """Return the squared transfer function of a mean at angular frequencies in (0, 2 pi) per pixel."""
        return np.square(np.sin(self.width * angle / 2) / (self.width * np.sin(angle / 2)))

    @property
    def borders(self) -> tuple[int, int]:
        """Number of pixels at either end where `gram` and `mirrored_gram` differ."""
        return self.first + self.width - 1, self.size - self.end + self.width - 1


@dataclass(frozen=True)
class Preconditioner:
    """K of a shift-invariant camera: for each type the means along rows and columns, and its weight 1 / variance.

    prior : 1 / P0 of independent pixels, or 1 / its spectrum, (rows, columns), under the sine transform
    """

    types: tuple[tuple[BoxMeans, BoxMeans], ...]
    weights: tuple[float, ...]
    prior: float | FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frame."""
        return self.types[0][0].size, self.types[0][1].size

    def widest(self, axis: int) -> int:
        """Return the largest box width along an axis."""
        return max(means[axis].width for means in self.types)

    @cached_property
    def spectrum(self) -> FloatArray:
        """Eigenvalues of M: (rows, columns)."""
        total = np.zeros(self.shape)
        for (vertical, horizontal), weight in zip(self.types, self.weights, strict=True):
            total += weight * np.outer(vertical.transfer, horizontal.transfer)
        total += self.prior
        return total

    def solve(self, image: FloatArray) -> FloatArray:
        """Return approximately K^-1 r, (rows, columns): symmetric positive definite, as conjugate gradients need."""
        residual = np.array(image, dtype=np.float64)
        if not isinstance(self.prior, float):
            return self._solve_transform(residual)
        solution = np.zeros(self.shape)
        for strip in self._strips:
            strip.correct(solution, residual, self.prior)
        step = self._solve_transform(residual)
        solution += step
        residual = self._border_difference(step)
        for strip in reversed(self._strips):
            strip.correct(solution, residual, self.prior)
        return solution

    def _solve_transform(self, image: FloatArray) -> FloatArray:
        """M^-1 r."""
        waves = fft.dstn(image, 2, workers=WORKERS)
        waves /= self.spectrum
        return np.asarray(fft.idstn(waves, 2, workers=WORKERS, overwrite_x=True))

    def _border_difference(self, image: FloatArray) -> FloatArray:
        """(M - K) f, which is 0 except at the border."""
        difference = np.zeros(self.shape)
        for window in self._windows:
            difference[window.window] = window.apply(image)
        return difference

    @cached_property
    def _windows(self) -> tuple[_BorderWindow, ...]:
        (rows, columns), (tall, broad) = self.shape, self._borders
        inner = slice(tall[0], rows - tall[1])
        windows = [
            (slice(0, tall[0]), slice(0, columns)),
            (slice(rows - tall[1], rows), slice(0, columns)),
            (inner, slice(0, broad[0])),
            (inner, slice(columns - broad[1], columns)),
        ]
        return tuple(_border_window(self, window) for window in windows)

    @cached_property
    def _borders(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Widths of the border at both ends of both axes."""
        vertical, horizontal = ([means[axis].borders for means in self.types] for axis in (0, 1))
        return _largest(vertical), _largest(horizontal)

    @cached_property
    def _strips(self) -> tuple[_Strip, ...]:
        """Strips along the top, bottom, left and right."""
        strips: list[_Strip] = []
        for axis in (0, 1):
            size = self.shape[axis]
            depth = min(DEPTH * self.widest(axis), size // 2)
            ends = slice(0, depth), slice(size - depth, size)
            strips += [_factorised_strip(self, float(np.asarray(self.prior)), axis, part) for part in ends]
        return tuple(strips)


def _largest(borders: list[tuple[int, int]]) -> tuple[int, int]:
    return max(border[0] for border in borders), max(border[1] for border in borders)


@dataclass(frozen=True)
class _BorderWindow:
    """(M - K) in a window of the frame, as pairs of factors along rows and columns that apply to the pixels `near`."""

    window: tuple[slice, slice]
    near: tuple[slice, slice]
    parts: tuple[Pair, ...]

    def apply(self, image: FloatArray) -> FloatArray:
        nearby = image[self.near]
        rows, columns = self.window
        start = np.zeros((columns.stop - columns.start, rows.stop - rows.start))
        return sum((level @ (upright @ nearby).T for upright, level in self.parts), start).T


def _border_window(system: Preconditioner, window: tuple[slice, slice]) -> _BorderWindow:
    near = tuple(
        slice(max(part.start - system.widest(axis) + 1, 0), min(part.stop + system.widest(axis) - 1, size))
        for axis, (part, size) in enumerate(zip(window, system.shape, strict=True))
    )
    parts: list[Pair] = []
    for (vertical, horizontal), weight in zip(system.types, system.weights, strict=True):
        for share, upright, level in (
            (weight, vertical.mirrored_gram, horizontal.mirrored_gram),
            (-weight, vertical.gram, horizontal.gram),
        ):
            parts.append((share * upright[window[0], near[0]], sparse.csr_array(level[window[1], near[1]])))
    return _BorderWindow(window, (near[0], near[1]), tuple(parts))


@dataclass(frozen=True)
class _Strip:
    """K in a strip along one edge, factorised; pixels are numbered across the strip first for a narrow band."""

    axis: int
    part: slice
    near: slice
    factor: FloatArray
    parts: tuple[Pair, ...]

    def correct(self, solution: FloatArray, residual: FloatArray, prior: float) -> None:
        """Solve for the residual in the strip, and update the residual in and near the strip."""
        image, right = (solution, residual) if self.axis == 0 else (solution.T, residual.T)
        depth, length = self.part.stop - self.part.start, right.shape[1]
        flat = np.ascontiguousarray(right[self.part].T).ravel()
        step = linalg.cho_solve_banded((self.factor, True), flat, overwrite_b=True, check_finite=False)
        step = step.reshape(length, depth)
        image[self.part] += step.T
        right[self.part] -= prior * step.T
        for across, along in self.parts:
            right[self.near] -= across @ (along @ step).T


def _factorised_strip(system: Preconditioner, prior: float, axis: int, part: slice) -> _Strip:
    depth, length = part.stop - part.start, system.shape[1 - axis]
    reach, side = system.widest(1 - axis) - 1, system.widest(axis) - 1
    band = np.zeros((reach * depth + min(side, depth - 1) + 1, length, depth))
    for means, weight in zip(system.types, system.weights, strict=True):
        along, across = means[1 - axis].gram, means[axis].gram[part, part].toarray()
        for distance in range(means[1 - axis].width):
            column = weight * along.diagonal(-distance)
            for offset in range(1 - means[axis].width, means[axis].width):
                row = distance * depth + offset
                if row < 0 or abs(offset) >= depth:
                    continue
                entries = np.diagonal(across, -offset)
                pixels = slice(max(-offset, 0), max(-offset, 0) + entries.size)
                band[row, : column.size, pixels] += column[:, None] * entries
    band[0] += prior
    near = slice(max(part.start - side, 0), min(part.stop + side, system.shape[axis]))
    parts = [
        (sparse.csr_array(weight * means[axis].gram[near, part]), means[1 - axis].gram)
        for means, weight in zip(system.types, system.weights, strict=True)
    ]
    flat = band.reshape(band.shape[0], length * depth)
    factor = linalg.cholesky_banded(flat, overwrite_ab=True, lower=True, check_finite=False)
    return _Strip(axis, part, near, factor, tuple(parts))


def is_sliding(lens_type: LensType) -> bool:
    """Return True if the type's sensor pixels are all the averages over boxes inside its field (shift-invariant)."""
    ratio = lens_type.ratio
    return (
        not lens_type.steered
        and lens_type.step == (1, 1)
        and ratio.denominator == 1
        and lens_type.array == (int(ratio), int(ratio))
    )


def preconditioner_for(camera: Camera, weights: tuple[float, ...], prior: float | FloatArray) -> Preconditioner:
    """Return the preconditioner of a shift-invariant camera. Raises ValueError if a lens type is not."""
    types: list[tuple[BoxMeans, BoxMeans]] = []
    for lens_type in camera.types:
        ratio = lens_type.ratio
        if not is_sliding(lens_type):
            raise ValueError(f"lens type '{lens_type.name}' does not see every box of {ratio} x {ratio} pixels")
        vertical, horizontal = (
            BoxMeans(int(ratio), int(first), int(first + span), size)
            for first, span, size in zip(lens_type.origin, lens_type.span, camera.shape, strict=True)
        )
        types.append((vertical, horizontal))
    return Preconditioner(tuple(types), weights, prior)
