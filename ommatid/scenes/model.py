"""The observation model g = H f + v: a sparse H with the variance of its every entry (Wood et al., Eq. 1).

H is (M, N): a row per sensor pixel in the order of measurements, a column per pixel of f, row by row. The H of a large
frame that boxes and kernels describe, ideal or calibrated, is not stored but applied by these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.errors import InputError, shortened

from .camera import Camera
from .constants import MOST_DENSE
from .fitted.fitted_matrix import Directions, FittedMatrix
from .observation import Entries, Observation, ObservationPart
from .optics.boxes import Box, designed_box
from .scene import Scene
from .shrinkage import shrunk_by_contrast

RECORDED = "recorded points"  # method of a model whose every entry was measured by itself
ROUNDED = 1e-6  # deviation of the sum of a row, about 1, that is float32's rounding
FEWEST_BATCHES = 4  # that have two halves with a variance each
MOST_STORED = 2**24  # entries of H; more are computed from boxes and kernels each time


@dataclass(frozen=True)
class Model:
    """H as `stored` (CSR, float64), or None where boxes and kernels apply it; `variance` of each stored entry.

    batches : (B, nnz) deviations of B independent estimates of the entries from their mean `stored`; B is 0 without
        uncertainty. Entries of recorded points have one: the standard deviation that the entries of a row share
    record : how H was determined: method, samples, seconds, agreement with the ideal model, fingerprint
    fitted : the few numbers from which entries of variance 0 follow, with their errors; None: every entry by itself
    """

    scene: Scene
    camera: Camera
    stored: sparse.csr_array | None
    variance: FloatArray
    batches: Float32Array
    record: dict[str, Any]
    fitted: FittedMatrix | None = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """Return size and method of H in one line."""
        return (
            f"<Model: H {self.measurements} x {self.unknowns}, {shortened(str(self.record.get('method', 'unknown')))}>"
        )

    @property
    def matrix(self) -> sparse.csr_array:
        """H. Raises InputError if it is too large to be stored."""
        if self.stored is None:
            raise InputError(
                f"H of {self.unknowns} pixels is too large to be stored; take estimator.method = 'frame' or 'tiles'"
            )
        return self.stored

    def to_sparse(self) -> sparse.csr_array:
        """H as a matrix with entries, (M, N), also where it is applied without them. Raises InputError if too large."""
        return self.observation.to_sparse()

    @cached_property
    def observation(self) -> Observation:
        """H as it is stored, or else by its boxes and kernels."""
        if self.stored is not None:
            return Observation(self.camera.shape, (Entries(self.stored, self.camera.shape),))
        if self.structure is None:
            raise TypeError("expected entries of an H that boxes and kernels do not describe")
        return self.structure

    @cached_property
    def structure(self) -> Observation | None:
        """H by boxes and kernels: as calibrated by few numbers, or as designed; None where these do not describe it."""
        if self.fitted is not None:
            return self.fitted.observation
        return designed_observation(self.camera) if self.record["method"] == "ideal" else None

    @property
    def applied(self) -> Observation:
        """The representation of H that is applied fastest: averages over boxes are faster than a matrix."""
        return self.observation if self.structure is None else self.structure

    @property
    def windowed(self) -> Observation:
        """The representation of H that windows are cut out of."""
        return self.applied if self.is_applied else self.observation

    @property
    def entries(self) -> int:
        """Number of entries of H, stored or not."""
        return self.observation.entries

    @property
    def is_exact(self) -> bool:
        """True if H is that of an ideal camera with box footprints."""
        designed = self.record["method"] == "ideal" if self.fitted is None else self.fitted.is_as_designed
        return designed and self.camera.has_box_footprints

    @property
    def is_applied(self) -> bool:
        """True if H is applied without entries: by boxes at every size, by kernels where it is large."""
        return self.stored is None or (self.structure is not None and _has_boxes(self.structure))

    @property
    def is_nearly_designed(self) -> bool:
        """True if H is the ideal one with box footprints, or differs from it too little to change an error map."""
        return self.is_exact or (self.fitted is not None and self.fitted.is_nearly_designed)

    @property
    def measurements(self) -> int:
        """M."""
        return self.camera.measurements

    @property
    def unknowns(self) -> int:
        """N."""
        return self.camera.unknowns

    def forward(self, image: FloatArray) -> FloatArray:
        """H f: (N,) or (rows, columns) to (M,)."""
        return self.observation.forward(image)

    def adjoint(self, measurements: FloatArray) -> FloatArray:
        """H^T g: (M,) to (N,)."""
        return self.observation.adjoint(measurements)

    def as_linear_operator(self) -> LinearOperator:
        """Return H as a SciPy linear operator, (M, N), for iterative solvers; H need not be stored."""
        return LinearOperator(
            (self.measurements, self.unknowns),
            matvec=lambda image: self.forward(image.ravel()),
            rmatvec=lambda measurements: self.adjoint(measurements.ravel()),
            dtype=np.float64,
        )

    def restrict(self, names: tuple[str, ...]) -> Model:
        """The model of only the named lens types, in its own order. Raises InputError for an unknown name."""
        camera, mask = self.camera.restrict(names)
        fitted = None if self.fitted is None else self.fitted.restrict(camera)
        if self.stored is None:
            return replace(self, camera=camera, fitted=fitted)
        stored = np.repeat(mask, np.diff(self.matrix.indptr))
        return replace(
            self,
            camera=camera,
            stored=self.matrix[mask],
            variance=self.variance[stored],
            batches=self.batches[:, stored],
            fitted=fitted,
            record={key: value for key, value in self.record.items() if key != "agreement"},  # of all lens types
        )

    @property
    def without_uncertainty(self) -> Model:
        """The same H, taken for exact."""
        fitted = None if self.fitted is None else self.fitted.without_errors
        return replace(self, variance=np.zeros_like(self.variance), batches=self.batches[:0], fitted=fitted)

    def errors(self, image: FloatArray) -> Directions | None:
        """Return the errors of H f by those of few numbers, None where H does not follow from such."""
        return self.fitted.errors(image) if self.fitted is not None and self.fitted.has_errors else None

    def variance_from_model(self, image: FloatArray, noise: Sequence[FloatArray] = ()) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement of `image`: (M,).

        The errors of a row cancel in its sum, since all its entries share their rays, so the rest is about
        sum over j of var_ij (f_j - m_i)^2, m_i the mean that the open part of pixel i sees; light that is lost beside
        the target is one more entry, where f is 0. Errors of neighbouring entries cancel too where the image is
        smooth; the scatter of H f over the batches, shrunk among pixels of a lens type with similar contrast, shows by
        how much.
        Entries of recorded points were measured one by one, and nothing cancels: sum over j of var_ij f_j^2, and the
        square of the sum of what they share.

        noise : random images with the noise of `image`, whose scatter is not that of the true image and is subtracted
        """
        if not self.variance.size:
            return np.zeros(self.measurements)
        flat = np.asarray(image, dtype=np.float64).ravel()
        contrast = flat[self.matrix.indices]
        level = self.matrix @ flat
        if self.record["method"] == RECORDED:
            return self._row_sums(self.variance * contrast**2) + self._shared_variance(contrast)
        level = level / self.camera.received
        variance = self._row_sums(self.variance * (contrast - level[self._rows]) ** 2)
        count = len(self.batches)
        if count < 2:
            return variance
        variance += self._lost_variance * level**2
        scatter = self.scatter(flat)
        excess = sum((self.scatter(image) for image in noise), np.zeros(self.measurements)) / max(len(noise), 1)
        return shrunk_by_contrast(variance, scatter, excess, self.camera.type_slices(), count)

    def scatter(self, image: FloatArray) -> FloatArray:
        """Variance of H f of one image, (N,), by the batches alone, where there are two or more: (M,)."""
        level, count = self.matrix @ image / self.camera.received, len(self.batches)
        contrast = image[self.matrix.indices] - level[self._rows]
        squares = (
            np.square(self._row_sums(batch * contrast) + lost * level)
            for batch, lost in zip(self.batches, self._lost, strict=True)
        )
        return sum(squares, np.zeros(self.measurements)) / (count * (count - 1))

    @cached_property
    def _lost(self) -> FloatArray:
        """Deviations of the sum of each row, (B, M), from light lost beside the target; 0 where float32 rounds it."""
        sums = np.array([self._row_sums(batch) for batch in self.batches]).reshape(-1, self.measurements)
        return np.where(np.abs(sums) > ROUNDED, sums, 0.0)

    @cached_property
    def _lost_variance(self) -> FloatArray:
        """Variance of the sum of each row, (M,)."""
        count = len(self.batches)
        if count < 2:
            return np.zeros(self.measurements)
        return np.square(self._lost).sum(axis=0) / (count * (count - 1))

    @cached_property
    def _rows(self) -> IntArray:
        """The measurement of each stored entry, (nnz,)."""
        return np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))

    @property
    def has_error_halves(self) -> bool:
        """True if each half of the batches has a variance of its own."""
        return len(self.batches) >= FEWEST_BATCHES

    @property
    def error_halves(self) -> tuple[list[sparse.csr_array], list[sparse.csr_array]]:
        """Errors of H by either half of the batches, (M, N) each, where there are such halves.

        The products of a half's errors with themselves add up to an estimate of the covariance of H.
        """
        return self._errors(self.batches[0::2]), self._errors(self.batches[1::2])

    def _errors(self, batches: Float32Array) -> list[sparse.csr_array]:
        kept = self.matrix
        scaled = (batches - batches.mean(axis=0)) / np.float32(((len(batches) - 1) * len(self.batches)) ** 0.5)
        return [sparse.csr_array((errors, kept.indices, kept.indptr), shape=kept.shape) for errors in scaled]

    def spurious_information(self, noise_variance: FloatArray) -> FloatArray:
        """Information on each pixel that the noise of H alone appears to bring: (N,), sum over i of var_ij / Rv_i.

        An estimator that takes H for exact overestimates the information on each pixel by this much.
        """
        if not self.variance.size:
            return np.zeros(self.unknowns)
        weights = self.variance / noise_variance[self._rows]
        return np.bincount(self.matrix.indices, weights=weights, minlength=self.unknowns).astype(np.float64)

    def prior_variance_from_model(self, prior_variance: FloatArray, prior_mean: float = 0.0) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement under the prior: (M,), sum of var_ij P0_j.

        prior_variance : (N,) of the pixels of f;  prior_mean : of every pixel, which light lost beside the target shows
        """
        if not self.variance.size:
            return np.zeros(self.measurements)
        variance = self._row_sums(self.variance * prior_variance[self.matrix.indices])
        if self.record["method"] == RECORDED:
            level = np.sqrt(prior_variance + prior_mean**2)[self.matrix.indices]
            return variance + self._row_sums(self.variance) * prior_mean**2 + self._shared_variance(level)
        return variance + self._lost_variance * prior_mean**2

    def _shared_variance(self, values: FloatArray) -> FloatArray:
        """Variance of H f by the errors that recorded entries of a row share; values : (nnz,) of f at the entries."""
        return sum((self._row_sums(batch * values) ** 2 for batch in self.batches), np.zeros(self.measurements))

    def _row_sums(self, entries: FloatArray) -> FloatArray:
        return np.bincount(self._rows, weights=entries, minlength=self.measurements).astype(np.float64)


@lru_cache(maxsize=1)  # a scene's model is made of it, and reads it again
def designed_observation(camera: Camera) -> Observation | None:
    """Return H as designed by boxes and kernels; None where it has entries, or kernels that only a model holds."""
    if not camera.has_structure or camera.has_surfaces:
        return None
    parts: list[ObservationPart] = []
    for lens_type in camera.on_grids.types:
        if camera.has_boxes(lens_type):
            parts.append(designed_box(camera.shape, lens_type))
        else:
            from .optics.lens_kernels import kernels

            parts.append(kernels(camera.on_grids, lens_type))
    return Observation(camera.shape, tuple(parts))


def is_stored(structure: Observation | None) -> bool:
    """Return True if an H of this structure is stored with its entries: it has no other form, or is small."""
    if structure is None:
        return True
    return structure.entries <= MOST_STORED if _has_boxes(structure) else structure.unknowns <= MOST_DENSE


def _has_boxes(structure: Observation) -> bool:
    return all(isinstance(part, Box) for part in structure.parts)


@dataclass(frozen=True)
class MeasuredRows:
    """Rows of H of sub-imagers that no few numbers explain, (M, N) with all other rows empty; see `Model`."""

    matrix: sparse.csr_array
    variance: FloatArray
    batches: Float32Array

    def only(self, rows: BoolArray) -> MeasuredRows:
        """Return the rows where `rows`, (M,), is true; all others are empty."""
        counts = np.diff(self.matrix.indptr)
        kept, starts = np.repeat(rows, counts), np.concatenate([[0], np.cumsum(np.where(rows, counts, 0))])
        arrays = self.matrix.data[kept], self.matrix.indices[kept], starts
        matrix = sparse.csr_array(arrays, shape=self.matrix.shape)
        return MeasuredRows(matrix, self.variance[kept], self.batches[:, kept])

    def joined(self, other: MeasuredRows) -> MeasuredRows:
        """Return the rows of both, each of which is empty in one of them; entries of value 0 stay."""
        parts = self.matrix, other.matrix
        rows = np.concatenate([np.repeat(np.arange(part.shape[0]), np.diff(part.indptr)) for part in parts])
        order = np.argsort(rows, kind="stable")
        data, indices = (np.concatenate([getattr(part, name) for part in parts])[order] for name in ("data", "indices"))
        matrix = sparse.csr_array((data, indices, parts[0].indptr + parts[1].indptr), shape=parts[0].shape)
        variance = np.concatenate([self.variance, other.variance])[order]
        return MeasuredRows(matrix, variance, np.concatenate([self.batches, other.batches], axis=1)[:, order])


def fitted_model(
    scene: Scene, camera: Camera, fitted: FittedMatrix, rest: MeasuredRows | None, record: dict[str, Any]
) -> Model:
    """Return the model; H by boxes and kernels is stored only while it is small."""
    if rest is None:
        entries = fitted.to_sparse() if is_stored(fitted.observation) else None
        count = 0 if entries is None else int(entries.nnz)
        return Model(scene, camera, entries, np.zeros(count), np.zeros((0, count), np.float32), record, fitted=fitted)
    explained = fitted.to_sparse()
    exact = MeasuredRows(explained, np.zeros(explained.nnz), np.zeros((len(rest.batches), explained.nnz), np.float32))
    rows = exact.joined(rest)
    return Model(scene, camera, rows.matrix, rows.variance, rows.batches, record, fitted=fitted)


def measured_rows(model: Model) -> MeasuredRows | None:
    """Return the rows of a model that were measured entry by entry, None where there are none."""
    fitted = model.fitted
    if fitted is None or model.stored is None or all(views.explained.all() for views in fitted.views.values()):
        return None
    named = [views.explained for views in (fitted.views[lens.name] for lens in model.camera.types)]
    explained = np.concatenate(named)
    sizes = [place.stop - place.start for place in model.camera.slices()]
    return MeasuredRows(model.stored, model.variance, model.batches).only(np.repeat(~explained, sizes))
