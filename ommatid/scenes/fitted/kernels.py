"""H of a lens type with blur by learnt kernels: a point-spread function that varies smoothly over the field.

Row i of H in coordinates relative to the pixel's designed footprint, W x W pixels of f, is

    h_i = sum over q of c_q(u_i, v_i) Phi_q,

Phi_q the kernels that all sub-imagers of the lens type share, c_q polynomials of the position (u, v) of the footprint's
middle relative to the lens's axis, down and across in units of `scale` pixels of f. Windows and m are whole numbers, so
that one sampling of the kernels serves all pixels. Light beside the target is cut off at its edge. H and its transpose
are applied by Fourier transforms.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import gcd
from typing import Any, cast

import numpy as np
from numpy.polynomial import legendre
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import shortened_repr
from ommatid.runtime.machine import check_memory, processors

from ..camera import Camera
from ..lens_type import LensType
from ..observation import Back, ComplexArray, ObservationPart, Seen, cosines, density, on_lines, padded_shape
from .kernel_shapes import KernelShapes, Numbers

VALUES_AT_ONCE = 2**24  # of kernels that are made for a part of the pixels
ENTRY = 24  # bytes of an entry of a matrix while it is made
MOST_DEGREE = 50  # of polynomials in a file


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
        """The largest distance from the axis along an axis, at least a pixel."""
        return max(1.0, *(float(np.abs(beside).max()) for beside in self._beside))

    @property
    def field(self) -> tuple[FloatArray, FloatArray]:
        """u of each sensor row and v of each sensor column, from -1 to 1."""
        return self._beside[0] / self.scale, self._beside[1] / self.scale

    @property
    def extent(self) -> tuple[float, float]:
        """The largest |u| and |v|."""
        u, v = (float(np.abs(axis).max()) for axis in self.field)
        return u, v

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
class _Grid:
    """What products on a padded grid need.

    transfers : of each kernel, (S', rows, columns / 2 + 1)
    rows, columns : matrices that take the sensor rows and columns out of every `spacing`-th pixel
    """

    transfers: ComplexArray
    rows: sparse.csr_array
    columns: sparse.csr_array

    @cached_property
    def scattered(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """The transposes of `rows` and `columns`."""
        return sparse.csr_array(self.rows.T), sparse.csr_array(self.columns.T)


@dataclass(frozen=True, eq=False)
class KernelFootprints(ObservationPart):
    """H of one lens type by its kernels.

    shapes : S kernels, the mean kernel first, and E of errors;  coefficients : (S, P) of their polynomials, of `degree`
    error_coefficients : (q, E, P): directions of the error of H, each of variance 1
    """

    places: KernelPlaces
    degree: int
    shapes: KernelShapes
    coefficients: FloatArray
    error_coefficients: FloatArray
    _grids: dict[tuple[int, int], _Grid] = field(default_factory=dict[tuple[int, int], "_Grid"], init=False, repr=False)

    def __post_init__(self) -> None:
        """Raise ValueError for arrays that do not belong together."""
        terms_of, width = len(terms(self.degree)), self.places.width
        if self.shapes.width != width:
            raise ValueError(f"expected kernels of {width} x {width} pixels of f, got {self.shapes.width}")
        count = len(self.error_coefficients), len(self.shapes.error_core), terms_of
        if self.coefficients.shape != (self.shapes.count, terms_of) or self.error_coefficients.shape != count:
            raise ValueError("the coefficients of kernels do not belong to these")

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs: transfer functions are computed again there."""
        made = ("_applied", "_applied_weights")
        return {name: value for name, value in self.__dict__.items() if name not in made} | {"_grids": {}}

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.places.camera.shape

    @property
    def measurements(self) -> int:
        """Number of measurements of the lens type."""
        return self.places.lens_type.measurements

    @property
    def entries(self) -> int:
        """Number of entries, those of value 0 and those beside the target included."""
        return self.measurements * self.places.width**2

    @property
    def reach(self) -> int:
        """W."""
        return self.places.width

    @property
    def without_errors(self) -> KernelFootprints:
        """The same H, taken for exact."""
        none = self.error_coefficients[:0, :0]
        return replace(self, shapes=self.shapes.without_errors, error_coefficients=none)

    def forward(self, seen: Seen, out: FloatArray) -> None:
        """Write H f to `out`, (measurements of the type,)."""
        total: FloatArray = np.zeros((self.places.starts[0].size, self.places.starts[1].size))
        readings = self._correlated(seen, self._grid(seen.padded).transfers)
        for every, weight in zip(readings, self._applied_weights, strict=True):
            total += weight * every
        out[:] = self.places.lens_type.in_order(total)

    def adjoint(self, readings: FloatArray, back: Back) -> None:
        """Add H^T g to `back`; readings : (measurements of the type,)."""
        lines, grid = self.places.lens_type.by_lines(readings), self._grid(back.padded)
        (to_rows, to_columns), count, length = grid.scattered, grid.rows.shape[1], grid.columns.shape[1]
        frequencies: IntArray = np.arange(back.padded[1] // 2 + 1)
        for transfer, weight in zip(grid.transfers, self._applied_weights, strict=True):
            placed = on_lines(to_rows, to_columns, lines * weight)
            # Zeros between readings repeat the spectrum.
            across = _coefficients(np.asarray(fft.rfft(placed, workers=processors())), length, frequencies)
            spectrum = np.asarray(fft.fft(across, axis=0, workers=processors(), overwrite_x=True))
            back.add_spectrum(
                (np.conj(transfer.reshape(-1, count, frequencies.size)) * spectrum).reshape(transfer.shape)
            )

    def _correlated(self, seen: Seen, transfers: ComplexArray) -> Iterator[FloatArray]:
        """Yield what each kernel with these transfer functions reads: (sensor rows, sensor columns)."""
        grid = self._grid(seen.padded)
        rows, columns = grid.rows, grid.columns
        count, length, every = rows.shape[1], columns.shape[1], seen.padded[1] // columns.shape[1]
        spectrum = seen.spectrum.reshape(-1, count, seen.spectrum.shape[1])
        aliases = np.arange(length // 2 + 1) + length * np.arange(every)[:, None]
        for transfer in transfers:
            # Of every so many pixels, the spectrum is the sum of its aliases.
            product: ComplexArray = np.einsum("aij,aij->ij", spectrum, transfer.reshape(spectrum.shape))
            down = np.asarray(fft.ifft(product, axis=0, workers=processors(), overwrite_x=True))
            across = _coefficients(down, seen.padded[1], aliases).sum(axis=1)
            readings = cast(FloatArray, fft.irfft(across, length, workers=processors(), overwrite_x=True))
            yield on_lines(rows, columns, readings) / (len(spectrum) * every)

    def _grid(self, padded: tuple[int, int]) -> _Grid:
        """Return what a padded grid needs, which is computed once."""
        if padded not in self._grids:
            self._grids.clear()  # that of another grid is of no use any more
            every = gcd(self.spacing, *padded)
            sizes = padded[0] // every, padded[1] // every
            rows, columns = (_chosen(start // every % n, n) for start, n in zip(self.places.starts, sizes, strict=True))
            self._grids[padded] = _Grid(self._transfers_of(self._applied[0], padded), rows, columns)
        return self._grids[padded]

    @cached_property
    def _applied(self) -> tuple[FloatArray, FloatArray]:
        """Kernels that give the same H, (S', W, W), and their coefficients, (S', P): one for all that are constant.

        There is one for each term where these are fewer.
        """
        kernels, constant = self.shapes.kernels, ~self.coefficients[:, 1:].any(axis=1)
        by_terms = self.coefficients.any(axis=0)
        if by_terms.sum() <= (~constant).sum():  # one kernel for each term
            terms_used = np.eye(by_terms.size)[by_terms]
            return np.tensordot(terms_used @ self.coefficients.T, kernels, axes=1), terms_used
        if not constant.any():
            return kernels, self.coefficients
        same = np.tensordot(self.coefficients[constant, 0], kernels[constant], axes=1)
        unit = np.eye(1, by_terms.size)
        return np.concatenate([same[None], kernels[~constant]]), np.concatenate([unit, self.coefficients[~constant]])

    @cached_property
    def _applied_weights(self) -> list[FloatArray | float]:
        """The weight of each of these kernels in every reading."""
        return self._weights(self._applied[1])

    def _transfers_of(self, kernels: FloatArray, padded: tuple[int, int]) -> ComplexArray:
        """Return the conjugate transforms of kernels, which correlate an image with them."""
        before = [(int(start[0]) % gcd(self.spacing, *padded), 0) for start in self.places.starts]
        return np.conj(np.asarray(fft.rfft2(np.pad(kernels, [(0, 0), *before]), padded, workers=processors())))

    @property
    def spacing(self) -> int:
        """Pixels of f between neighbouring readings along an axis."""
        return gcd(*(int(start) for axis in self.places.starts for start in axis - axis[0])) or 1

    def _weights(self, coefficients: FloatArray) -> list[FloatArray | float]:
        """Return the weight of each kernel in every reading: (sensor rows, sensor columns), or one number for all."""
        if self.degree == 0:
            return [float(each[0]) for each in coefficients]
        down, across = (np.asarray(legendre.legvander(axis, self.degree)) for axis in self.places.field)
        return [(down @ product) @ across.T for product in self._products(coefficients)]

    def _products(self, coefficients: FloatArray) -> FloatArray:
        """Return the weights of products of polynomials down and across: (S, degree + 1, degree + 1)."""
        weights = np.zeros((len(coefficients), self.degree + 1, self.degree + 1))
        for term, (a, b) in enumerate(terms(self.degree)):
            weights[:, a, b] = coefficients[:, term]
        return weights

    def rows(self, pixels: IntArray, window: tuple[slice, slice] | None = None) -> sparse.csr_array:
        """Return H of some pixels of the lens type on a window of f, the whole of it by default: (n, its pixels)."""
        tall, wide = window or (slice(0, self.shape[0]), slice(0, self.shape[1]))
        width = wide.stop - wide.start
        down, across = self.places.cells(pixels)
        values = self.values(pixels)
        inside = ((down >= tall.start) & (down < tall.stop))[:, :, None]
        inside = inside & ((across >= wide.start) & (across < wide.stop))[:, None] & (values != 0)
        texels = (down - tall.start)[:, :, None] * width + (across - wide.start)[:, None]
        pointers = np.concatenate([[0], np.cumsum(inside.sum(axis=(1, 2)))])
        shape = pixels.size, (tall.stop - tall.start) * width
        return sparse.csr_array((values[inside], texels[inside], pointers), shape=shape)

    def values(self, pixels: IntArray) -> FloatArray:
        """Return the kernels of some pixels of the lens type, beside the target as well: (n, W, W)."""
        return self._kernels_at(self.places.positions(pixels))

    def _kernels_at(self, positions: FloatArray) -> FloatArray:
        """Return the kernels at positions (u, v), (n, 2): (n, W, W)."""
        shares = basis(positions, self.degree) @ self.coefficients.T
        return np.tensordot(shares, self.shapes.kernels, axes=1)

    def kernels_at(self, row: float, columns: FloatArray) -> FloatArray:
        """Return the kernels of footprints whose middles lie at places of f, in pixels, columns (n,): (n, W, W)."""
        u, v = (
            np.interp(place, np.sort(start) + self.places.width / 2, along[np.argsort(start)])
            for place, start, along in zip((row, columns), self.places.starts, self.places.field, strict=True)
        )
        return self._kernels_at(np.stack([np.broadcast_to(u, v.shape), v], axis=1))

    def _chunked(self, pixels: IntArray, window: tuple[slice, slice] | None = None) -> sparse.csr_array:
        count = max(1, VALUES_AT_ONCE // self.places.width**2)
        chunks = (pixels[first : first + count] for first in range(0, max(pixels.size, 1), count))
        return sparse.csr_array(sparse.vstack([self.rows(chunk, window) for chunk in chunks], format="csr"))

    def to_sparse(self) -> sparse.csr_array:
        """Return H as a sparse matrix, (measurements of the type, N). Raises InputError if memory does not hold it."""
        check_memory(ENTRY * self.entries, "H with its entries", "crop the target")
        return self._chunked(np.arange(self.measurements))

    def coarser(self, camera: Camera, detail: int) -> KernelFootprints:
        """Return H of images of `detail` times larger pixels; camera : on their grid."""
        (lens_type,) = (each for each in camera.types if each.name == self.places.lens_type.name)
        places = KernelPlaces(camera, lens_type, -(-self.places.margin // detail))
        beside = detail * places.margin - self.places.margin
        parts = [
            np.pad(kernels, ((0, 0), (beside, beside), (beside, beside)))
            .reshape(-1, places.width, detail, places.width, detail)
            .sum(axis=(2, 4))
            for kernels in (self.shapes.kernels, self.shapes.error_kernels)
        ]
        return replace(self, places=places, shapes=KernelShapes.dense(*parts))

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Return the indices of the measurements that see nothing of f beside a window of it."""
        inside = [
            (np.maximum(start, 0) >= part.start) & (np.minimum(start + self.places.width, size) <= part.stop)
            for start, part, size in zip(self.places.starts, (rows, columns), self.shape, strict=True)
        ]
        order = (*self.places.lens_type.array, *self.places.lens_type.pixels)
        every = np.arange(self.measurements).reshape(order).swapaxes(1, 2).reshape(inside[0].size, inside[1].size)
        return np.sort(every[np.ix_(*inside)].ravel())

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to the measurements inside it."""
        return self._chunked(self.measurements_inside(rows, columns), (rows, columns))

    def rows_on(self, numbers: IntArray, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to some measurements; what they see beside it is left out."""
        return self.rows(numbers, (rows, columns))

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """Return a key of the window alone: kernels vary over the field."""
        return rows.start, columns.start

    @cached_property
    def mean_kernel(self) -> FloatArray:
        """The mean of the kernels over the field: (W, W)."""
        return np.tensordot(self._means, self.shapes.kernels, axes=1)

    @property
    def mean(self) -> KernelFootprints:
        """H by the mean kernel everywhere, without errors."""
        shapes = KernelShapes.dense(self.mean_kernel[None])
        return replace(
            self, degree=0, shapes=shapes, coefficients=np.ones((1, 1)), error_coefficients=np.zeros((0, 0, 1))
        )

    @property
    def variation(self) -> float:
        """RMS difference of the kernels over the field from their mean, relative to that."""
        weights = np.array([np.ravel(every) for every in self._weights(self.coefficients)])  # (S, readings) or (S, 1)
        flat, mean = self.shapes.kernels.reshape(len(weights), -1), weights.mean(axis=1)
        products, apart = flat @ flat.T, weights - mean[:, None]
        squares = np.einsum("sr,st,tr->r", apart, products, apart, optimize=True)
        return float(np.sqrt(squares.mean() / (mean @ products @ mean)))

    @property
    def _means(self) -> FloatArray:
        """The mean weights of the kernels over the field: (S,)."""
        down, across = (legendre.legvander(axis, self.degree).mean(axis=0) for axis in self.places.field)
        return np.asarray(np.einsum("sab,a,b->s", self._products(self.coefficients), down, across))

    @property
    def _densities(self) -> tuple[float, float]:
        """Readings per row and per column of f."""
        rows, columns = (
            density(start, self.places.width, size) for start, size in zip(self.places.starts, self.shape, strict=True)
        )
        return rows, columns

    def information(self) -> FloatArray:
        """Return the mean of H^T H far from the edges, under the DCT-II: (rows, columns)."""
        wide, (down, across) = self.places.width, self._densities
        power = np.square(np.abs(fft.rfft2(self.mean_kernel, (2 * wide, 2 * wide))))
        lags = np.asarray(fft.irfft2(power, (2 * wide, 2 * wide)))
        mirrored = lags[:wide, -np.arange(wide)]  # lags down and to the left
        even = (lags[:wide, :wide] + mirrored) / 2
        rows, columns = (cosines(size, wide) for size in self.shape)
        return np.maximum(down * across * (rows @ even @ columns.T), 0.0)

    def edge_information(self, axis: int, strip: slice) -> FloatArray:
        """Return H^T H of a strip along an edge, with its mean along the edge under the DCT-II."""
        kernel = self.mean_kernel if axis == 0 else self.mean_kernel.T
        wide, length, depth = self.places.width, self.shape[1 - axis], strip.stop - strip.start
        angles = np.outer(np.pi * np.arange(length) / length, np.arange(wide))
        index, roots = _near(self.places.starts[axis], wide, strip)
        shares = np.pad(kernel, ((0, 1), (0, 0)))[index]
        shares *= roots[:, None, None] * self._densities[1 - axis] ** 0.5
        total = np.zeros((length, depth, depth))
        for waves in (np.cos(angles), np.sin(angles)):
            read = np.moveaxis(shares @ waves.T, 2, 0)  # (length, readings, depth)
            total += read.swapaxes(1, 2) @ read
        return total

    def corner_information(self, rows: slice, columns: slice) -> FloatArray:
        """Return H^T H of a small window: (its pixels, its pixels)."""
        wide, (tops, lefts) = self.places.width, self.places.starts
        (down, roots), (across, factors) = _near(tops, wide, rows), _near(lefts, wide, columns)
        kernel, size = np.pad(self.mean_kernel, ((0, 1), (0, 1))), down.shape[1] * across.shape[1]
        total = np.zeros((size, size))
        for index, root in zip(down, roots, strict=True):  # of one sensor row at a time, to bound memory
            read = root * factors[:, None, None] * kernel[index][:, across].swapaxes(0, 1)
            read = read.reshape(factors.size, size)
            total += read.T @ read
        return total

    def error_directions(self, image: FloatArray) -> sparse.csc_array:
        """Return L, (measurements of the type, q): the error of H f is L xi, with independent xi of variance 1."""
        grid = padded_shape(self.shape, self.reach, self.spacing)
        seen = Seen(np.asarray(image, dtype=np.float64).reshape(self.shape), grid)
        sizes = tuple(start.size for start in self.places.starts)
        every = np.zeros((self.error_coefficients.shape[1], *sizes))
        for out, read in zip(
            every, self._correlated(seen, self._transfers_of(self.shapes.error_kernels, grid)), strict=True
        ):
            out[:] = read
        lines = np.zeros((len(self.error_coefficients), *sizes))
        down, across = (np.asarray(legendre.legvander(axis, self.degree)) for axis in self.places.field)
        for number, (a, b) in enumerate(terms(self.degree)):
            of_term = np.tensordot(self.error_coefficients[:, :, number], every, axes=1)
            lines += np.outer(down[:, a], across[:, b]) * of_term
        readings = np.zeros((len(lines), self.measurements))
        for out, read in zip(readings, lines, strict=True):
            out[:] = self.places.lens_type.in_order(read)
        return sparse.csc_array(readings.T)

    @property
    def description(self) -> dict[str, Any]:
        """The numbers that a file holds beside `arrays`, in JSON's types."""
        return {"kind": "kernels", "lens": self.places.lens_type.name, "margin": self.places.margin} | {
            "degree": self.degree
        }

    @property
    def arrays(self) -> dict[str, Numbers]:
        """The arrays of a file."""
        return self.shapes.arrays | {
            "coefficients": self.coefficients,
            "error_coefficients": self.error_coefficients,
        }


def _coefficients(half: ComplexArray, size: int, frequencies: IntArray) -> ComplexArray:
    """Return coefficients of real lines of this size from those of rfft, (lines, size / 2 + 1)."""
    mirrored = frequencies % size > size // 2
    found = half[:, np.where(mirrored, -frequencies, frequencies) % size]
    return np.where(mirrored, np.conj(found), found)


def _near(starts: IntArray, wide: int, part: slice) -> tuple[IntArray, FloatArray]:
    """Return the row of the kernel, `wide` beside it, at pixels of a part, and the root of the number of such kernels.

    starts : where kernels begin along an axis;  both for each different start near the part: (n, pixels), (n,)
    """
    near, counts = np.unique(starts[(starts + wide > part.start) & (starts < part.stop)], return_counts=True)
    pixels: IntArray = np.asarray(range(part.start, part.stop), dtype=np.int64)
    index = pixels - near[:, None]
    return np.where((index >= 0) & (index < wide), index, wide), np.sqrt(counts)


def _chosen(index: IntArray, size: int) -> sparse.csr_array:
    """Return the matrix that takes elements `index` out of `size`: (indices, size)."""
    return sparse.csr_array((np.ones(index.size), index, np.arange(index.size + 1)), shape=(index.size, size))


def read_kernels(camera: Camera, description: dict[str, Any], arrays: dict[str, Any]) -> KernelFootprints:
    """Return the kernels of a file: the inverse of `description` and `arrays`.

    Raises ValueError for others, and InputError for kernels that do not fit into memory.
    """
    margin, degree = description["margin"], description["degree"]
    if any(type(each) is not int or each < 0 for each in (margin, degree)) or degree > MOST_DEGREE:
        raise ValueError(f"expected a margin and a degree of kernels, got {shortened_repr((margin, degree))}")
    (lens_type,) = (each for each in camera.types if each.name == description["lens"])
    coefficients, errors = (arrays.pop(name) for name in ("coefficients", "error_coefficients"))
    places = KernelPlaces(camera, lens_type, margin)
    needed = 8 * (len(coefficients) + errors.shape[1]) * places.width**2
    check_memory(needed, f"the kernels of lens type {lens_type.name}", "calibrate again")
    return KernelFootprints(places, degree, KernelShapes(**arrays), coefficients, errors)
