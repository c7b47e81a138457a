"""Posterior variances far from the edges where noise is nearly even: the transfer function, and a local correction.

Let C = K^-1 for the mean weight w of each lens type, let (1 + d_i) w be the weight of measurement i, and

    p_ij = w (C h_i)_j^2 / C_jj

its share in the variance of pixel j. Far from the edges shares do not depend on the place, and add up to 1 less what
the prior brings. The diagonal of K^-1 is convex in the weights, and weights other than the best do no better, so that

    1 - sum of p d  <=  variance / C_jj  <=  1 - sum of p d / (1 + d).

The value 1 / (1 + sum of p d) lies between these, whose distance is the sum of p d^2 / (1 + d).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.processors import processors
from ommatid.scenes.camera import Camera

from .preconditioner import Preconditioner
from .stencil import box_image
from .variance_map import interior_variance

GRID = 128  # pixels of the periodic frame on which shares are computed
REACH = 32  # pixels beyond which a measurement has no share
SLAB = 480  # rows that are transformed together
LARGEST_GAP = 1e-3  # between the two bounds of a variance, relative


@dataclass(frozen=True)
class NearlyEven:
    """The interior of a frame whose lens types are shift-invariant, with mean weights as `system` has them."""

    camera: Camera
    system: Preconditioner

    def variances(self, weights: FloatArray) -> FloatArray:
        """Return the variances for weights, (M,), near the means: (rows, columns)."""
        variance = interior_variance(self.system)
        return np.asarray(variance / (1 + self._average(weights, lambda excess: excess)))

    def gap(self, weights: FloatArray) -> FloatArray:
        """Return the distance between the bounds of each variance, relative: (rows, columns)."""
        return self._average(weights, lambda excess: np.square(excess) / np.maximum(1 + excess, np.finfo(float).tiny))

    def _average(self, weights: FloatArray, law: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the sum over all measurements of p times `law` of d, for every pixel: (rows, columns)."""
        rows, columns = self.camera.shape
        images: list[FloatArray] = []
        for lens_type, part, mean in zip(
            self.camera.types, self.camera.type_slices(), self.system.weights, strict=True
        ):
            boxes = law(box_image(lens_type, weights[part]) / mean - 1)
            placed = np.zeros((rows + 2 * REACH, columns + 2 * REACH))
            top, left = (int(first) + REACH for first in lens_type.origin)
            placed[top : top + boxes.shape[0], left : left + boxes.shape[1]] = boxes
            images.append(placed)
        return self._convolved(images)

    def _convolved(self, images: list[FloatArray]) -> FloatArray:
        """Return the sum of the convolutions of padded images with their shares, by slabs of rows."""
        rows, columns = self.camera.shape
        high = min(SLAB, rows) + 2 * REACH
        shape = fft.next_fast_len(high, real=True), fft.next_fast_len(columns + 2 * REACH, real=True)
        kernels = [fft.rfft2(np.asarray(share), s=shape) for share in self._shares()]
        result = np.empty((rows, columns))
        for top in range(0, rows, SLAB):
            total = np.zeros((shape[0], shape[1] // 2 + 1), dtype=np.complex128)
            for image, kernel in zip(images, kernels, strict=True):
                total += np.asarray(fft.rfft2(image[top : top + high], s=shape, workers=processors())) * kernel
            sums = np.asarray(fft.irfft2(total, s=shape, workers=processors(), overwrite_x=True))
            part = result[top : top + SLAB]
            part[:] = sums[2 * REACH : 2 * REACH + part.shape[0], 2 * REACH : 2 * REACH + columns]
        return result

    def _shares(self) -> list[FloatArray]:
        """Return p of each type by the distance of the pixel from the first one of the box, from -REACH to REACH."""
        boxes: list[FloatArray] = []
        for vertical, horizontal in self.system.types:
            axes = [
                np.repeat([1 / means.width, 0.0], [means.width, GRID - means.width]) for means in (vertical, horizontal)
            ]
            boxes.append(np.outer(*axes))
        transfer = [np.asarray(fft.fft2(box)) for box in boxes]
        spectrum = float(np.asarray(self.system.prior)) + sum(
            weight * np.square(np.abs(each)) for weight, each in zip(self.system.weights, transfer, strict=True)
        )
        variance = float(np.mean(1 / spectrum))
        near = np.arange(-REACH, REACH + 1)
        responses = [np.asarray(fft.ifft2(each / spectrum)).real[np.ix_(near, near)] for each in transfer]
        return [
            weight * np.square(response) / variance
            for weight, response in zip(self.system.weights, responses, strict=True)
        ]
