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
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.model import MeasuredRows, Model, fitted_model
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances

from ..ideal import ideal_matrix
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import Plans, rounding_variance
from ..validation import check_entries
from .fit.chart import SIDE
from .responses import Responses, Subsets, measured, same_plans


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

    def measure(subsets: Subsets | None) -> Responses:
        if setup.is_applied:  # then no memory was asked for entries
            whole = [lens for lens in camera.types if subsets is None or _is_whole(subsets, lens)]
            check_entries(setup, whole, "few numbers do not explain all of H: ")
        by_points = setup.renders_points
        return measured(
            setup, by_points=by_points, progress=progress, checkpoint=checkpoint, plans=plans, subsets=subsets
        )

    def variances(responses: Responses) -> FloatArray:
        return entry_variances(responses, camera, 1 if float64 else responses.work.samples)

    if fits(setup):
        from .fit.fit import calibrate_by_fit

        rays = {name: work.total for name, work in (plans or same_plans(setup)).items()}
        views_alone = scene.calibration.fit == "geometry"
        fit = calibrate_by_fit(setup.simulated, measure, variances, rays, with_kernels=not views_alone)
        record |= {"fit": fit.record, **fit.responses.record}
        rest = None if fit.rest is None else _received(camera, fit.rest)
        model = fitted_model(setup.resolved, camera, fit.matrix, rest, record)
    else:
        responses = measure(None)
        rows = _received(camera, MeasuredRows(responses.matrix, variances(responses), responses.batches))
        record |= responses.record
        model = Model(setup.resolved, camera, rows.matrix, rows.variance, rows.batches, record)
    seconds = perf_counter() - start
    record = model.record | {
        "seconds": seconds,
        "seed": scene.render.seed,
        **_compared(model, camera, model.record["passes"]),
        "versions": versions("mitsuba", "drjit", "scipy"),
    }
    return replace(model, record=record)


def _received(camera: Camera, rows: MeasuredRows) -> MeasuredRows:
    """Return rows of H from the shares of the rays of open parts that meet pixels of f."""
    lengths = np.diff(rows.matrix.indptr)
    received = np.repeat(camera.received, lengths)
    matrix = sparse.csr_array((received * rows.matrix.data, rows.matrix.indices, rows.matrix.indptr), rows.matrix.shape)
    return MeasuredRows(matrix, np.square(received) * rows.variance, np.float32(received) * rows.batches)


def _is_whole(subsets: Subsets, lens_type: LensType) -> bool:
    """Return True if more of a lens type is measured than a chart has."""
    subset = subsets.get(lens_type.name, np.zeros(0))
    return subset is None or subset.size > lens_type.count * SIDE**2


def fits(setup: Setup) -> bool:
    """Return True if the scene's H is to follow from few numbers where these explain it."""
    return setup.scene.calibration.fit != "none" and setup.simulated.walls


def _compared(model: Model, camera: Camera, passes: int) -> dict[str, Any]:
    """Compare H with the ideal one, if that has a closed form which takes less time than the calibration."""
    if camera.has_surfaces and camera.unknowns > MOST_DENSE:
        return {}
    bent = (lens for lens in camera.types if lens.optics.distortion is not None or lens.is_rotated)
    if not camera.walls or any(camera.is_blurred(lens) for lens in bent):
        return {}
    if model.fitted is None or model.variance.any():
        return {"agreement": agreement(model.matrix, model.variance, camera, passes)}
    largest, count = model.fitted.largest_deviation
    chance = -np.expm1(count * np.log1p(-2 * special.ndtr(-largest))) if largest else 1.0
    compared = {"max_z": largest, "p_value": float(chance)}
    if model.is_exact:
        return {"agreement": {"rms_difference_from_ideal": 0.0, **compared}}
    if model.stored is None:
        return {}
    difference = sparse.csr_array(model.matrix - ideal_matrix(camera))
    rms = float(np.sqrt(np.square(difference.data).sum() / max(int(difference.nnz), 1)))
    return {"agreement": {"rms_difference_from_ideal": rms, **compared}}


def entry_variances(responses: Responses, camera: Camera, summed: int) -> FloatArray:
    """Return the variances of H's entries, shrunk towards their sub-imager's mean and never below rounding.

    summed : samples that are summed in float32
    """
    starts = responses.matrix.indptr
    shrunk = np.empty_like(responses.variance)
    for rows in camera.slices():
        stored = slice(int(starts[rows.start]), int(starts[rows.stop]))
        shrunk[stored] = shrink_variances(responses.variance[stored], responses.work.passes)
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
    unseen = float(variance.mean()) if variance.size else np.inf
    variances = np.asarray(known[difference.nonzero()], dtype=np.float64).ravel()
    variances[variances == 0] = unseen
    values = np.asarray(difference[difference.nonzero()], dtype=np.float64).ravel()
    largest = float(np.max(np.abs(values) / np.sqrt(variances), initial=0.0))
    single = 2 * float(special.stdtr(passes - 1, -largest))
    chance = -np.expm1(entries * np.log1p(-single)) if single < 1 else 1.0
    rms = float(np.sqrt((difference.data**2).sum() / max(entries, 1)))
    return {"rms_difference_from_ideal": rms, "max_z": largest, "p_value": float(chance)}


def explains(setup: Setup) -> bool:
    """Return True if few numbers are expected to explain all of H."""
    if not fits(setup):
        return False
    from .fit.fit import has_chart

    with_kernels = setup.scene.calibration.fit != "geometry"
    return all(has_chart(setup.simulated, lens, with_kernels) for lens in setup.simulated.types)
