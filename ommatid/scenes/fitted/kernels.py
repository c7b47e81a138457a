"""H of a lens type with blur by learnt kernels: a point-spread function that varies smoothly over the field.

Row i of H in coordinates relative to the pixel's designed footprint, W x W pixels of f, is

    h_i = sum over q of c_q(u_i, v_i) Phi_q,

Phi_q the kernels that all sub-imagers of the lens type share, c_q polynomials of the position (u, v) of the footprint's
middle relative to the lens's axis, down and across in units of `scale` pixels of f. Windows and m are whole numbers, so
that one sampling of the kernels serves all pixels. Light beside the target is cut off at its edge. H and its transpose
are applied by Fourier transforms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import gcd
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import shortened_repr
from ommatid.runtime.machine import check_memory, processors

from ..camera import Camera
from ..lens_type import LensType
from ..observation import Back, ComplexArray, ObservationPart, Precision, Seen, padded_shape
from .kernel_shapes import KernelShapes, Numbers

ENTRY = 24  # bytes of an entry of a matrix while it is made
MOST_DEGREE = 50  # of polynomials in a file
LOSS = 0.01  # RMS of what the kernels of a cheaper H leave out, relative
SAVING = 3  # times fewer they are at least, or the steps that they cost are more than those saved


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

    @property
    def sensor(self) -> tuple[int, int]:
        """Sensor rows and sensor columns of the lens type."""
        return self.starts[0].size, self.starts[1].size

    @cached_property
    def order(self) -> IntArray:
        """The measurements, by their number among all sensor rows and columns in the order of starts."""
        down, across = (np.argsort(np.argsort(start, kind="stable"), kind="stable") for start in self.starts)
        return self.lens_type.in_order(down[:, None] * across.size + across)

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
    """The padded grid of products, folded to the pixels where readings may begin: every so many along both axes.

    transfers : conjugate transforms of the kernels, (S', rows, columns / 2 + 1)
    rows, columns : places of the sensor rows and of the sensor columns, in rising order, on the folded grid
    """

    padded: tuple[int, int]
    every: int
    transfers: list[ComplexArray]
    rows: IntArray
    columns: IntArray

    @property
    def _folded(self) -> tuple[int, int]:
        return self.padded[0] // self.every, self.padded[1] // self.every

    @cached_property
    def _places(self) -> tuple[Any, ...]:
        """Index of the readings on the folded grid: a view of it where they lie side by side."""
        if all(np.array_equal(axis, np.arange(axis.size)) for axis in (self.rows, self.columns)):
            return slice(self.rows.size), slice(self.columns.size)
        return np.ix_(self.rows, self.columns)

    def read(self, spectrum: ComplexArray, transfer: ComplexArray, room: ComplexArray) -> FloatArray:
        """Return what a kernel reads of an image with this spectrum: (sensor rows, sensor columns).

        room : of the size of the spectrum, to be used again
        """
        (count, length), every = self._folded, self.every
        lines = np.multiply(spectrum, transfer, out=room)
        if every > 1:
            lines = lines.reshape(every, count, -1).sum(axis=0)
        lines = np.asarray(fft.ifft(lines, axis=0, workers=processors(), overwrite_x=True))
        if every > 1:
            lines = _folded(lines, self.padded[1], length)
            lines /= every**2
        return np.asarray(fft.irfft(lines, length, workers=processors(), overwrite_x=True))[self._places]

    @cached_property
    def _repeats(self) -> list[tuple[slice, slice]]:
        """Rows and columns of the padded grid's coefficients, in blocks that repeat those of the folded grid."""
        (down, across), columns = self._folded, self.padded[1] // 2 + 1
        return [
            (slice(row, row + down), slice(column, min(column + across, columns)))
            for row in range(0, self.padded[0], down)
            for column in range(0, columns, across)
        ]

    def add_spread(self, total: ComplexArray, readings: FloatArray, weight: FloatArray | float, number: int) -> None:
        """Add to the conjugate spectrum of an image that of weighted readings, spread by kernel `number`.

        total : (rows, columns / 2 + 1);  readings : (sensor rows, sensor columns)
        """
        placed = np.zeros(self._folded, total.real.dtype)
        if isinstance(self._places[0], slice):
            np.multiply(readings, weight, out=placed[self._places])
        else:
            weighted = np.asarray(weight * readings, placed.dtype)
            np.add.at(placed, self._places, weighted)  # several may begin at one pixel
        transform = fft.rfft2 if self.every == 1 else fft.fft2
        spectrum = np.asarray(transform(placed, workers=processors(), overwrite_x=True))
        np.conj(spectrum, out=spectrum)
        room = np.empty_like(spectrum)
        for block in self._repeats:
            width = block[1].stop - block[1].start
            product = np.multiply(self.transfers[number][block], spectrum[:, :width], out=room[:, :width])
            total[block] += product


@dataclass(frozen=True, eq=False)
class KernelFootprints(ObservationPart):
    """H of one lens type by its kernels.

    shapes : S kernels, the mean kernel first, and E of errors;  coefficients : (S, P) of their polynomials, of `degree`
    error_coefficients : (q, E, P): directions of the error of H, each of variance 1
    precision : of products with an image and of sums of readings
    """

    places: KernelPlaces
    degree: int
    shapes: KernelShapes
    coefficients: FloatArray
    error_coefficients: FloatArray
    precision: Precision = np.float64
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
        made = ("_applied", "_applied_weights", "_components", "_cheaper")
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

    def times(self, factor: float) -> KernelFootprints:
        """Return H and its errors multiplied by a factor."""
        return replace(
            self, coefficients=factor * self.coefficients, error_coefficients=factor * self.error_coefficients
        )

    def forward(self, seen: Seen, out: FloatArray) -> None:
        """Write H f to `out`, (measurements of the type,)."""
        grid, total, spectrum = self._grid(seen.padded), np.zeros(self.places.sensor), seen.spectrum(self.precision)
        room = np.empty_like(spectrum)
        for transfer, weight in zip(grid.transfers, self._applied_weights, strict=True):
            read = grid.read(spectrum, transfer, room)
            read *= weight
            total += read
        out[:] = total.ravel()[self.places.order]

    def adjoint(self, readings: FloatArray, back: Back) -> None:
        """Add H^T g to `back`; readings : (measurements of the type,)."""
        grid, ordered = self._grid(back.padded), np.empty(self.places.sensor)
        ordered.ravel()[self.places.order] = readings
        total = np.zeros((back.padded[0], back.padded[1] // 2 + 1), grid.transfers[0].dtype)
        for number, weight in enumerate(self._applied_weights):
            grid.add_spread(total, ordered, weight, number)
        back.add_spectrum(np.conj(total, out=total))

    def _grid(self, padded: tuple[int, int]) -> _Grid:
        """Return what a padded grid needs, which is computed once."""
        if padded not in self._grids:
            self._grids.clear()  # that of another grid is of no use any more
            self._grids[padded] = self._grid_of(padded, list(self._transfers_of(self._applied[0], padded)))
        return self._grids[padded]

    def _grid_of(self, padded: tuple[int, int], transfers: list[ComplexArray]) -> _Grid:
        every = gcd(self.spacing, *padded)
        rows, columns = (np.sort(start - start.min()) // every for start in self.places.starts)
        return _Grid(padded, every, transfers, rows, columns)

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
        """The weight of each of these kernels in every reading, in the order of starts."""
        return self._weights(self._applied[1])

    def _transfers_of(self, kernels: FloatArray, padded: tuple[int, int]) -> Iterator[ComplexArray]:
        """Yield the conjugate transforms of kernels at the first place: they correlate an image with the kernels."""
        first, beside = (start.min() + np.arange(self.places.width) for start in self.places.starts)
        for kernel in kernels:
            placed = np.zeros(padded)
            placed[np.ix_(first % padded[0], beside % padded[1])] = kernel
            spectrum = np.asarray(fft.rfft2(placed, workers=processors(), overwrite_x=True))
            yield np.conj(spectrum, out=spectrum).astype(np.result_type(self.precision, 1j), copy=False)

    @property
    def is_slow(self) -> bool:
        """True if the kernels vary over the field."""
        return self.degree > 0

    @property
    def spacing(self) -> int:
        """Pixels of f between neighbouring readings along an axis."""
        return gcd(*(int(start) for axis in self.places.starts for start in axis - axis[0])) or 1

    def _weights(self, coefficients: FloatArray) -> list[FloatArray | float]:
        """Return the weight of each kernel in every reading, in the order of starts, or one number for all."""
        if self.degree == 0:
            return [float(each[0]) for each in coefficients]
        down, across = self._polynomials
        return [(down @ product) @ across.T for product in self._products(coefficients)]

    @property
    def _polynomials(self) -> tuple[FloatArray, FloatArray]:
        """P_a of each sensor row and of each sensor column, in the order of starts: (sensor rows, degree + 1)."""
        down, across = (
            np.asarray(legendre.legvander(axis[np.argsort(start, kind="stable")], self.degree), dtype=np.float64)
            for axis, start in zip(self.places.field, self.places.starts, strict=True)
        )
        return down, across

    def _products(self, coefficients: FloatArray) -> FloatArray:
        """Return the weights of products of polynomials down and across: (S, degree + 1, degree + 1)."""
        weights = np.zeros((len(coefficients), self.degree + 1, self.degree + 1))
        for term, (a, b) in enumerate(terms(self.degree)):
            weights[:, a, b] = coefficients[:, term]
        return weights

    def rows(self, pixels: IntArray, window: tuple[slice, slice] | None = None) -> sparse.csr_array:
        """Return H of some pixels of the lens type on a window of f, the whole of it by default: (n, its pixels)."""
        tall, wide = window or (slice(0, self.shape[0]), slice(0, self.shape[1]))
        size, width = self.places.width, wide.stop - wide.start
        lines, beside = self.places.lines(pixels)
        lefts, shares = self.places.starts[1][beside], self._shares(pixels)
        order = np.argsort(lines, kind="stable")
        found: list[tuple[FloatArray, IntArray, IntArray]] = []
        for part in np.split(order, np.flatnonzero(np.diff(lines[order])) + 1) if pixels.size else []:
            top, left = int(self.places.starts[0][lines[part[0]]]), lefts[part]  # kernels are cut off alike along a row
            down, across = (
                np.arange(max(first, 0), min(last, size))
                for first, last in (
                    (tall.start - top, tall.stop - top),
                    (wide.start - int(left.max()), wide.stop - int(left.min())),
                )
            )
            values = np.tensordot(shares[part], self.shapes.kernels[:, down][:, :, across], axes=1)
            columns = left[:, None] + across - wide.start
            texels = ((down + top - tall.start) * width)[:, None] + columns[:, None]
            inside = ((columns >= 0) & (columns < width))[:, None] & (values != 0)
            found.append((values[inside], texels[inside], inside.sum(axis=(1, 2))))
        nothing = np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros(1, dtype=np.intp)
        values, texels, counts = (np.concatenate(each) for each in zip(nothing, *found, strict=True))
        shape = pixels.size, (tall.stop - tall.start) * width
        return sparse.csr_array((values, texels, np.cumsum(counts)), shape=shape)[np.argsort(order)]

    def values(self, pixels: IntArray) -> FloatArray:
        """Return the kernels of some pixels of the lens type, beside the target as well: (n, W, W)."""
        return np.tensordot(self._shares(pixels), self.shapes.kernels, axes=1)

    def _shares(self, pixels: IntArray) -> FloatArray:
        """Return the weight of each kernel in some pixels of the lens type: (n, S)."""
        return basis(self.places.positions(pixels), self.degree) @ self.coefficients.T

    def to_sparse(self) -> sparse.csr_array:
        """Return H as a sparse matrix, (measurements of the type, N). Raises InputError if memory does not hold it."""
        check_memory(ENTRY * self.entries, "H with its entries", "crop the target")
        return self.rows(np.arange(self.measurements))

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
        every = self.places.lens_type.by_lines(np.arange(self.measurements))
        return np.sort(every[np.ix_(*inside)].ravel())

    def rows_on(self, numbers: IntArray, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to some measurements; what they see beside it is left out."""
        return self.rows(numbers, (rows, columns))

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

    @cached_property
    def _components(self) -> tuple[FloatArray, FloatArray]:
        """What the kernels differ by from their mean: orthonormal components, (S, W^2), and the RMS of each, (S,)."""
        weights = np.array([np.ravel(every) for every in self._weights(self.coefficients)])  # (S, readings) or (S, 1)
        apart = weights - weights.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(apart @ apart.T / apart.shape[1])
        strong = (vectors * np.sqrt(np.maximum(values, 0.0))).T @ self.shapes.kernels.reshape(len(weights), -1)
        _, sizes, components = np.linalg.svd(strong, full_matrices=False)
        return components, sizes / float(np.linalg.norm(self.mean_kernel))

    @property
    def variation(self) -> float:
        """RMS difference of the kernels over the field from their mean, relative to that."""
        return float(np.linalg.norm(self._components[1]))

    @property
    def cheaper(self) -> KernelFootprints:
        """About the same H in single precision, by the fewest kernels whose RMS difference from these is small."""
        return self._cheaper

    @cached_property
    def _cheaper(self) -> KernelFootprints:
        if self.degree == 0:  # which costs one product, and the prior's transforms take longer
            return self
        components, sizes = self._components
        left = np.sqrt(np.cumsum(np.square(sizes[::-1]))[::-1])  # by leaving out each component and those after it
        kept = components[left > LOSS]
        if SAVING * (1 + len(kept)) > len(self._applied[0]):
            return self
        flat = self.shapes.kernels.reshape(self.shapes.count, -1)
        apart = self.coefficients.copy()
        apart[:, 0] -= self._means
        coefficients = np.concatenate([np.eye(1, apart.shape[1]), kept @ flat.T @ apart])
        kernels = np.concatenate([self.mean_kernel.reshape(1, -1), kept])
        shapes = KernelShapes.dense(kernels.reshape(-1, self.places.width, self.places.width))
        none = np.zeros((0, 0, apart.shape[1]))
        return replace(self, shapes=shapes, coefficients=coefficients, error_coefficients=none, precision=np.float32)

    @property
    def _means(self) -> FloatArray:
        """The mean weights of the kernels over the field: (S,)."""
        down, across = (legendre.legvander(axis, self.degree).mean(axis=0) for axis in self.places.field)
        return np.asarray(np.einsum("sab,a,b->s", self._products(self.coefficients), down, across))

    def error_directions(self, image: FloatArray) -> FloatArray:
        """Return L, (measurements of the type, q): the error of H f is L xi, with independent xi of variance 1."""
        padded, image = padded_shape(self.shape, self.reach, self.spacing), np.asarray(image, dtype=np.float64)
        grid, spectrum = self._grid_of(padded, []), Seen(image.reshape(self.shape), padded).spectrum(self.precision)
        transfers = self._transfers_of(self.shapes.error_kernels, padded)
        every, room = np.zeros((self.error_coefficients.shape[1], *self.places.sensor)), np.empty_like(spectrum)
        for out, transfer in zip(every, transfers, strict=True):
            out[:] = grid.read(spectrum, transfer, room)
        (directions, kernels, _), (rows, columns) = self.error_coefficients.shape, self.places.sensor
        down, across = self._polynomials
        count = self.degree + 1
        shares = self._products(self.error_coefficients.reshape(directions * kernels, len(terms(self.degree))))
        shares = shares.reshape(directions, kernels, count, count)
        lines = np.empty((directions, rows, columns))
        for row in range(rows):  # what is computed of a row stays in the processor's cache
            of_row = np.tensordot(shares, down[row], axes=(2, 0)).reshape(directions, kernels * count)
            lines[:, row] = of_row @ (every[:, row, None] * across.T).reshape(kernels * count, columns)
        return lines.reshape(directions, rows * columns)[:, self.places.order].T

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


def _folded(half: ComplexArray, size: int, length: int) -> ComplexArray:
    """Return coefficients of every (size / length)-th pixel of real lines, (lines, length / 2 + 1), from those of rfft.

    They are sums of aliases.
    """
    total, kept = np.zeros((len(half), length // 2 + 1), half.dtype), length // 2
    for first in range(0, size, length):
        if 2 * first < size:
            total += half[:, first : first + kept + 1]
        else:  # the conjugates of those of negative frequencies
            total += np.conj(half[:, size - first - kept : size - first + 1][:, ::-1])
    return total


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
