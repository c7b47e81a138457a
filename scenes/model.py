"""The observation model g = H f + v: a sparse H with the variance of its every entry (Wood et al., Eq. 1).

H is (M, N): a row a sensor pixel in the order of measurements, a column a pixel of f, row by row. The ideal
H of a large frame is not stored, it follows from the scene.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from ommatid.runtime.errors import InputError

from .camera import Camera
from .optics.boxes import BoxFootprints
from .scene import Scene
from .shrinkage import shrink_variances

Vector = NDArray[np.float64]

ENTRIES = ("indices", "indptr", "data")
ALIKE = 200  # pixels of like contrast, at least, whose scatter is moderated together
MOST_KINDS = 24  # such groups of a lens type, at most
RECORDED = "recorded points"  # the method of a model whose every entry was read by itself
NOWHERE = -1  # what a measurement sees that sees nothing: no window has it


@dataclass(frozen=True)
class Model:
    """H as `stored` (CSR, float64), or None where it follows from the camera; `variance` of each stored entry.

    `batches`, (B, nnz), are deviations from `stored` of B independent estimates of it whose mean it is; without
    uncertainty there are none. `record` says how it was found: method, samples, seconds, agreement with the ideal
    model, fingerprint.
    """

    scene: Scene
    camera: Camera
    stored: sparse.csr_array | None
    variance: Vector
    batches: NDArray[np.float32]
    record: dict[str, Any]

    @property
    def matrix(self) -> sparse.csr_array:
        """H. Raises InputError where it is too large to be stored."""
        if self.stored is None:
            raise InputError(
                f"H of {self.unknowns} pixels is too large to be stored; take estimator.method = 'frame' or 'tiles'"
            )
        return self.stored

    @property
    def entries(self) -> int:
        """Of H, stored or not."""
        return self.boxes.entries if self.stored is None else int(self.stored.nnz)

    @property
    def is_exact(self) -> bool:
        """Whether H is that of a perfect camera of pinholes, and so follows from its geometry."""
        return self.record["method"] == "ideal" and self.camera.has_box_footprints

    @cached_property
    def boxes(self) -> BoxFootprints:
        """H of a perfect camera, whatever this one is."""
        return BoxFootprints(self.camera)

    @property
    def measurements(self) -> int:
        """M."""
        return self.camera.measurements

    @property
    def unknowns(self) -> int:
        """N."""
        return self.camera.unknowns

    def forward(self, image: Vector) -> Vector:
        """H f: (N,) or (rows, columns) to (M,)."""
        if self.stored is None:
            return self.boxes.forward(image)
        return self.stored @ np.asarray(image, dtype=np.float64).ravel()

    def adjoint(self, measurements: Vector) -> Vector:
        """H^T g: (M,) to (N,)."""
        if self.stored is None:
            return self.boxes.adjoint(measurements)
        return self.stored.T @ np.asarray(measurements, dtype=np.float64)

    def as_linear_operator(self) -> LinearOperator:
        """Return H as a SciPy linear operator, (M, N), for iterative solvers; H need not be stored."""
        if self.stored is not None:
            return aslinearoperator(self.stored)
        return LinearOperator(
            (self.measurements, self.unknowns),
            matvec=lambda image: self.forward(image.ravel()),
            rmatvec=lambda measurements: self.adjoint(measurements.ravel()),
            dtype=np.float64,
        )

    def measurements_inside(self, rows: slice, columns: slice) -> NDArray[np.int64]:
        """Which measurements see nothing but a window of f: (m,)."""
        if self.is_exact:
            return self.boxes.measurements_inside(rows, columns)
        top, bottom, left, right = self._reach
        inside = (top >= rows.start) & (bottom < rows.stop) & (left >= columns.start) & (right < columns.stop)
        return np.flatnonzero(inside)

    def submatrix(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H of the window from these measurements: (m, pixels of the window)."""
        if self.is_exact:
            return self.boxes.submatrix(rows, columns)
        some = self.matrix[self.measurements_inside(rows, columns)]
        row, column = np.divmod(some.indices, self.camera.columns)
        shape = rows.stop - rows.start, columns.stop - columns.start
        indices = (row - rows.start) * shape[1] + column - columns.start
        return sparse.csr_array((some.data, indices, some.indptr), shape=(some.shape[0], shape[0] * shape[1]))

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """What two windows have in common whose `part` is the same."""
        return self.boxes.signature(rows, columns) if self.is_exact else (rows.start, columns.start)

    @property
    def reach(self) -> int:
        """Rows or columns of f, whichever are more, that the widest measurement sees."""
        if self.stored is None:
            return max(ceil(kind.ratio) + 1 for kind in self.camera.types)
        top, bottom, left, right = self._reach
        return int(max((bottom - top).max(), (right - left).max())) + 1

    @cached_property
    def _reach(self) -> tuple[NDArray[np.int64], ...]:
        """First and last row, first and last column of f that each measurement sees; none where it sees nothing."""
        row, column = np.divmod(self.matrix.indices.astype(np.int64), self.camera.columns)
        seen = np.diff(self.matrix.indptr) > 0
        starts = self.matrix.indptr[:-1][seen]
        found = [np.full(seen.size, NOWHERE) for _ in range(4)]
        for ends, (pick, values) in zip(found, product((np.minimum, np.maximum), (row, column)), strict=True):
            ends[seen] = pick.reduceat(values, starts)
        return found[0], found[2], found[1], found[3]

    def restrict(self, names: tuple[str, ...]) -> Model:
        """Only the named lens types, in the model's own order. Raises InputError for a name it does not have."""
        camera, kept = self.camera.restrict(names)
        if self.stored is None:
            return replace(self, camera=camera)
        stored = np.repeat(kept, np.diff(self.matrix.indptr))
        return replace(
            self,
            camera=camera,
            stored=self.matrix[kept],
            variance=self.variance[stored],
            batches=self.batches[:, stored],
            record={key: value for key, value in self.record.items() if key != "agreement"},  # of all types
        )

    def variance_from_model(self, image: Vector) -> Vector:
        """Variance that the uncertainty of H adds to each measurement of `image`: (M,).

        The errors of a row cancel in its sum, since all its entries share their rays, so what is left is about
        sum over j of var_ij (f_j - (H f)_i)^2. Neighbouring entries' errors cancel too, which smooth images notice:
        the scatter of H f over the batches, moderated among pixels of a lens type with like contrast, says by how much.
        Entries of recorded points were read one by one, and nothing cancels: sum over j of var_ij f_j^2.
        """
        flat = np.asarray(image, dtype=np.float64).ravel()
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        away = flat[self.matrix.indices]
        if self.record["method"] != RECORDED:
            away = away - (self.matrix @ flat)[rows]
        trend = self._row_sums(rows, self.variance * away**2)
        count = len(self.batches)
        if count < 2:
            return trend
        seen = sum((self._row_sums(rows, batch * away) ** 2 for batch in self.batches), np.zeros(self.measurements))
        seen /= count * (count - 1)
        if self.record.get("fit"):
            # Entries that a few fitted numbers make go together in ways that no sum over entries knows.
            return seen
        for kind in self.camera.type_slices():
            place = kind.start + np.flatnonzero(trend[kind] > 0)
            # Strong contrast lets errors cancel otherwise than weak one does, so that like is compared with like.
            for alike in np.array_split(place[np.argsort(trend[place])], max(1, min(place.size // ALIKE, MOST_KINDS))):
                if alike.size:
                    trend[alike] *= shrink_variances(seen[alike] / trend[alike], count)
        return trend

    def spurious_information(self, noise_variance: Vector) -> Vector:
        """Information on each pixel that the noise of H alone would seem to bring: (N,), sum over i of var_ij / Rv_i.

        Where the measurements leave a pixel open, an estimator that takes H for exact believes this much too much.
        """
        if not self.variance.size:
            return np.zeros(self.unknowns)
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        weights = self.variance / noise_variance[rows]
        return np.bincount(self.matrix.indices, weights=weights, minlength=self.unknowns).astype(np.float64)

    def prior_variance_from_model(self, prior_variance: Vector) -> Vector:
        """The same before anything is known of the image but the (N,) variance of its pixels: sum of var_ij P0_j."""
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        return self._row_sums(rows, self.variance * prior_variance[self.matrix.indices])

    def _row_sums(self, rows: NDArray[np.int64], entries: Vector) -> Vector:
        return np.bincount(rows, weights=entries, minlength=self.measurements).astype(np.float64)
