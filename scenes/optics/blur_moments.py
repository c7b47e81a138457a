"""Moments of the random displacement of rays on the target by defocus and by diffraction.

Lengths are pixels of f. All displacements are isotropic: a point of a disk, with a weight that depends on the radius, a
point of the Airy pattern, or the sum of the two. The angle is integrated in closed form, the radius by Gauss-Legendre
quadrature between all kinks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.polynomial import legendre

from ommatid.runtime.arrays import FloatArray, IntArray

TAIL = (
    0.005  # share of the Airy pattern that is truncated; it falls as 2 / (pi v), so half of it needs twice the radius
)
QUANTILES = 2**16  # steps of the table of radii, each less than a ring of the Airy pattern
NODES = 24  # per panel, over which the argument of the Airy pattern grows by 4; the error is below J_24(4), 1e-17
PAIRS_AT_ONCE = 256


def encircled(v: FloatArray) -> FloatArray:
    """Share of the whole Airy pattern within v (Rayleigh): 1 - J0(v)^2 - J1(v)^2."""
    from scipy.special import j0, j1

    return 1 - j0(v) ** 2 - j1(v) ** 2


@cache
def airy_end() -> float:
    """v where the Airy pattern is truncated, so that a share TAIL lies outside."""
    from scipy.optimize import brentq

    return float(brentq(lambda v: float(encircled(np.array(v))) - (1 - TAIL), 1.0, 4 / (np.pi * TAIL), xtol=1e-12))


@cache
def quantiles() -> FloatArray:
    """v that encircle the shares (0, 1/n, ... 1)^2 of the truncated Airy pattern: (n + 1,), n = QUANTILES."""
    v = np.linspace(0.0, airy_end(), 2 * QUANTILES + 1)
    root = np.sqrt(encircled(v) / (1 - TAIL))
    table = np.interp(np.linspace(0.0, 1.0, QUANTILES + 1), root, v)
    table.setflags(write=False)
    return table


@dataclass(frozen=True)
class _RadialDensity:
    """Probability density of the length of a displacement, analytic between `breaks`, (n + 1,)."""

    breaks: FloatArray
    density: Callable[[FloatArray], FloatArray]


def _disk(disk: float, weight: float) -> _RadialDensity:
    radius = disk / 2
    return _RadialDensity(
        np.array([0.0, radius]), lambda r: 2 * r / radius**2 * (1 + weight) / (1 + weight * (r / radius) ** 2) ** 2
    )


def _airy(airy: float) -> _RadialDensity:
    from scipy.special import j1

    end = airy * airy_end()

    def density(r: FloatArray) -> FloatArray:
        v = np.maximum(r / airy, np.finfo(float).tiny)
        return 2 * j1(v) ** 2 / (v * airy * (1 - TAIL))

    return _RadialDensity(np.linspace(0.0, end, ceil(airy_end() / 4) + 1), density)


def _sum(disk: float, airy: float, weight: float) -> _RadialDensity:
    """Density of the sum of a point of the disk and one of the Airy pattern, as a polynomial in each panel.

    At the radius r the density is 2 r / R^2 times the integral over the Airy radius q of its density and of the share
    of the circle of radius q around r that lies in the disk of radius R, weighted.
    """
    radius, pattern = disk / 2, _airy(airy)
    end = float(pattern.breaks[-1])
    corner = [0.0, *([end - radius] if end > radius else []), end + radius]
    parts = [np.linspace(a, b, ceil((b - a) / (4 * airy)) + 1) for a, b in pairwise(corner)]
    breaks = np.unique(np.concatenate(parts))
    nodes = 40 + ceil(4 * min(radius, end) / airy)  # enough for all rings of the pattern

    def exact(r: FloatArray) -> FloatArray:
        near = np.minimum(np.abs(radius - r), end)
        far = np.minimum(radius + r, end)
        total = np.zeros_like(r)
        for low, high in ((np.zeros_like(r), np.where(r < radius, near, 0.0)), (near, far)):
            q, weights = _between(low, high, nodes)
            total += (weights * pattern.density(q) * _arc(r[:, None], q, radius, weight)).sum(axis=1)
        return 2 * r / radius**2 * total

    return _RadialDensity(breaks, _interpolated(breaks, exact))


def _arc(r: FloatArray, q: FloatArray, radius: float, weight: float) -> FloatArray:
    """Share of a circle of radius q in a disk of density (1 + w) / (1 + w s^2 / R^2)^2, r between their centres."""
    sine = np.sqrt(np.maximum((radius - r + q) * (radius + r - q), 0))  # of half the arc, times 2 sqrt(r q)
    cosine = np.sqrt(np.maximum((r + q - radius) * (r + q + radius), 0))
    half = np.arctan2(sine, cosine)
    if weight == 0:
        return half * 2 / np.pi
    # The integral of (mean - swing cos a)^-2; least and most, mean -+ swing, are computed without cancellation.
    least, most = 1 + weight * ((r - q) / radius) ** 2, 1 + weight * ((r + q) / radius) ** 2
    mean, swing, root = (most + least) / 2, (most - least) / 2, np.sqrt(most * least)
    turned = 2 * np.arctan2(np.sqrt(most) * np.sin(half), np.sqrt(least) * np.cos(half)) / root
    ends = swing * np.sin(2 * half) / (least + 2 * swing * np.sin(half) ** 2)
    return (1 + weight) / np.pi * (ends + mean * turned) / root**2


def moments(positions: FloatArray, disk: float, airy: float, weight: float) -> tuple[FloatArray, FloatArray]:
    """P(x) = E (dx - x)+, (n,), and F(y, x) = E (dy - y)+ (dx - x)+, (n, n), at `positions` >= 0.

    disk, airy, weight : of the displacement, as in `blur.Blur`; disk and airy are not both 0
    """
    return _expect(_density_of(disk, airy, weight), positions, _past, _past_both, symmetric=True)


def slopes(positions: FloatArray, disk: float, airy: float, weight: float) -> tuple[FloatArray, FloatArray]:
    """The derivatives of P(x) by x, (n,), and of F(y, x) by y, (n, n); parameters as of `moments`."""
    return _expect(_density_of(disk, airy, weight), positions, _slope_past, _slope_past_both, symmetric=False)


@lru_cache(maxsize=4)
def _density_of(disk: float, airy: float, weight: float) -> _RadialDensity:
    return _disk(disk, weight) if airy == 0 else _sum(disk, airy, weight) if disk else _airy(airy)


def _expect(
    radial: _RadialDensity,
    positions: FloatArray,
    single: Callable[..., FloatArray],
    both: Callable[..., FloatArray],
    symmetric: bool,
) -> tuple[FloatArray, FloatArray]:
    """Means of single(r, x), which is 0 for r < x, and of both(r, y, x), which is 0 for r^2 < x^2 + y^2.

    symmetric : True if both(r, y, x) equals both(r, x, y)
    """
    line, plane = np.zeros(positions.size), np.zeros((positions.size, positions.size))
    inside = np.flatnonzero(positions < radial.breaks[-1])
    near = positions[inside]
    line[inside] = _mean(radial, near, near, lambda r, at: single(r, near[at, None]))
    pairs = np.tril(np.ones((inside.size, inside.size))) if symmetric else np.ones((inside.size, inside.size))
    rows, columns = (inside[indices] for indices in pairs.nonzero())
    y, x = positions[rows], positions[columns]
    lit = np.hypot(y, x) < radial.breaks[-1]
    rows, columns, y, x = rows[lit], columns[lit], y[lit], x[lit]
    means = _mean(radial, np.hypot(y, x), np.maximum(y, x), lambda r, at: both(r, y[at, None], x[at, None]))
    plane[rows, columns] = means
    if symmetric:
        plane[columns, rows] = means
    return line, plane


def _past(r: FloatArray, x: FloatArray) -> FloatArray:
    """Mean of (r cos a - x)+ over the angle, for r >= x >= 0."""
    return (_side(r, x) - x * np.arccos(np.minimum(x / r, 1))) / np.pi


def _past_both(r: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Mean of (r sin a - y)+ (r cos a - x)+ over the angle, for r^2 >= x^2 + y^2."""
    turned = x * y * _angle(r, y, x)
    return ((r**2 + x**2 + y**2) / 2 - y * _side(r, x) - x * _side(r, y) + turned) / (2 * np.pi)


