"""Kernels of blurred lens types as designed: the rows of H as polynomials of the field.

Rows are computed at a chart of field positions, nodes of Gauss and Legendre in a quadrant. A lens is round, so that the
other quadrants mirror it. Least squares give each cell's polynomial of the lowest degree that serves, and the cells
vary together, so that a few kernels are enough. Distortion moves a footprint within its kernel: the polynomials hold
displacements of up to about a pixel of f, and what they do not hold keeps its entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import ceil

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory

from ..camera import Camera
from ..fitted.kernel_shapes import KernelShapes
from ..fitted.kernels import KernelFootprints, KernelPlaces, basis, terms
from ..lens_type import LensType
from .field import light_reach
from .lens_matrix import Bands, edges_at, matrix, optics_by_band, row_at

# Nodes along a side of a quadrant, and degrees for them.
CHARTS = {1: (0, 1), 3: (2, 4), 5: (6,), 7: (8, 10), 12: (12, 14, 16)}
HIGHEST = 16
BETWEEN = 2, 4  # nodes along a side, those of no chart, at which polynomials of the first chart and of others are tried
TOLERANCE = 1e-3  # error of an entry, relative to the largest of its row, with which a degree is enough,
MOST = 3e-3  # and with which the highest is: where light begins to be cut off by a rim, polynomials serve less
SHARE = 0.5  # of it that leaving out components may take
COPIES = 12  # arrays of the chart's size that are held at once


@dataclass(frozen=True, eq=False)
class _FieldRows:
    """Rows of H of a lens type at any position of its field, on W x W pixels of f."""

    places: KernelPlaces
    fields: Bands

    def at(self, u: float, v: float) -> FloatArray:
        """Return the row at (u, v) of the field: (W, W)."""
        camera, lens_type, wide = self.places.camera, self.places.lens_type, self.places.width
        down, across = beside = np.array([u, v]) * self.places.scale
        pitch = camera.target_pitch * camera.optical_magnification(lens_type)  # on the sensor, per pixel of f
        place = float(across * pitch), float(down * pitch)
        return row_at(camera, lens_type, self.fields, place, wide / 2 - beside, (wide, wide))

    def chart(self, nodes: FloatArray, *, ends: bool) -> tuple[FloatArray, FloatArray]:
        """Return pairs of u and v in a quadrant, (pairs, 2), and the rows there, (pairs, W^2).

        nodes : in the unit interval;  ends : with the field's edges, else on the whole of it
        """
        axes = [np.append(nodes[nodes < last], last) if ends else last * nodes for last in self.places.extent]
        known, is_square = dict[tuple[float, float], FloatArray](), len(set(self.places.lens_type.open)) == 1
        for u, v in product(*(axis.tolist() for axis in axes)):
            known[u, v] = known[v, u].T if is_square and (v, u) in known else self.at(u, v)
        return np.array(list(known)), np.stack([row.ravel() for row in known.values()])


def _nodes(count: int) -> FloatArray:
    """Return Gauss and Legendre's nodes in the unit interval."""
    return (1 + np.polynomial.legendre.leggauss(count)[0]) / 2


@lru_cache(maxsize=16)
def kernels(camera: Camera, lens_type: LensType) -> KernelFootprints:
    """H of a blurred lens type as designed, as of `lens_matrix.matrix`, by a few kernels.

    Expects a camera for which `Camera.has_kernel` is true. Raises InputError if surfaces form no image, if kernels do
    not hold the variation over the field to the tolerance, and as `light_reach` does.
    """
    fields = optics_by_band(camera, lens_type)
    rows = _FieldRows(KernelPlaces(camera, lens_type, _margin(camera, lens_type, fields)), fields)
    cells = rows.places.width**2
    check_memory(
        COPIES * 8 * cells * (1 + max(CHARTS)) ** 2, f"the kernels of lens type {lens_type.name}", "crop the target"
    )
    worst, tried = np.inf, dict[int, tuple[FloatArray, FloatArray]]()
    for count, degrees in CHARTS.items():
        between = BETWEEN[count > min(CHARTS)]
        if between not in tried:
            tried[between] = rows.chart(_nodes(between), ends=False)
        field, entries = rows.chart(_nodes(count), ends=True)
        scale = float(entries[0].max())
        for degree in degrees:
            polynomials = _fitted(field, entries, rows.places.width, degree)
            known = (field, entries), tried[between]
            worst = max(float(np.abs(basis(at, degree) @ polynomials - every).max()) for at, every in known) / scale
            if worst <= TOLERANCE * (1 - SHARE) or (degree == HIGHEST and worst <= MOST):
                return _components(rows.places, degree, polynomials, field, scale).times(float(lens_type.light))
    raise InputError(
        f"camera.lens.{lens_type.name}: its images are displaced and blurred over the field by more than kernels hold:"
        f" an entry of H would be wrong by {worst:.2g} of the largest, expected at most {MOST:g}"
    )


