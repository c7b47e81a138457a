"""H of a lens type with blur by learnt kernels: a point-spread function that varies smoothly over the field.

Row i of H in coordinates relative to the pixel's designed footprint, W x W pixels of f, is

    h_i = sum over q of c_q(u_i, v_i) Phi_q,

Phi_q the kernels that all sub-imagers of the lens type share, c_q polynomials of the position (u, v) of the footprint's
middle relative to the lens's axis, down and across in units of `scale` pixels of f. Windows and m are whole numbers, so
that one sampling of the kernels serves all pixels. Light beside the target is cut off at its edge.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import shortened_repr

from ..camera import Camera
from ..lens_type import LensType
from ..optics.boxes import by_rows
from .wide_correlation import WideCorrelation

PIXELS_AT_ONCE = 2**14
MOST_DEGREE = 50  # of polynomials in a file
WIDE = 24  # pixels of f of the narrowest kernels that Fourier transforms apply faster than sums

_Tables = tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray, IntArray, int, IntArray]


def terms(degree: int) -> list[tuple[int, int]]:
    """Return the exponents (a, b) of the terms P_a(u) P_b(v) of a polynomial, by rising degree."""
    return [(total - b, b) for total in range(degree + 1) for b in range(total + 1)]


def basis(field: FloatArray, degree: int) -> FloatArray:
    """Return all terms at positions (u, v), (n, 2): (n, P). P_a are Legendre's polynomials."""
    u, v = (legendre.legvander(field[:, axis], degree) for axis in (0, 1))
    return np.stack([u[:, a] * v[:, b] for a, b in terms(degree)], axis=1)


