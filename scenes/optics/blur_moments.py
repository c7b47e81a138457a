"""Random displacements of rays on the target, by defocus and by diffraction, and the moments that blur a footprint.

Lengths are pixels of f. All displacements are isotropic: a point of a disk, weighted by its radius, a point of the Airy
pattern, or the sum of the two. The angle is integrated in closed form, the radius by Gauss-Legendre quadrature
between all kinks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Whole = NDArray[np.int64]

TAIL = 0.005  # share of the Airy pattern that is cut off; it falls as 2 / (pi v): half of it reaches twice as far
QUANTILES = 2**16  # steps of the table of radii: less than a ring of the Airy pattern each, out to the last one
NODES = 24  # of a panel in which the Airy pattern turns by 4 radians; the error is below J_24(4), 1e-17
PAIRS_AT_ONCE = 256


def encircled(v: Numbers) -> Numbers:
    """Share of the whole Airy pattern within v (Rayleigh): 1 - J0(v)^2 - J1(v)^2."""
    from scipy.special import j0, j1

    return 1 - j0(v) ** 2 - j1(v) ** 2


@cache
def airy_end() -> float:
    """v where the Airy pattern is cut off, so that a share TAIL lies outside."""
    from scipy.optimize import brentq

    return float(brentq(lambda v: float(encircled(np.array(v))) - (1 - TAIL), 1.0, 4 / (np.pi * TAIL), xtol=1e-12))


@cache
def quantiles() -> Numbers:
    """v that encircle the shares (0, 1/n, ... 1)^2 of the Airy pattern, cut off: (n + 1,), n = QUANTILES."""
    v = np.linspace(0.0, airy_end(), 2 * QUANTILES + 1)
    root = np.sqrt(encircled(v) / (1 - TAIL))
    found = np.interp(np.linspace(0.0, 1.0, QUANTILES + 1), root, v)
    found.setflags(write=False)
    return found


@dataclass(frozen=True)
class _Distances:
    """How far displacements reach: a probability density of the radius, analytic between `breaks`, (n + 1,)."""

    breaks: Numbers
    density: Callable[[Numbers], Numbers]


def _disk(disk: float, weight: float) -> _Distances:
    radius = disk / 2
    return _Distances(
        np.array([0.0, radius]), lambda r: 2 * r / radius**2 * (1 + weight) / (1 + weight * (r / radius) ** 2) ** 2
    )


def _airy(airy: float) -> _Distances:
    from scipy.special import j1

    end = airy * airy_end()

    def density(r: Numbers) -> Numbers:
        v = np.maximum(r / airy, np.finfo(float).tiny)
        return 2 * j1(v) ** 2 / (v * airy * (1 - TAIL))

    return _Distances(np.linspace(0.0, end, ceil(airy_end() / 4) + 1), density)


def _sum(disk: float, airy: float, weight: float) -> _Distances:
    """Of a point of the disk plus one of the Airy pattern, as a polynomial in each panel.

    At the radius r the density is 2 r / R^2 times the integral over the Airy radius q of its density and of the share
    of the circle of radius q around r that lies in the disk of radius R, weighted.
    """
    radius, pattern = disk / 2, _airy(airy)
    end = float(pattern.breaks[-1])
    corner = [0.0, *([end - radius] if end > radius else []), end + radius]
    parts = [np.linspace(a, b, ceil((b - a) / (4 * airy)) + 1) for a, b in pairwise(corner)]
    breaks = np.unique(np.concatenate(parts))
    turns = 40 + ceil(4 * min(radius, end) / airy)

    def exact(r: Numbers) -> Numbers:
        near = np.minimum(np.abs(radius - r), end)
        far = np.minimum(radius + r, end)
        total = np.zeros_like(r)
        for low, high in ((np.zeros_like(r), np.where(r < radius, near, 0.0)), (near, far)):
            q, weights = _between(low, high, turns)
            total += (weights * pattern.density(q) * _arc(r[:, None], q, radius, weight)).sum(axis=1)
        return 2 * r / radius**2 * total

    return _Distances(breaks, _interpolated(breaks, exact))


def _arc(r: Numbers, q: Numbers, radius: float, weight: float) -> Numbers:
    """Share of a circle of radius q in a disk, r from centre to centre, of density (1 + w) / (1 + w s^2 / R^2)^2."""
    sine = np.sqrt(np.maximum((radius - r + q) * (radius + r - q), 0))  # of half the arc, times 2 sqrt(r q)
    cosine = np.sqrt(np.maximum((r + q - radius) * (r + q + radius), 0))
    half = np.arctan2(sine, cosine)
    if weight == 0:
        return half * 2 / np.pi
    # The integral of (mean - swing cos a)^-2; the ends of its range, mean -+ swing, without cancellation.
    least, most = 1 + weight * ((r - q) / radius) ** 2, 1 + weight * ((r + q) / radius) ** 2
    mean, swing, slow = (most + least) / 2, (most - least) / 2, np.sqrt(most * least)
    turned = 2 * np.arctan2(np.sqrt(most) * np.sin(half), np.sqrt(least) * np.cos(half)) / slow
    ends = swing * np.sin(2 * half) / (least + 2 * swing * np.sin(half) ** 2)
    return (1 + weight) / np.pi * (ends + mean * turned) / slow**2


def moments(places: Numbers, disk: float, airy: float, weight: float) -> tuple[Numbers, Numbers]:
    """P(x) = E (dx - x)+, (n,), and F(y, x) = E (dy - y)+ (dx - x)+, (n, n), at `places` >= 0.

    disk, airy, weight : of the displacement, as in `blur.Blur`, not both of the first two 0
    """
    return _expect(_distances(disk, airy, weight), places, _past, _past_both, mirrored=True)


def slopes(places: Numbers, disk: float, airy: float, weight: float) -> tuple[Numbers, Numbers]:
    """The derivatives of P(x) by x and of F(y, x) by y, as `moments` gives P and F."""
    return _expect(_distances(disk, airy, weight), places, _slope_past, _slope_past_both, mirrored=False)


@lru_cache(maxsize=4)
def _distances(disk: float, airy: float, weight: float) -> _Distances:
    return _disk(disk, weight) if airy == 0 else _sum(disk, airy, weight) if disk else _airy(airy)


def _expect(
    distances: _Distances, places: Numbers, one: Callable[..., Numbers], both: Callable[..., Numbers], mirrored: bool
) -> tuple[Numbers, Numbers]:
    """Means of one(r, x), which vanishes for r < x, and of both(r, y, x), which vanishes for r^2 < x^2 + y^2.

    mirrored : whether both(r, y, x) is both(r, x, y)
    """
    line, plane = np.zeros(places.size), np.zeros((places.size, places.size))
    inside = np.flatnonzero(places < distances.breaks[-1])
    near = places[inside]
    line[inside] = _mean(distances, near, near, lambda r, at: one(r, near[at, None]))
    pairs = np.tril(np.ones((inside.size, inside.size))) if mirrored else np.ones((inside.size, inside.size))
    rows, columns = (inside[each] for each in pairs.nonzero())
    y, x = places[rows], places[columns]
    kept = np.hypot(y, x) < distances.breaks[-1]
    rows, columns, y, x = rows[kept], columns[kept], y[kept], x[kept]
    found = _mean(distances, np.hypot(y, x), np.maximum(y, x), lambda r, at: both(r, y[at, None], x[at, None]))
    plane[rows, columns] = found
    if mirrored:
        plane[columns, rows] = found
    return line, plane


def _past(r: Numbers, x: Numbers) -> Numbers:
    """Mean of (r cos a - x)+ over the angle, for r >= x >= 0."""
    return (_side(r, x) - x * np.arccos(np.minimum(x / r, 1))) / np.pi


def _past_both(r: Numbers, y: Numbers, x: Numbers) -> Numbers:
    """Mean of (r sin a - y)+ (r cos a - x)+ over the angle, for r^2 >= x^2 + y^2."""
    turned = x * y * _angle(r, y, x)
    return ((r**2 + x**2 + y**2) / 2 - y * _side(r, x) - x * _side(r, y) + turned) / (2 * np.pi)


def _slope_past(r: Numbers, x: Numbers) -> Numbers:
    return -np.arccos(np.minimum(x / r, 1)) / np.pi


def _slope_past_both(r: Numbers, y: Numbers, x: Numbers) -> Numbers:
    return (y - _side(r, x) + x * _angle(r, y, x)) / (2 * np.pi)


def _angle(r: Numbers, y: Numbers, x: Numbers) -> Numbers:
    return np.arccos(np.minimum(x / r, 1)) - np.arcsin(np.minimum(y / r, 1))


def _side(r: Numbers, x: Numbers) -> Numbers:
    return np.sqrt(np.maximum((r - x) * (r + x), 0))


def _mean(distances: _Distances, first: Numbers, root: Numbers, ring: Callable[[Numbers, Whole], Numbers]) -> Numbers:
    """Mean over the distances r > first, (n,), of ring(r, numbers of the places), analytic in the root of r - root.

    The panel of `first` and the next are one, in terms of that root; all places share the nodes beyond, so that what
    errors there are cancel in differences.
    """
    breaks = distances.breaks
    panel = np.minimum(np.searchsorted(breaks, first, side="right") + 1, breaks.size - 1)  # where sharing begins
    nodes, weights = _panels(breaks)
    shared = weights * distances.density(nodes)
    x, w = legendre.leggauss(2 * NODES)
    found = np.zeros(first.size)
    for begin in range(0, first.size, PAIRS_AT_ONCE):
        at = np.arange(begin, min(begin + PAIRS_AT_ONCE, first.size))
        start, end = np.sqrt(first[at] - root[at])[:, None], np.sqrt(breaks[panel[at]] - root[at])[:, None]
        s = start + (end - start) * (1 + x) / 2
        r = root[at, None] + s**2
        found[at] = ((end - start) * w * s * distances.density(r) * ring(r, at)).sum(axis=1)
        later = slice(NODES * int(panel[at].min()), None)
        begun = np.arange(nodes.size)[later] >= NODES * panel[at][:, None]
        found[at] += np.where(begun, ring(np.broadcast_to(nodes[later], begun.shape), at), 0.0) @ shared[later]
    return found


def _panels(breaks: Numbers) -> tuple[Numbers, Numbers]:
    """Gauss-Legendre nodes and weights of all panels, one after the other."""
    x, w = legendre.leggauss(NODES)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel()


def _between(low: Numbers, high: Numbers, count: int) -> tuple[Numbers, Numbers]:
    """Nodes and weights from low to high, (n,) each, for what behaves as a root at either end: (n, count) each."""
    x, w = legendre.leggauss(count)
    angle = np.pi / 2 * (1 + x)
    half = (high - low)[:, None] / 2
    return low[:, None] + 2 * half * np.sin(angle / 2) ** 2, half * (np.pi / 2 * w * np.sin(angle))


def _interpolated(breaks: Numbers, exact: Callable[[Numbers], Numbers]) -> Callable[[Numbers], Numbers]:
    """The function that agrees with `exact` at the nodes of every panel."""
    x, w = legendre.leggauss(NODES)
    order = np.arange(NODES)
    project = (legendre.legvander(x, NODES - 1) * w[:, None] * (order + 0.5)).T
    nodes, _ = _panels(breaks)
    terms = np.stack([project @ exact(each) for each in nodes.reshape(-1, NODES)], axis=-1)

    def value(r: Numbers) -> Numbers:
        panel = np.clip(np.searchsorted(breaks, r, side="right") - 1, 0, breaks.size - 2)
        inside = 2 * (r - breaks[panel]) / np.diff(breaks)[panel] - 1
        return np.asarray(legendre.legval(inside, terms[:, panel], tensor=False), dtype=np.float64)

    return value