def _slope_past(r: FloatArray, x: FloatArray) -> FloatArray:
    return -np.arccos(np.minimum(x / r, 1)) / np.pi


def _slope_past_both(r: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    return (y - _side(r, x) + x * _angle(r, y, x)) / (2 * np.pi)


def _angle(r: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    return np.arccos(np.minimum(x / r, 1)) - np.arcsin(np.minimum(y / r, 1))


def _side(r: FloatArray, x: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum((r - x) * (r + x), 0))


def _mean(
    radial: _RadialDensity, first: FloatArray, root: FloatArray, ring: Callable[[FloatArray, IntArray], FloatArray]
) -> FloatArray:
    """Mean over the lengths r > first, (n,), of ring(r, indices of the positions), analytic in sqrt(r - root): (n,).

    The panel of `first` and the next are integrated together, in terms of that square root; all positions share the
    nodes beyond, so that their errors cancel in differences.
    """
    breaks = radial.breaks
    panel = np.minimum(
        np.searchsorted(breaks, first, side="right") + 1, breaks.size - 1
    )  # first panel with shared nodes
    nodes, weights = _panels(breaks)
    shared = weights * radial.density(nodes)
    x, w = legendre.leggauss(2 * NODES)
    means = np.zeros(first.size)
    for begin in range(0, first.size, PAIRS_AT_ONCE):
        at = np.arange(begin, min(begin + PAIRS_AT_ONCE, first.size))
        start, end = np.sqrt(first[at] - root[at])[:, None], np.sqrt(breaks[panel[at]] - root[at])[:, None]
        s = start + (end - start) * (1 + x) / 2
        r = root[at, None] + s**2
        means[at] = ((end - start) * w * s * radial.density(r) * ring(r, at)).sum(axis=1)
        later = slice(NODES * int(panel[at].min()), None)
        begun = np.arange(nodes.size)[later] >= NODES * panel[at][:, None]
        means[at] += np.where(begun, ring(np.broadcast_to(nodes[later], begun.shape), at), 0.0) @ shared[later]
    return means


def _panels(breaks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights of all panels in turn: (NODES times panels,) each."""
    x, w = legendre.leggauss(NODES)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel()


def _between(low: FloatArray, high: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights from low to high, (n,) each, for square-root behaviour at both ends: (n, count) each."""
    x, w = legendre.leggauss(count)
    angle = np.pi / 2 * (1 + x)
    half = (high - low)[:, None] / 2
    return low[:, None] + 2 * half * np.sin(angle / 2) ** 2, half * (np.pi / 2 * w * np.sin(angle))


def _interpolated(breaks: FloatArray, exact: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """The polynomials, one per panel, that agree with `exact` at the panel's nodes."""
    x, w = legendre.leggauss(NODES)
    order = np.arange(NODES)
    project = (legendre.legvander(x, NODES - 1) * w[:, None] * (order + 0.5)).T
    nodes, _ = _panels(breaks)
    terms = np.stack([project @ exact(panel) for panel in nodes.reshape(-1, NODES)], axis=-1)

    def value(r: FloatArray) -> FloatArray:
        panel = np.clip(np.searchsorted(breaks, r, side="right") - 1, 0, breaks.size - 2)
        inside = 2 * (r - breaks[panel]) / np.diff(breaks)[panel] - 1
        return np.asarray(legendre.legval(inside, terms[:, panel], tensor=False), dtype=np.float64)

    return value