@dataclass(frozen=True, eq=False)
class KernelPlaces:
    """Where the kernels of a lens type lie on f and on the field.

    margin : pixels of f by which the kernels reach beyond the footprint on every side
    scale : pixels of f between the lens's axis and the most distant footprint, along an axis
    """

    camera: Camera
    lens_type: LensType
    margin: int

    @property
    def width(self) -> int:
        """W."""
        return int(self.lens_type.ratio) + 2 * self.margin

    @cached_property
    def starts(self) -> tuple[IntArray, IntArray]:
        """First row of f of the kernels of each sensor row, (K n_r,), and the same across, (L n_c,)."""
        down, across = (
            np.array([int(start) for start in self.lens_type.starts(axis)])[:, None]
            + int(self.lens_type.ratio) * np.arange(self.lens_type.pixels[axis])
            - self.margin
            for axis in (0, 1)
        )
        return down.ravel(), across.ravel()

    @cached_property
    def _beside(self) -> tuple[FloatArray, FloatArray]:
        """Pixels of f from the lens's axis to the footprints' middles, down and across."""
        index, pitch = self.camera.types.index(self.lens_type), self.camera.target_pitch
        found: list[FloatArray] = []
        for axis, start in enumerate(self.starts):
            count = self.lens_type.array[axis]
            subs = [self.camera.sub_imager(index, *((n, 0) if axis == 0 else (0, n))) for n in range(count)]
            lens = self.camera.shape[axis] / 2 - np.array([sub.lens[1 - axis] for sub in subs]) / pitch
            found.append(start + self.width / 2 - np.repeat(lens, self.lens_type.pixels[axis]))
        return found[0], found[1]

    @cached_property
    def scale(self) -> float:
        """The largest distance from the axis along an axis."""
        return max(float(np.abs(beside).max()) for beside in self._beside)

    @property
    def field(self) -> tuple[FloatArray, FloatArray]:
        """u of each sensor row and v of each sensor column, from -1 to 1."""
        return self._beside[0] / self.scale, self._beside[1] / self.scale

    def lines(self, pixels: IntArray) -> tuple[IntArray, IntArray]:
        """Return the sensor row and the sensor column of pixels of the lens type, in the order of measurements."""
        (_, across), (rows, columns) = self.lens_type.array, self.lens_type.pixels
        sub, within = np.divmod(pixels, rows * columns)
        k, l = np.divmod(sub, across)  # noqa: E741
        i, j = np.divmod(within, columns)
        return k * rows + i, l * columns + j

    def positions(self, pixels: IntArray) -> FloatArray:
        """Return (u, v) of pixels: (n, 2)."""
        rows, columns = self.lines(pixels)
        return np.stack([self.field[0][rows], self.field[1][columns]], axis=1)

    def cells(self, pixels: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows and the columns of f of the kernels' rows and columns: (n, W) each."""
        rows, columns = self.lines(pixels)
        reach = np.arange(self.width)
        return self.starts[0][rows][:, None] + reach, self.starts[1][columns][:, None] + reach


@dataclass(frozen=True, eq=False)
class KernelFootprints:
    """H of one lens type, applied from its kernels.

    kernels : (S, W, W), the mean kernel first;  coefficients : (S, P) of their polynomials, of `degree`
    error_kernels, error_coefficients : (E, W, W), (q, E, P): directions of the error of H, each of variance 1
    """

    places: KernelPlaces
    degree: int
    kernels: FloatArray
    coefficients: FloatArray
    error_kernels: FloatArray
    error_coefficients: FloatArray

    def __post_init__(self) -> None:
        """Raise ValueError for arrays that do not belong together."""
        terms_of, width = len(terms(self.degree)), self.places.width
        lines = self.kernels.shape, self.error_kernels.shape
        if any(len(shape) != 3 or shape[1:] != (width, width) for shape in lines):
            raise ValueError(f"expected kernels of {width} x {width} pixels of f, got {lines}")
        count = len(self.error_coefficients), len(self.error_kernels), terms_of
        if self.coefficients.shape != (len(self.kernels), terms_of) or self.error_coefficients.shape != count:
            raise ValueError("the coefficients of kernels do not belong to these")

    @property
    def without_errors(self) -> KernelFootprints:
        """The same H, taken for exact."""
        return replace(self, error_coefficients=self.error_coefficients[:0])

    @property
    def entries(self) -> int:
        """Number of entries of H, if it were stored."""
        tall, wide = (
            int((np.minimum(start + self.places.width, size) - np.maximum(start, 0)).sum())
            for start, size in zip(self.places.starts, self.places.camera.shape, strict=True)
        )
        return tall * wide

    @cached_property
    def _shape(self) -> tuple[int, int, int, int]:
        return (*self.places.lens_type.array, *self.places.lens_type.pixels)

    def _tables(self, kernels: FloatArray, coefficients: FloatArray) -> _Tables:
        """Return the arguments of the compiled loops that do not depend on the image."""
        weights = np.zeros((len(kernels), self.degree + 1, self.degree + 1))
        for term, (a, b) in enumerate(terms(self.degree)):
            weights[:, a, b] = coefficients[:, term]
        down, across = (np.asarray(legendre.legvander(axis, self.degree)) for axis in self.places.field)
        top, columns = self.places.starts
        left = int(columns.min())
        order = np.argsort(top, kind="stable")
        lines = down.astype(np.float64), across.astype(np.float64)
        return np.ascontiguousarray(kernels), weights, *lines, order, top, left, columns - left

    def forward(self, image: FloatArray) -> FloatArray:
        """H f: (N,) or (rows, columns) to (measurements of the type,)."""
        return self._correlate(image, self.kernels, self.coefficients)

    def _correlate(self, image: FloatArray, kernels: FloatArray, coefficients: FloatArray) -> FloatArray:
        from .correlation_loops import correlate  # pyright: ignore[reportUnknownVariableType]

        grid = np.ascontiguousarray(image, dtype=np.float64).reshape(self.places.camera.shape)
        if self.places.width >= WIDE:
            return self._arranged(self._wide(kernels, coefficients).forward(grid))
        tables, out = self._tables(kernels, coefficients), np.empty(self._shape)

        def work(first: int, last: int) -> None:
            correlate(grid, *tables, out, first, last)

        by_rows(self.places.starts[0].size, work)
        return out.ravel()

    def adjoint(self, readings: FloatArray, out: FloatArray) -> None:
        """Add H^T g to `out`: (measurements of the type,) to (rows, columns)."""
        from .correlation_loops import spread  # pyright: ignore[reportUnknownVariableType]

        source = np.ascontiguousarray(readings, dtype=np.float64).reshape(self._shape)
        if self.places.width >= WIDE:
            lines = source.swapaxes(1, 2).reshape(tuple(start.size for start in self.places.starts))
            out += self._wide(self.kernels, self.coefficients).adjoint(lines)
            return
        tables = self._tables(self.kernels, self.coefficients)

        def work(first: int, last: int) -> None:
            spread(source, *tables, out, first, last)

        by_rows(out.shape[0], work)

    def _wide(self, kernels: FloatArray, coefficients: FloatArray) -> WideCorrelation:
        _, weights, down, across, *_ = self._tables(kernels, coefficients)
        shares: list[tuple[FloatArray, FloatArray]] = [(down @ weight, across) for weight in weights]
        return WideCorrelation(self.places.camera.shape, kernels, *self.places.starts, shares)

    def _arranged(self, lines: FloatArray) -> FloatArray:
        """Return readings, (sensor rows, sensor columns), in the order of measurements."""
        down, across, rows, columns = self._shape
        return lines.reshape(down, rows, across, columns).swapaxes(1, 2).ravel()

    def rows(self, pixels: IntArray) -> sparse.csr_array:
        """Return H of some pixels of the lens type: (n, N)."""
        camera = self.places.camera
        down, across = self.places.cells(pixels)
        values = self._values(pixels, self.kernels, self.coefficients)
        inside = ((down >= 0) & (down < camera.rows))[:, :, None] & ((across >= 0) & (across < camera.columns))[:, None]
        inside &= values != 0
        texels = down[:, :, None] * camera.columns + across[:, None]
        pointers = np.concatenate([[0], np.cumsum(inside.sum(axis=(1, 2)))])
        return sparse.csr_array((values[inside], texels[inside], pointers), shape=(pixels.size, camera.unknowns))

    def _values(self, pixels: IntArray, kernels: FloatArray, coefficients: FloatArray) -> FloatArray:
        shares = basis(self.places.positions(pixels), self.degree) @ coefficients.T
        return np.tensordot(shares, kernels, axes=1)

    def to_sparse(self) -> sparse.csr_array:
        """Return H as a sparse matrix: (measurements of the type, N)."""
        count = self.places.lens_type.measurements
        chunks = (np.arange(n, min(n + PIXELS_AT_ONCE, count)) for n in range(0, count, PIXELS_AT_ONCE))
        return sparse.csr_array(sparse.vstack([self.rows(chunk) for chunk in chunks], format="csr"))

    def error_directions(self, image: FloatArray) -> sparse.csc_array:
        """Return L, (measurements of the type, q): the error of H f is L xi, with independent xi of variance 1."""
        columns = np.zeros((self.places.lens_type.measurements, len(self.error_coefficients)))
        for number, coefficients in enumerate(self.error_coefficients):
            columns[:, number] = self._correlate(image, self.error_kernels, coefficients)
        return sparse.csc_array(columns)

    def entry_deviation(self, pixels: IntArray) -> FloatArray:
        """Return standard deviations of the entries of some pixels, within the error's directions: (n, W, W)."""
        squares = np.zeros((pixels.size, self.places.width, self.places.width))
        for coefficients in self.error_coefficients:
            squares += np.square(self._values(pixels, self.error_kernels, coefficients))
        return np.sqrt(squares)

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """A key that is equal for two windows only if their submatrices are equal."""
        return rows.start, columns.start

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Indices of the type's measurements that see nothing outside a window of f: (m,)."""
        lit: list[IntArray] = []
        for start, window, size in zip(self.places.starts, (rows, columns), self.places.camera.shape, strict=True):
            first, last = np.maximum(start, 0), np.minimum(start + self.places.width, size)
            lit.append(np.flatnonzero((first >= window.start) & (last <= window.stop)))
        k, i = np.divmod(lit[0], self._shape[2])
        l, j = np.divmod(lit[1], self._shape[3])  # noqa: E741
        pixels = ((k[:, None] * self._shape[1] + l) * self._shape[2] + i[:, None]) * self._shape[3] + j
        return np.sort(pixels.ravel())

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H from the window to the measurements inside it: (m, pixels of the window)."""
        inside = self.rows(self.measurements_inside(rows, columns))
        row, column = np.divmod(inside.indices, self.places.camera.columns)
        shape = rows.stop - rows.start, columns.stop - columns.start
        texels = (row - rows.start) * shape[1] + column - columns.start
        return sparse.csr_array((inside.data, texels, inside.indptr), shape=(inside.shape[0], shape[0] * shape[1]))

    @property
    def description(self) -> dict[str, Any]:
        """The numbers that a file holds beside `arrays`, in JSON's types."""
        return {"kind": "kernels", "lens": self.places.lens_type.name, "margin": self.places.margin} | {
            "degree": self.degree
        }

    @property
    def arrays(self) -> dict[str, FloatArray]:
        """The arrays of a file."""
        return {
            "kernels": self.kernels,
            "coefficients": self.coefficients,
            "error_kernels": self.error_kernels,
            "error_coefficients": self.error_coefficients,
        }


def read_kernels(camera: Camera, description: dict[str, Any], arrays: dict[str, FloatArray]) -> KernelFootprints:
    """Return the kernels of a file: the inverse of `description` and `arrays`. Raises ValueError for others."""
    margin, degree = description["margin"], description["degree"]
    if any(type(each) is not int or each < 0 for each in (margin, degree)) or degree > MOST_DEGREE:
        raise ValueError(f"expected a margin and a degree of kernels, got {shortened_repr((margin, degree))}")
    (lens_type,) = (each for each in camera.types if each.name == description["lens"])
    return KernelFootprints(KernelPlaces(camera, lens_type, margin), degree, **arrays)
