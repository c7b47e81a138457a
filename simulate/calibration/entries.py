"""H entry by entry, from rays or rendered point sources, each entry with its variance."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from scipy import sparse, special

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances

from ..ideal import ideal_matrix
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import rounding_variance
from .point_sources import Plans, Responses, responses_from_points


def rendered_model(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    plans: Plans | None = None,
    float64: bool = False,
) -> Model:
    """Determine H by rays or point sources, with the samples of the scene or of the plans of the lens types.

    float64 : True if the renderer sums in float64, whose rounding is then neglected
    """
    scene, camera, start = setup.scene, setup.camera, perf_counter()
    record = dict[str, Any](method=scene.calibration.method)
    if scene.calibration.method == "transport":
        from .ray_transport import responses_from_rays

        responses = responses_from_rays(setup, progress, plans)
    else:
        responses = responses_from_points(setup, progress, checkpoint, plans)
    if float64:
        responses = replace(responses, float32_samples=1)
    variance = entry_variances(responses, camera)
    if scene.calibration.fit == "geometry":
        from .geometry_fit import fit_geometry

        responses, variance, record["fit"] = fit_geometry(responses, variance, setup.simulated)
    record |= {
        "seconds": perf_counter() - start,
        "seed": scene.render.seed,
        **responses.record(),
        **_compared(responses, variance, camera),
        "versions": versions("mitsuba", "drjit", "scipy"),
    }
    return Model(setup.resolved, camera, responses.matrix, variance, responses.batches, record)


def _compared(responses: Responses, variance: FloatArray, camera: Camera) -> dict[str, Any]:
    """Compare H with the ideal one, if that has a closed form."""
    bent = (lens for lens in camera.types if lens.optics.distortion is not None or lens.is_rotated)
    if not camera.walls or any(camera.is_blurred(lens) for lens in bent):
        return {}
    return {"agreement": agreement(responses.matrix, variance, camera, responses.passes)}


def entry_variances(responses: Responses, camera: Camera) -> FloatArray:
    """Return the variances of H's entries, shrunk towards their sub-imager's mean and never below rounding."""
    starts = responses.matrix.indptr
    shrunk = np.empty_like(responses.variance)
    for rows in camera.slices():
        stored = slice(int(starts[rows.start]), int(starts[rows.stop]))
        shrunk[stored] = shrink_variances(responses.variance[stored], responses.passes)
    summed = responses.samples if responses.float32_samples is None else responses.float32_samples
    return np.maximum(shrunk, rounding_variance(responses.matrix.data, summed))


def agreement(matrix: sparse.csr_array, variance: FloatArray, camera: Camera, passes: int) -> dict[str, float]:
    """Compare H with the ideal one: RMS difference, largest z, and the chance of a larger z (Sidak).

    Over every entry that either of them has. The chance takes z as Student's t with one degree fewer than passes.
    """
    difference = sparse.csr_array(matrix - ideal_matrix(camera))
    entries = int(difference.nnz)
    if not entries:
        return {"rms_difference_from_ideal": 0.0, "max_z": 0.0, "p_value": 1.0}
    known = sparse.csr_array((variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    # Where no ray has hit there is no scatter either: such an entry counts as uncertain as the others are on average.
    unseen = float(variance.mean())
    variances = np.asarray(known[difference.nonzero()], dtype=np.float64).ravel()
    variances[variances == 0] = unseen
    values = np.asarray(difference[difference.nonzero()], dtype=np.float64).ravel()
    largest = float(np.max(np.abs(values) / np.sqrt(variances), initial=0.0))
    single = 2 * float(special.stdtr(passes - 1, -largest))
    chance = -np.expm1(entries * np.log1p(-single)) if single < 1 else 1.0
    rms = float(np.sqrt((difference.data**2).sum() / max(entries, 1)))
    return {"rms_difference_from_ideal": rms, "max_z": largest, "p_value": float(chance)}
