"""Calibration by few numbers from recorded point sources: views in place of the entries that they explain.

The entries have variances and no batches of rays, so that random draws of their errors take the place of batches: of
every entry, and of the dark level that those of a row share. Sub-imagers that no view explains keep their entries.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.hardware.point_sources import UNKNOWN_VARIANCE
from ommatid.scenes.model import Model, fitted_model, measured_rows

from ...sampling.passes import Plan
from ..responses import Responses
from .fit import calibrate_by_fit, is_sharp

DRAWS = 32  # of errors: with few, the F test refuses more than its significance says
RAYS = 2**14  # per pixel, of light that is not sampled by rays: what single ones would decide is far below any noise


def fit_recorded(model: Model) -> Model:
    """Return the model with views wherever they explain the recorded entries of H; itself where they do nowhere.

    Entries without noise need no views.
    """
    camera = model.camera
    if not (model.variance > 0).all() or not any(is_sharp(camera, lens_type) for lens_type in camera.types):
        return model
    responses = _responses(model)
    fit = calibrate_by_fit(
        camera,
        lambda _: responses,
        lambda each: each.variance,
        {lens_type.name: RAYS for lens_type in camera.types},
        with_kernels=False,
        recorded=True,
    )
    if not fit.record["accepted"]:
        return model
    rest = measured_rows(replace(model, fitted=fit.matrix))
    found = {key: value for key, value in fit.record.items() if key != "chart"}  # all rows were measured
    return fitted_model(model.scene, camera, fit.matrix, rest, model.record | {"fit": found})


def _responses(model: Model) -> Responses:
    """Return the entries with random errors as batches; rows that have entries without a reading are left out."""
    matrix = model.matrix
    lengths = np.diff(matrix.indptr)
    rows = np.repeat(np.arange(model.measurements), lengths)
    unknown = np.bincount(rows, model.variance >= UNKNOWN_VARIANCE, model.measurements) > 0
    kept = ~unknown[rows]
    rng = probe(Purpose.RECORDED_ERRORS)
    errors = rng.normal(size=(DRAWS, matrix.nnz)) * np.sqrt(model.variance)
    for shared in model.batches:
        errors += rng.normal(size=(DRAWS, model.measurements))[:, rows] * shared
    errors = DRAWS**0.5 * (errors - errors.mean(axis=0))
    starts = np.concatenate([[0], np.cumsum(np.where(unknown, 0, lengths))])
    received = model.camera.received[rows][kept]
    measured = sparse.csr_array((matrix.data[kept] / received, matrix.indices[kept], starts), shape=matrix.shape)
    batches = (errors[:, kept] / received).astype(np.float32)
    return Responses(Plan(DRAWS, 1), {}, measured, model.variance[kept] / np.square(received), batches)
