"""A model from few numbers, and the entries of the sub-imagers that these do not explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array, FloatArray

from ..camera import Camera
from ..model import Model
from ..optics.boxes import MOST_STORED
from ..scene import Scene
from .fitted_matrix import FittedMatrix


@dataclass(frozen=True)
class MeasuredRows:
    """Rows of H of sub-imagers that no few numbers explain, (M, N) with all other rows empty; see `Model`."""

    matrix: sparse.csr_array
    variance: FloatArray
    batches: Float32Array


def fitted_model(
    scene: Scene, camera: Camera, fitted: FittedMatrix, rest: MeasuredRows | None, record: dict[str, Any]
) -> Model:
    """Return the model; H with box footprints is stored only while it is small."""
    if rest is None:
        entries = None
        if not fitted.is_boxes or fitted.boxes.entries <= MOST_STORED:
            entries = fitted.to_sparse()
        count = 0 if entries is None else int(entries.nnz)
        return Model(scene, camera, entries, np.zeros(count), np.zeros((0, count), np.float32), record, fitted=fitted)
    explained = fitted.to_sparse()
    matrix = sparse.csr_array(explained + rest.matrix)
    rows = np.repeat(np.diff(rest.matrix.indptr) > 0, np.diff(matrix.indptr))  # stored in rows that were measured
    variance, batches = np.zeros(matrix.nnz), np.zeros((len(rest.batches), matrix.nnz), np.float32)
    variance[rows], batches[:, rows] = rest.variance, rest.batches
    return Model(scene, camera, matrix, variance, batches, record, fitted=fitted)


def measured_rows(model: Model) -> MeasuredRows | None:
    """Return the rows of a model that were measured entry by entry, None where there are none."""
    fitted = model.fitted
    if fitted is None or model.stored is None or all(views.explained.all() for views in fitted.views.values()):
        return None
    named = [views.explained for views in (fitted.views[lens.name] for lens in model.camera.types)]
    explained = np.concatenate(named)
    sizes = [place.stop - place.start for place in model.camera.slices()]
    counts = np.diff(model.stored.indptr)
    kept = np.repeat(np.repeat(~explained, sizes), counts)
    indptr = np.concatenate([[0], np.cumsum(counts * np.repeat(~explained, sizes))])
    arrays = (model.stored.data[kept], model.stored.indices[kept], indptr)
    matrix = sparse.csr_array(arrays, shape=model.stored.shape)
    return MeasuredRows(matrix, model.variance[kept], model.batches[:, kept])
