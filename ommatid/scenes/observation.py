"""The action of H on images and on windows of them, by parts (Wood et al., Eq. 1).

A part is H of a lens type, or of one of its sub-imagers: averages over boxes, correlations with kernels, or entries.
H f and H^T g need no matrix; where a part of one is needed, it is made. Kernels of all parts share one Fourier
transform of the image.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product, starmap
from math import gcd
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import processors

from .lens_type import adjacent_slices

if TYPE_CHECKING:
    from .camera import Camera

ComplexArray = NDArray[np.complexfloating[Any]]
Precision = type[np.float32] | type[np.float64]
Value = TypeVar("Value")
GROUPS = 8  # of parts that are computed side by side, whatever the number of threads
EMPTY = -1  # first and last pixel seen by a measurement that sees none: outside every window


class Seen:
    """An image, (rows, columns), and its Fourier transform on a grid of `padded` rows and columns."""

    def __init__(self, image: FloatArray, padded: tuple[int, int]) -> None:
        """Take the grid on which kernels of all parts act without reaching around."""
        self.image, self.padded = image, padded
        self._spectra: dict[Precision, ComplexArray] = {}

    def spectrum(self, precision: Precision) -> ComplexArray:
        """Return the transform in float32 or float64, which is computed when a part first needs it."""
        if precision not in self._spectra:
            image = np.asarray(self.image, dtype=precision)
            self._spectra[precision] = np.asarray(fft.rfft2(image, self.padded, workers=processors()))
        return self._spectra[precision]


class Back:
    """A sum of H^T g over parts: those that add pixels, and those that add Fourier coefficients."""

    def __init__(self, shape: tuple[int, int], padded: tuple[int, int]) -> None:
        """Begin with 0."""
        self.shape, self.padded = shape, padded
        self._image: FloatArray | None = None
        self._spectrum: ComplexArray | None = None

    def add(self, other: Back) -> None:
        """Add another sum, which is not needed any more."""
        if other._image is not None:
            self.add_image(other._image)
        if other._spectrum is not None:
            self.add_spectrum(other._spectrum)

    def add_image(self, image: FloatArray) -> None:
        """Add an image, (rows, columns), which is not needed any more."""
        if self._image is None:
            self._image = image
        else:
            self._image += image

    def add_spectrum(self, spectrum: ComplexArray) -> None:
        """Add the coefficients of an image on the padded grid, which are not needed any more."""
        if self._spectrum is None:
            self._spectrum = spectrum
        else:
            self._spectrum += spectrum

    @property
    def total(self) -> FloatArray:
        """The sum: (rows, columns)."""
        if self._spectrum is not None:
            whole = np.asarray(fft.irfft2(self._spectrum, self.padded, workers=processors(), overwrite_x=True))
            self.add_image(np.ascontiguousarray(whole[: self.shape[0], : self.shape[1]]))
            self._spectrum = None
        return np.zeros(self.shape) if self._image is None else self._image


class ObservationPart(ABC):
    """H of some measurements, (m, N), that follow one another."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""

    @property
    @abstractmethod
    def measurements(self) -> int:
        """Return m."""

    @property
    @abstractmethod
    def entries(self) -> int:
        """Number of entries other than 0, or an upper bound of it."""

    @property
    @abstractmethod
    def reach(self) -> int:
        """Largest number of rows or of columns of f that a measurement spans."""

    @property
    def spacing(self) -> int:
        """Pixels of f between neighbouring readings along an axis, a common factor of which divides the padded grid."""
        return 1

    @property
    def is_slow(self) -> bool:
        """True if its work is worth a thread of its own, and shares no transform with that of other parts."""
        return False

    @property
    def cheaper(self) -> ObservationPart:
        """About the same H in fewer or faster operations, with its exact transpose; itself where there are none."""
        return self

    @abstractmethod
    def forward(self, seen: Seen, out: FloatArray) -> None:
        """Write H f to `out`, (m,)."""

    @abstractmethod
    def adjoint(self, readings: FloatArray, back: Back) -> None:
        """Add H^T g to `back`; readings : (m,)."""

    @abstractmethod
    def to_sparse(self) -> sparse.csr_array:
        """Return H as a matrix: (m, N)."""

    @abstractmethod
    def coarser(self, camera: Camera, detail: int) -> ObservationPart:
        """Return H of images of `detail` times larger pixels; camera : on their grid."""

    @abstractmethod
    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Return the indices of the measurements that see a window of f and nothing beside it."""

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to the measurements inside it."""
        return self.rows_on(self.measurements_inside(rows, columns), rows, columns)

    def rows_on(self, numbers: IntArray, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to some measurements; what they see beside it is left out."""
        inside = self.measurements_inside(rows, columns)
        if not np.isin(numbers, inside).all():
            return on_window(self.to_sparse()[numbers], self.shape[1], rows, columns)
        order = np.argsort(inside)
        return self.submatrix(rows, columns)[order[np.searchsorted(inside, numbers, sorter=order)]]

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """Return a key that is equal for two windows only if their submatrices are equal: by default the window."""
        return rows.start, columns.start


@dataclass(frozen=True)
class Entries(ObservationPart):
    """H as a matrix: (m, N)."""

    matrix: sparse.csr_array
    grid: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.grid

    @property
    def measurements(self) -> int:
        """Return m."""
        return int(self.matrix.shape[0])

    @property
    def entries(self) -> int:
        """Number of entries."""
        return int(self.matrix.nnz)

    @cached_property
    def _extents(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """The first and last row, first and last column of f that each measurement sees, (m,) each; EMPTY if none."""
        row, column = np.divmod(self.matrix.indices.astype(np.int64), self.grid[1])
        nonempty = np.diff(self.matrix.indptr) > 0
        starts = self.matrix.indptr[:-1][nonempty]
        found = [np.full(nonempty.size, EMPTY) for _ in range(4)]
        for extent, (values, extreme) in zip(found, product((row, column), (np.minimum, np.maximum)), strict=True):
            extent[nonempty] = extreme.reduceat(values, starts)
        top, bottom, left, right = found
        return top, bottom, left, right

    @property
    def reach(self) -> int:
        """Largest number of rows or of columns of f that a measurement spans."""
        top, bottom, left, right = self._extents
        return int(max((bottom - top).max(), (right - left).max())) + 1

    def forward(self, seen: Seen, out: FloatArray) -> None:
        """Write H f to `out`, (m,)."""
        out[:] = self.matrix @ seen.image.ravel()

    def adjoint(self, readings: FloatArray, back: Back) -> None:
        """Add H^T g to `back`; readings : (m,)."""
        back.add_image((self.matrix.T @ readings).reshape(self.grid))

    def to_sparse(self) -> sparse.csr_array:
        """Return the matrix."""
        return self.matrix

    def coarser(self, camera: Camera, detail: int) -> Entries:
        """Return H of images of `detail` times larger pixels; camera : on their grid."""
        down, across = (repetition(size, detail) for size in camera.shape)
        return Entries(sparse.csr_array(self.matrix @ sparse.kron(down, across, format="csr")), camera.shape)

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Return the indices of the measurements that see nothing outside a window of f."""
        top, bottom, left, right = self._extents
        inside = (top >= rows.start) & (bottom < rows.stop) & (left >= columns.start) & (right < columns.stop)
        return np.flatnonzero(inside)

    def rows_on(self, numbers: IntArray, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to some measurements; what they see beside it is left out."""
        return on_window(self.matrix[numbers], self.grid[1], rows, columns)


@dataclass(frozen=True)
class Observation:
    """H of a camera, (M, N), by its parts in the order of measurements."""

    shape: tuple[int, int]
    parts: tuple[ObservationPart, ...]

    @cached_property
    def slices(self) -> list[slice]:
        """The measurements of each part."""
        return adjacent_slices(part.measurements for part in self.parts)

    @property
    def measurements(self) -> int:
        """Return M."""
        return self.slices[-1].stop

    @property
    def unknowns(self) -> int:
        """Return N."""
        return self.shape[0] * self.shape[1]

    @property
    def entries(self) -> int:
        """Number of entries of H, stored or not."""
        return sum(part.entries for part in self.parts)

    @cached_property
    def reach(self) -> int:
        """Largest number of rows or of columns of f that a measurement spans."""
        return max(part.reach for part in self.parts)

    @property
    def cheaper(self) -> Observation:
        """About the same H in fewer or faster operations; itself where there are none."""
        parts = tuple(part.cheaper for part in self.parts)
        return self if parts == self.parts else Observation(self.shape, parts)

    @cached_property
    def _padded(self) -> tuple[int, int]:
        return padded_shape(self.shape, self.reach, gcd(*(part.spacing for part in self.parts)))

    def forward(self, image: FloatArray) -> FloatArray:
        """Return H f: (N,) or (rows, columns) to (M,)."""
        grid = np.ascontiguousarray(image, dtype=np.float64).reshape(self.shape)
        seen, out = Seen(grid, self._padded), np.empty(self.measurements)

        def observe(group: slice) -> None:
            for part, place in zip(self.parts[group], self.slices[group], strict=True):
                part.forward(seen, out[place])

        for _ in self._each(observe):
            pass
        return out

    def adjoint(self, measurements: FloatArray) -> FloatArray:
        """Return H^T g: (M,) to (N,)."""
        readings = np.ascontiguousarray(measurements, dtype=np.float64)

        def spread(group: slice) -> Back:
            back = Back(self.shape, self._padded)
            for part, place in zip(self.parts[group], self.slices[group], strict=True):
                part.adjoint(readings[place], back)
            return back

        backs = self._each(spread)
        total = next(backs)
        for back in backs:
            total.add(back)
        return total.total.ravel()

    def _each(self, work: Callable[[slice], Value]) -> Iterator[Value]:
        """Yield the results of groups of parts, in their order; slow ones are computed side by side."""
        count = min(len(self.parts), GROUPS)
        if count == 1 or not all(part.is_slow for part in self.parts):
            yield work(slice(None))
            return
        edges = np.linspace(0, len(self.parts), count + 1).round().astype(int)
        with ThreadPoolExecutor(processors()) as threads:
            yield from threads.map(work, starmap(slice, pairwise(edges)))

    def coarser(self, camera: Camera, detail: int) -> Observation:
        """Return H of images of `detail` times larger pixels, each of which is made of equal ones.

        camera : on the grid of these images
        """
        return Observation(camera.shape, tuple(part.coarser(camera, detail) for part in self.parts))

    def to_sparse(self) -> sparse.csr_array:
        """Return H as a matrix: (M, N)."""
        return sparse.csr_array(sparse.vstack([part.to_sparse() for part in self.parts], format="csr"))

    def measurements_inside(self, rows: slice, columns: slice) -> IntArray:
        """Return the indices of the measurements that see nothing outside a window of f: (m,)."""
        pairs = zip(self.slices, self.parts, strict=True)
        return np.concatenate([place.start + part.measurements_inside(rows, columns) for place, part in pairs])

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to the measurements inside it: (m, pixels of the window)."""
        parts = [part.submatrix(rows, columns) for part in self.parts]
        return sparse.csr_array(sparse.vstack(parts, format="csr"))

    def rows_on(self, numbers: IntArray, rows: slice, columns: slice) -> sparse.csr_array:
        """Return H from a window of f to some measurements: (numbers, pixels of the window); see `ObservationPart`.

        numbers : in the order of the parts
        """
        pairs = zip(self.slices, self.parts, strict=True)
        chosen = [(place.start, part, (numbers >= place.start) & (numbers < place.stop)) for place, part in pairs]
        found = [part.rows_on(numbers[own] - start, rows, columns) for start, part, own in chosen if own.any()]
        empty = sparse.csr_array((0, (rows.stop - rows.start) * (columns.stop - columns.start)))
        return sparse.csr_array(sparse.vstack([empty, *found], format="csr"))

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """Return a key that is equal for two windows only if their submatrices are equal."""
        return tuple(part.signature(rows, columns) for part in self.parts)


def repetition(size: int, detail: int) -> sparse.csr_array:
    """Return the matrix that repeats each of `size` pixels of an axis `detail` times: (detail size, size)."""
    return sparse.csr_array(sparse.kron(sparse.eye_array(size), np.ones((detail, 1)), format="csr"))


def padded_shape(shape: tuple[int, int], reach: int, spacing: int) -> tuple[int, int]:
    """Return rows and columns of a grid with fast transforms that is larger by `reach`: multiples of `spacing`."""
    rows, columns = (spacing * fft.next_fast_len(-(-(size + reach) // spacing), real=True) for size in shape)
    return rows, columns


def on_lines(rows: sparse.csr_array, columns: sparse.csr_array, image: FloatArray) -> FloatArray:
    """Return rows @ image @ columns^T."""
    return (columns @ np.ascontiguousarray((rows @ image).T)).T


def on_window(matrix: sparse.csr_array, width: int, rows: slice, columns: slice) -> sparse.csr_array:
    """Return rows of H, (m, N), on a window without what they see beside it: (m, pixels of the window).

    width : columns of f
    """
    row, column = np.divmod(matrix.indices, width)
    inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
    shape = rows.stop - rows.start, columns.stop - columns.start
    indices = ((row - rows.start) * shape[1] + column - columns.start)[inside]
    pointers = np.concatenate([[0], np.cumsum(inside)])[matrix.indptr]
    return sparse.csr_array((matrix.data[inside], indices, pointers), shape=(matrix.shape[0], shape[0] * shape[1]))
