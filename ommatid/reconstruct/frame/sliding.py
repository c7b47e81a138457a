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
from ommatid.scenes.optics.boxes import Box


@dataclass(frozen=True)
class BoxMeans:
    """All windows of `width` neighbours on an axis of `size` pixels that begin at `first` and end before `end`."""

    width: int
    first: int
    end: int
    size: int

    @property
    def count(self) -> int:
        """Number of windows."""
        return self.end - self.first - self.width + 1

    def shortened(self, size: int) -> BoxMeans:
        """Return the windows of an axis of fewer pixels with the same ends."""
        return replace(self, end=size - (self.size - self.end), size=size)

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
    """The readings of a lens type: means over boxes, or correlations with `kernel`, (rows, columns) of a window."""

    vertical: BoxMeans
    horizontal: BoxMeans
    kernel: FloatArray | None = None

    @property
    def axes(self) -> tuple[BoxMeans, BoxMeans]:
        """The windows along columns and along rows of the frame."""
        return self.vertical, self.horizontal

    def shortened(self, shape: tuple[int, int]) -> SlidingType:
        """Return the same type on a smaller frame with the same edges."""
        vertical, horizontal = (means.shortened(size) for means, size in zip(self.axes, shape, strict=True))
        return SlidingType(vertical, horizontal, self.kernel)

    @cached_property
    def information(self) -> FloatArray:
        """H^T H as a dense matrix, (N, N), of a small frame."""
        if self.kernel is None:
            return np.asarray(np.kron(self.vertical.gram.toarray(), self.horizontal.gram.toarray()), dtype=np.float64)
        padded = np.pad(self.kernel, ((0, 1), (0, 1)))  # its last row and column stand for all pixels beside it
        across = self._places(self.horizontal)
        total = np.zeros((self.vertical.size * self.horizontal.size,) * 2)
        for down in self._places(self.vertical):
            read = padded[down][:, across].swapaxes(0, 1).reshape(self.horizontal.count, -1)
            total += read.T @ read
        return total

    def _places(self, windows: BoxMeans) -> IntArray:
        """Return the place of each pixel of an axis in each window, `width` beside it: (windows, size)."""
        place: IntArray = np.arange(windows.size) - (windows.first + np.arange(windows.count))[:, None]
        return np.where((place >= 0) & (place < windows.width), place, windows.width)


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
        return all(each.kernel is None for each in self.types)

    def widest(self, axis: int) -> int:
        """Return the largest width of a window along an axis."""
        return max(each.axes[axis].width for each in self.types)


def is_sliding(observation: Observation, types: tuple[LensType, ...]) -> bool:
    """Return True if H consists of one box or kernel for each lens type that is shift-invariant."""
    return len(observation.parts) == len(types) and all(lens_type.is_sliding for lens_type in types)


def sliding_camera(observation: Observation, weights: tuple[float, ...], prior: float | FloatArray) -> SlidingCamera:
    """Return the shift-invariant camera of an H by boxes and kernels. Raises ValueError for another H."""
    types: list[SlidingType] = []
    for part in observation.parts:
        if isinstance(part, Box) and part.lens_type.is_sliding:
            lens_type, ratio = part.lens_type, int(part.lens_type.ratio)
            spans = zip(lens_type.origin, lens_type.span, observation.shape, strict=True)
            axes = [BoxMeans(ratio, int(first), int(first + span), size) for first, span, size in spans]
            types.append(SlidingType(axes[0], axes[1]))
        elif isinstance(part, KernelFootprints) and part.places.lens_type.is_sliding:
            wide = part.places.width
            axes = [
                BoxMeans(wide, int(start.min()), int(start.max()) + wide, size)
                for start, size in zip(part.places.starts, observation.shape, strict=True)
            ]
            types.append(SlidingType(axes[0], axes[1], part.mean_kernel))
        else:
            raise ValueError("expected a lens type of m x m sub-imagers with step 1 and magnification 1/m")
    return SlidingCamera(tuple(types), weights, prior)
