"""The compiled loop of `ray_transport`, from the rays of a pixel, in any order, to entries of its row of H."""

# pyright: basic
from __future__ import annotations

import numpy as np

from ommatid.runtime.library_caches import compiled


@compiled
def sums_by_texel(texels, weights):
    """Sum the weights, (P, S), by texel for every pixel, without texels below 0: counts (P,), texels and sums.

    Texels rise within a pixel. A pixel sees few of them again and again, so each ray is looked up by bisection among
    the previous ones.
    """
    pixels, samples = texels.shape
    counts = np.zeros(pixels, dtype=np.int64)
    known = np.empty(texels.size, dtype=np.int64)
    sums = np.empty(texels.size, dtype=np.float64)
    start = 0
    for pixel in range(pixels):
        stop = start
        for sample in range(samples):
            texel = texels[pixel, sample]
            if texel < 0 or weights[pixel, sample] == 0.0:
                continue
            low, high = start, stop
            while low < high:
                middle = (low + high) // 2
                if known[middle] < texel:
                    low = middle + 1
                else:
                    high = middle
            if low == stop or known[low] != texel:
                for index in range(stop, low, -1):
                    known[index] = known[index - 1]
                    sums[index] = sums[index - 1]
                known[low] = texel
                sums[low] = 0.0
                stop += 1
            sums[low] += weights[pixel, sample]
        counts[pixel] = stop - start
        start = stop
    return counts, known[:start].copy(), sums[:start].copy()