def blurred_matrix(camera: Camera, lens_type: LensType) -> sparse.csr_array:
    """Return H of a blurred lens type as designed: (its measurements, N). Raises as `lens_matrix.matrix` does."""
    if lens_type.optics.surfaces is None and camera.has_kernel(lens_type):
        return kernels(camera, lens_type).to_sparse()
    return matrix(camera, lens_type)


def _margin(camera: Camera, lens_type: LensType, fields: Bands) -> int:
    """Return by how many pixels of f light reaches beyond a footprint, distortion included."""
    places = KernelPlaces(camera, lens_type, 0)
    corner = np.array(places.extent) * places.scale
    x, y = (float(each) for each in corner[::-1] * camera.target_pitch * camera.optical_magnification(lens_type))
    halves = np.outer([float(side) / 2 for side in lens_type.footprint], [-1.0, 1.0])
    edges = (np.sort(edges_at(camera, field, lens_type, np.array(x), np.array(y)), axis=1) for field, _ in fields)
    moved = max(float(np.abs(each - corner[:, None] - halves).max()) for each in edges)
    return ceil(light_reach(camera, lens_type) + moved) + 1


def _fitted(field: FloatArray, entries: FloatArray, wide: int, degree: int) -> FloatArray:
    """Return the polynomials of all cells, (P, C), by least squares over a quadrant's rows, (n, C), and their images.

    A mirrored position shows the mirrored row. The even and the odd parts of the rows are polynomials of their own.
    """
    every = basis(field, degree)
    grid = entries.reshape(-1, wide, wide)
    found = np.zeros((every.shape[1], wide, wide))
    for down, across in product((0, 1), repeat=2):
        own = [number for number, (a, b) in enumerate(terms(degree)) if (a % 2, b % 2) == (down, across)]
        part = (grid + (-1) ** down * grid[:, ::-1]) / 2
        part = (part + (-1) ** across * part[:, :, ::-1]) / 2
        solved = np.linalg.lstsq(every[:, own], part.reshape(len(field), -1), rcond=None)[0]
        found[own] = solved.reshape(-1, wide, wide)
    return found.reshape(every.shape[1], -1)


def _components(
    places: KernelPlaces, degree: int, polynomials: FloatArray, field: FloatArray, scale: float
) -> KernelFootprints:
    """Return the mean kernel and as few components of the variation as hold it. field : (n, 2) of a quadrant"""
    values = np.concatenate([basis(field * signs, degree) for signs in product((1.0, -1.0), repeat=2)])
    values[:, 0] = 0.0
    triangle = np.linalg.cholesky(values[:, 1:].T @ values[:, 1:] / len(values))
    strong = triangle.T @ polynomials[1:]
    vectors = np.linalg.eigh(strong @ strong.T)[1][:, ::-1]
    orthonormal = np.linalg.solve(triangle, values[:, 1:].T).T
    left, kept = orthonormal @ strong, 0
    while kept < vectors.shape[1] and max(left.max(), -left.min()) > TOLERANCE * SHARE * scale:
        left -= np.outer(orthonormal @ vectors[:, kept], vectors[:, kept] @ strong)
        kept += 1
    shares = np.linalg.solve(triangle.T, vectors[:, :kept]).T
    coefficients = np.zeros((1 + kept, len(polynomials)))
    coefficients[0, 0] = 1.0
    coefficients[1:, 1:] = shares
    shown = np.concatenate([polynomials[:1], vectors[:, :kept].T @ strong])
    shapes = KernelShapes.dense(shown.reshape(-1, places.width, places.width))
    return KernelFootprints(places, degree, shapes, coefficients, np.zeros((0, 0, len(polynomials))))
