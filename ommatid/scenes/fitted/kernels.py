"""H of a lens type with blur by learnt kernels: a point-spread function that varies smoothly over the field.

Row i of H in coordinates relative to the pixel's designed footprint, W x W pixels of f, is

    h_i = sum over q of c_q(u_i, v_i) Phi_q,

Phi_q the kernels that all sub-imagers of the lens type share, c_q polynomials of the position (u, v) of the footprint's
middle relative to the lens's axis, down and across in units of `scale` pixels of f. Windows and m are whole numbers, so
that one sampling of the kernels serves all pixels. Light beside the target is cut off at its edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import shortened_repr
from ommatid.runtime.processors import processors

from ..camera import Camera
from ..lens_type import LensType
from ..optics.boxes import by_rows

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
    """H of one lens type by its kernels.

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

    def _correlate(self, image: FloatArray, kernels: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return what kernels with these coefficients read of an image: (measurements of the type,)."""
        from .correlation_loops import correlate  # pyright: ignore[reportUnknownVariableType]

        grid = np.ascontiguousarray(image, dtype=np.float64).reshape(self.places.camera.shape)
        tables = self._tables(kernels, coefficients)
        if self.places.width >= WIDE:
            return self._arranged(self._transformed(grid, *tables[:4]))
        out = np.empty(self._shape)

        def work(first: int, last: int) -> None:
            correlate(grid, *tables, out, first, last)

        by_rows(self.places.starts[0].size, work)
        return out.ravel()

    def _transformed(
        self, image: FloatArray, kernels: FloatArray, weights: FloatArray, down: FloatArray, across: FloatArray
    ) -> FloatArray:
        """Return the sums of `_correlate` by Fourier transforms: (sensor rows, sensor columns).

        weights : (S, P, P) of products of polynomials down and across, (sensor rows, P) and (sensor columns, P)
        """
        wide = self.places.width
        rows, columns = (fft.next_fast_len(size + wide - 1, real=True) for size in self.places.camera.shape)
        seen = _spectrum(image, (rows, columns))
        top, left = self.places.starts
        places = np.ix_(top % rows, left % columns)
        out: FloatArray = np.zeros((top.size, left.size))
        for kernel, weight in zip(kernels, weights, strict=True):
            product = seen * np.conj(_spectrum(kernel, (rows, columns)))
            every = fft.irfft2(product, (rows, columns), workers=processors(), overwrite_x=True)
            out += every[places] * ((down @ weight) @ across.T)
        return out

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


def _spectrum(image: FloatArray, padded: tuple[int, int]) -> NDArray[np.complex128]:
    return fft.rfft2(image, padded, workers=processors())


def read_kernels(camera: Camera, description: dict[str, Any], arrays: dict[str, FloatArray]) -> KernelFootprints:
    """Return the kernels of a file: the inverse of `description` and `arrays`. Raises ValueError for others."""
    margin, degree = description["margin"], description["degree"]
    if any(type(each) is not int or each < 0 for each in (margin, degree)) or degree > MOST_DEGREE:
        raise ValueError(f"expected a margin and a degree of kernels, got {shortened_repr((margin, degree))}")
    (lens_type,) = (each for each in camera.types if each.name == description["lens"])
    return KernelFootprints(KernelPlaces(camera, lens_type, margin), degree, **arrays)
