"""Moments of a random displacement of rays on the target, by defocus and by diffraction.

Lengths are pixels of f. All displacements are isotropic, with a `RadialDensity`. The angle is integrated in closed
form, the radius by Gauss-Legendre quadrature between all kinks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import legendre

from ommatid.runtime.arrays import FloatArray, IntArray

from .radial_density import NODES, RadialDensity, panel_nodes

PAIRS_AT_ONCE = 256


def moments(positions: FloatArray, radial: RadialDensity) -> tuple[FloatArray, FloatArray]:
    """P(x) = E (dx - x)+, (n,), and F(y, x) = E (dy - y)+ (dx - x)+, (n, n), at `positions` >= 0."""
    return _expect(radial, positions, _past, _past_both, symmetric=True)


def slopes(positions: FloatArray, radial: RadialDensity) -> tuple[FloatArray, FloatArray]:
    """The derivatives of P(x) by x, (n,), and of F(y, x) by y, (n, n); parameters as of `moments`."""
    return _expect(radial, positions, _slope_past, _slope_past_both, symmetric=False)


def _expect(
    radial: RadialDensity,
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
    radial: RadialDensity, first: FloatArray, root: FloatArray, ring: Callable[[FloatArray, IntArray], FloatArray]
) -> FloatArray:
    """Mean over the lengths r > first, (n,), of ring(r, indices of the positions), analytic in sqrt(r - root): (n,).

    The panel of `first` and the next are integrated together, in terms of that square root; all positions share the
    nodes beyond, so that their errors cancel in differences.
    """
    breaks = radial.breaks
    panel = np.minimum(
        np.searchsorted(breaks, first, side="right") + 1, breaks.size - 1
    )  # first panel with shared nodes
    nodes, weights = panel_nodes(breaks)
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
