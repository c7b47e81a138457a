"""Radial densities of isotropic displacements, as one polynomial per panel, and their Gauss-Legendre nodes.

The length of a displacement is measured from the point that the ray of a pinhole meets. Densities are analytic within
each panel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from ommatid.runtime.arrays import FloatArray

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
