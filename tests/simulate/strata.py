"""How far stratified samples may be from the law of their error, n^-3/4 for large n."""

from __future__ import annotations

from math import inf, log

from ommatid.scenes.camera import Camera


def corners(camera: Camera, fewest: int, most: int) -> float:
    """Return by how much a slope between two numbers of samples in a pass may differ from its limit of -3/4.

    Of s x s strata, 2 (m - 1) s lie along edges of pixels of f, of which (m - 1)^2 hold two at once, a corner. Their
    variance lies between none and twice that of two, so the error's square is C s^-3 (1 + c / s), |c| <= (m - 1) / 2.
    """
    c = float(max(lens_type.ratio for lens_type in camera.types) - 1) / 2
    sides = fewest**0.5, most**0.5
    if c >= sides[0] or fewest == most:
        return inf
    return 0.5 * log((1 - c / sides[1]) / (1 - c / sides[0])) / log(most / fewest)
