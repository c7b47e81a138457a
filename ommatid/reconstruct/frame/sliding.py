"""A shift-invariant camera on a frame: lens types whose readings are one kernel, slid over the image pixel by pixel.

If a lens type has m x m sub-imagers one pixel apart, its sensor pixels are all the averages over boxes of m x m pixels
inside its field, or all correlations with one kernel. With one noise variance per lens type the precision

    K = sum over types of H^T H / variance + P0^-1

is Toeplitz except at the border, and variances far from the edges follow from the transfer functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.observation import Observation


@dataclass(frozen=True)
class BoxMeans:
    """All windows of `width` neighbours on an axis of `size` pixels that begin at `first` and end before `end`.

    before : pixels of a longer axis with the same ends that lie before those whose kernels the windows have
    """

    width: int
    first: int
    end: int
    size: int
    before: int = 0

    @property
    def count(self) -> int:
        """Number of windows."""
        return self.end - self.first - self.width + 1

    def shortened(self, size: int, before: int = 0) -> BoxMeans:
        """Return the windows of an axis of fewer pixels with the same ends, and with the kernels from `before` on."""
        return replace(self, end=size - (self.size - self.end), size=size, before=before)

    @property
    def middles(self) -> FloatArray:
        """The middles of the windows on the longer axis, in pixels: (windows,)."""
        return self.before + self.first + self.width / 2 + np.arange(self.count, dtype=np.float64)

    @property
    def places(self) -> IntArray:
        """The place of each pixel of the axis in each window, `width` beside it: (windows, size)."""
        place: IntArray = np.arange(self.size) - (self.first + np.arange(self.count))[:, None]
        return np.where((place >= 0) & (place < self.width), place, self.width)

    @cached_property
    def gram(self) -> sparse.csr_array:
        """G = D^T D of means over the windows: (size, size), banded."""
        offsets = list(range(self.first, self.first + self.width))
        means = sparse.diags_array([1 / self.width] * self.width, offsets=offsets, shape=(self.count, self.size))
        return sparse.csr_array(means.T @ means)

    def transfer_at(self, angle: FloatArray) -> FloatArray:
        """Return the squared transfer function of a mean at angular frequencies in (0, 2 pi) per pixel."""
        ratio = np.sin(self.width * angle / 2) / (self.width * np.sin(angle / 2))
        return ratio * ratio


@dataclass(frozen=True)
class SlidingType:
    """The readings of a lens type: means over boxes, or correlations with kernels that vary slowly over the field."""

    vertical: BoxMeans
    horizontal: BoxMeans
    footprints: KernelFootprints | None = None

    @property
    def kernel(self) -> FloatArray:
        """The mean of the kernels, (rows, columns) of a window."""
        if self.footprints is None:
            shape = self.vertical.width, self.horizontal.width
            return np.full(shape, 1 / (shape[0] * shape[1]))
        return self.footprints.mean_kernel

    @property
    def varies(self) -> bool:
        """True if the kernel depends on the place."""
        return self.footprints is not None and self.footprints.degree > 0

    def kernels_at(self, row: float, columns: FloatArray) -> FloatArray:
        """Return the kernels at places of the frame, in pixels, columns (n,): (n, rows, columns) of a window."""
        if self.footprints is None:
            return np.broadcast_to(self.kernel, (columns.size, *self.kernel.shape))
        return self.footprints.kernels_at(row, columns)

    @property
    def axes(self) -> tuple[BoxMeans, BoxMeans]:
        """The windows along columns and along rows of the frame."""
        return self.vertical, self.horizontal

    def shortened(self, shape: tuple[int, int], before: tuple[int, int] = (0, 0)) -> SlidingType:
        """Return the same type on a smaller frame with the same edges, with the kernels of a part of the whole one."""
        vertical, horizontal = (means.shortened(*each) for means, *each in zip(self.axes, shape, before, strict=True))
        return SlidingType(vertical, horizontal, self.footprints)

    @cached_property
    def information(self) -> FloatArray:
        """H^T H as a dense matrix, (N, N), of a small frame."""
        if self.footprints is None:
            return np.asarray(np.kron(self.vertical.gram.toarray(), self.horizontal.gram.toarray()), dtype=np.float64)
        rows, columns, places = self.vertical.size, self.horizontal.size, self.horizontal.places[:, None]
        read = np.zeros((self.vertical.count, self.horizontal.count, rows, columns))
        for number, middle in enumerate(self.vertical.middles):
            top = self.vertical.first + number
            seen = slice(max(top, 0), min(top + self.vertical.width, rows))
            kernels = self.footprints.kernels_at(middle, self.horizontal.middles)[:, seen.start - top : seen.stop - top]
            inside = np.pad(kernels, ((0, 0), (0, 0), (0, 1)))
            read[number, :, seen] = np.take_along_axis(inside, places, axis=2)
        matrix = read.reshape(-1, rows * columns)
        return matrix.T @ matrix


@dataclass(frozen=True)
class SlidingCamera:
    """K of a shift-invariant camera: its lens types, their weights 1 / variance, and the prior.

    prior : 1 / P0 of independent pixels, or 1 / its spectrum, (rows, columns), under the DCT-II
    """

    types: tuple[SlidingType, ...]
    weights: tuple[float, ...]
    prior: float | FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frame."""
        return self.types[0].vertical.size, self.types[0].horizontal.size

    @property
    def is_sharp(self) -> bool:
        """True if all readings are means over boxes."""
        return all(each.footprints is None for each in self.types)

    def widest(self, axis: int) -> int:
        """Return the largest width of a window along an axis."""
        return max(each.axes[axis].width for each in self.types)


def is_sliding(observation: Observation, types: tuple[LensType, ...]) -> bool:
    """Return True if H consists of one box or kernel for each lens type that is shift-invariant."""
    return len(observation.parts) == len(types) and all(lens_type.is_sliding for lens_type in types)


def sliding_camera(
    observation: Observation, lens_types: tuple[LensType, ...], weights: tuple[float, ...], prior: float | FloatArray
) -> SlidingCamera:
    """Return the shift-invariant camera that an H is like: lens types without kernels average over boxes."""
    kernels = {part.places.lens_type: part for part in observation.parts if isinstance(part, KernelFootprints)}
    types: list[SlidingType] = []
    for lens_type in lens_types:
        part = kernels.get(lens_type)
        beside = 0 if part is None else part.places.margin
        spans = zip(lens_type.origin, lens_type.span, observation.shape, strict=True)
        axes = [
            BoxMeans(int(lens_type.ratio) + 2 * beside, int(first) - beside, int(first + span) + beside, size)
            for first, span, size in spans
        ]
        types.append(SlidingType(axes[0], axes[1], part))
    return SlidingCamera(tuple(types), weights, prior)
