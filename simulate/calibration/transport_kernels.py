"""The loop of `transport`, compiled: the rays of a pixel, in any order, as entries of its row of H."""

# pyright: basic
from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def collected(texels, weights):
    """Sums of weights by texel for every pixel: (P, S) each, texels below 0 left out, to counts (P,), texels and sums.

    Texels rise within a pixel. A pixel sees few of them and the same ones again and again, so each ray is looked up
    among those already met.
    """
    pixels, samples = texels.shape
    counts = np.zeros(pixels, dtype=np.int64)
    found = np.empty(texels.size, dtype=np.int64)
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
                if found[middle] < texel:
                    low = middle + 1
                else:
                    high = middle
            if low == stop or found[low] != texel:
                for place in range(stop, low, -1):
                    found[place] = found[place - 1]
                    sums[place] = sums[place - 1]
                found[low] = texel
                sums[low] = 0.0
                stop += 1
            sums[low] += weights[pixel, sample]
        counts[pixel] = stop - start
        start = stop
    return counts, found[:start].copy(), sums[:start].copy()
