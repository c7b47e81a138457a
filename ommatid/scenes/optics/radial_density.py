"""Radial densities of isotropic displacements of rays on the target, by defocus and by diffraction, and their moments.

Lengths are pixels of f. The length of a displacement is measured from the point that the ray of a pinhole meets.
Densities are one polynomial per panel, analytic within each; for moments the angle is integrated in closed form, the
radius by Gauss-Legendre quadrature between all kinks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.special import i0e

from ommatid.runtime.arrays import FloatArray, IntArray

from ..constants import DEVIATIONS

PANEL = 2.5  # standard deviations, at most, of a panel of what has a Gaussian displacement
NODES = 24  # per panel, over which the argument of a diffraction pattern grows by 4; the error is below J_24(4), 1e-17


@dataclass(frozen=True)
class RadialDensity:
    """Density of the length of a displacement per unit of length, analytic between `breaks`, (n + 1,).

    mass : its integral: 1 for a probability, less where rare far displacements are left out
    """

    breaks: FloatArray
    density: Callable[[FloatArray], FloatArray]
    mass: float = 1.0


class PanelPolynomials:
    """A function given at the nodes of all panels, (panels, NODES), as a polynomial in each panel."""

    def __init__(self, breaks: FloatArray, values: FloatArray) -> None:
        """Interpolate the values at the nodes of `panel_nodes(breaks)`."""
        x, w = legendre.leggauss(NODES)
        order = np.arange(NODES)
        project = (legendre.legvander(x, NODES - 1) * w[:, None] * (order + 0.5)).T
        self._breaks = breaks
        self._terms: FloatArray = project @ values.reshape(-1, NODES).T

    def __call__(self, r: FloatArray) -> FloatArray:
        """Evaluate at positions of any shape."""
        return self._evaluate(r, self._terms)

    def integral(self, r: FloatArray) -> FloatArray:
        """Evaluate the integral from the first break to each position."""
        half = np.diff(self._breaks) / 2
        terms = legendre.legint(self._terms, lbnd=-1, axis=0) * half
        before = np.concatenate([[0.0], np.cumsum(legendre.legval(1.0, terms))])
        return self._evaluate(r, terms) + before[self._panel(r)]

    def _panel(self, r: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        return np.clip(np.searchsorted(self._breaks, r, side="right") - 1, 0, self._breaks.size - 2)

    def _evaluate(self, r: FloatArray, terms: FloatArray) -> FloatArray:
        panel = self._panel(r)
        inside = 2 * (r - self._breaks[panel]) / np.diff(self._breaks)[panel] - 1
        return np.asarray(legendre.legval(inside, terms[:, panel], tensor=False), dtype=np.float64)


def panel_nodes(breaks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights of all panels in turn: (NODES times panels,) each."""
    x, w = legendre.leggauss(NODES)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel()


def disk_density(disk: float, weight: float) -> RadialDensity:
    """Density of a disk of diameter `disk` whose points have the weights (1 + weight u^2)^-2, u = 1 at its rim."""
    radius = disk / 2
    return RadialDensity(
        np.array([0.0, radius]), lambda r: 2 * r / radius**2 * (1 + weight) / (1 + weight * (r / radius) ** 2) ** 2
    )


def disk_slant(disk: float, weight: float) -> RadialDensity:
    """Density whose derivative along an axis is that of a disk times 2 u cos(angle) / (1 + weight u^2), u as there."""
    radius = disk / 2

    def density(r: FloatArray) -> FloatArray:
        square = (r / radius) ** 2
        fall = (1 - square) * (2 + weight * (1 + square)) / ((1 + weight * square) ** 2 * (1 + weight))
        return -r / radius * fall

    return RadialDensity(np.array([0.0, radius]), density, -radius / (2 * (1 + weight)))


def gaussian_density(sigma: float) -> RadialDensity:
    """Density of a displacement that has a normal distribution of deviation `sigma` along either axis."""
    breaks = _subdivided(np.array([0.0, DEVIATIONS * sigma]), PANEL * sigma)
    return RadialDensity(
        breaks, lambda r: r / sigma**2 * np.exp(-np.square(r / sigma) / 2), -np.expm1(-(DEVIATIONS**2) / 2)
    )


def diffused(radial: RadialDensity, sigma: float) -> RadialDensity:
    """Density of a displacement to which one is added whose density is `gaussian_density(sigma)`.

    From a point at the radius s the sum reaches the radius r with Rice's density, r / sigma^2 exp(-(r^2 + s^2) / 2
    sigma^2) I0(r s / sigma^2).
    """
    inner, outer = (
        _subdivided(np.append(radial.breaks, ends), PANEL * sigma)
        for ends in ([], [radial.breaks[-1] + DEVIATIONS * sigma])
    )
    (s, share), (r, weights) = panel_nodes(inner), panel_nodes(outer)
    share = share * radial.density(s)
    values = np.zeros(r.size)
    for first in range(0, r.size, NODES):
        at = r[first : first + NODES, None]
        near = slice(*np.searchsorted(s, [at.min() - 2 * DEVIATIONS * sigma, at.max() + 2 * DEVIATIONS * sigma]))
        rice = at / sigma**2 * np.exp(-np.square((at - s[near]) / sigma) / 2) * i0e(at * s[near] / sigma**2)
        values[first : first + NODES] = rice @ share[near]
    return RadialDensity(outer, PanelPolynomials(outer, values), float(weights @ values))


def _subdivided(breaks: FloatArray, widest: float) -> FloatArray:
    """Return breaks with more between them, so that no panel is wider."""
    counts = np.maximum(np.ceil(np.diff(breaks) / widest), 1).astype(np.int64)
    ends = zip(breaks[:-1], breaks[1:], counts, strict=True)
    parts: list[FloatArray] = [np.linspace(low, high, int(count), endpoint=False) for low, high, count in ends]
    return np.append(np.concatenate(parts), breaks[-1])


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
