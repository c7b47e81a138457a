"""H with the uncertainty of its every entry, from rendered point sources or in closed form."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

from scenes.camera import Camera
from scenes.files import fingerprint
from scenes.model import Judge, Model
from scenes.moderate import moderate
from scenes.needs import needed
from scenes.partial import Partial
from scenes.progress import Progress, no_progress
from scenes.scene import Scene, resolved
from scenes.versions import versions

from .ideal import ideal_matrix, ideal_model
from .passes import rounding_variance
from .points import Plans, Responses, from_points


def made_from(scene: Scene, camera: Camera, judge: Judge | None = None) -> str:
    """Fingerprint of everything that H depends on; `judge` where it says when to stop."""
    description: dict[str, Any] = {"camera": camera.describe(), "calibration": scene.calibration.model_dump()}
    if judge is not None and goes_on(scene):
        description["judged"] = judge.by
    if scene.calibration.method != "ideal":
        description["simulated"] = needed(scene, camera)[0].describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(
    scene: Scene,
    camera: Camera,
    progress: Progress = no_progress,
    partial: Partial | None = None,
    judge: Judge | None = None,
) -> Model:
    """H as the scene's `calibration.method` finds it, with the variance of every entry and its record.

    judge : says when to stop where the scene leaves the number of samples open
    Raises InputError if the variant asked for does not work here, DeniedError if a row fails its check.
    """
    start = perf_counter()
    record: dict[str, Any] = {"fingerprint": made_from(scene, camera, judge), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(resolved(scene, (camera.rows, camera.columns)), camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    if goes_on(scene):
        from .judged import calibrated_until

        model = calibrated_until(scene, camera, judge, progress, partial)
        return replace(model, record=model.record | record | {"seconds": perf_counter() - start})
    model = once(scene, camera, progress, partial)
    return replace(model, record=record | model.record)


def goes_on(scene: Scene) -> bool:
    """Whether the number of samples is left open."""
    return scene.calibration.samples == "auto" and scene.calibration.method != "ideal"


def once(
    scene: Scene,
    camera: Camera,
    progress: Progress = no_progress,
    partial: Partial | None = None,
    plans: Plans | None = None,
    exact: bool = False,
) -> Model:
    """H by rays or point sources, with so many samples as the scene or the plans of the lens types say.

    exact : that sums are taken for float64, where they are
    """
    start, record = perf_counter(), dict[str, Any](method=scene.calibration.method)
    simulated = needed(scene, camera)[0]
    if scene.calibration.method == "transport":
        from .transport import from_transport

        responses = from_transport(scene, simulated, progress, plans)
    else:
        responses = from_points(scene, simulated, progress, partial, plans)
    if exact:
        responses = replace(responses, summed=1)
    variance = settle(responses, camera)
    if scene.calibration.fit == "geometry":
        from .geometry_fit import fitted

        responses, variance, record["fit"] = fitted(responses, variance, simulated)
    record |= {
        "seconds": perf_counter() - start,
        "seed": scene.render.seed,
        **responses.record(),
        **_compared(responses, variance, camera),
        "versions": versions("mitsuba", "drjit", "scipy"),
    }
    kept = resolved(scene, (camera.rows, camera.columns))
    return Model(kept, camera, responses.matrix, variance, responses.batches, record)


def _compared(responses: Responses, variance: NDArray[np.float64], camera: Camera) -> dict[str, Any]:
    """How far H lies from the ideal one, where that has a closed form."""
    if any(kind.glass.distortion is not None and camera.blurs(kind) for kind in camera.types):
        return {}
    return {"agreement": agreement(responses.matrix, variance, camera, responses.passes)}


def settle(responses: Responses, camera: Camera) -> NDArray[np.float64]:
    """Variances of H's entries, drawn towards their sub-imager's mean and never below float32's rounding."""
    starts = responses.matrix.indptr
    settled = np.empty_like(responses.variance)
    for place in camera.slices():
        stored = slice(int(starts[place.start]), int(starts[place.stop]))
        settled[stored] = moderate(responses.variance[stored], responses.passes)
    summed = responses.samples if responses.summed is None else responses.summed
    return np.maximum(settled, rounding_variance(responses.matrix.data, summed))


def agreement(matrix: sparse.csr_array, variance: NDArray[np.float64], camera: Camera, passes: int) -> dict[str, float]:
    """How far H lies from the ideal one: RMS difference, largest z, and the chance of so large a one (Sidak).

    Over every entry that either of them has. The chance takes z as Student's t with one degree fewer than passes.
    """
    difference = sparse.csr_array(matrix - ideal_matrix(camera))
    entries = int(difference.nnz)
    if not entries:
        return {"rms_difference_from_ideal": 0.0, "max_z": 0.0, "p_value": 1.0}
    known = sparse.csr_array((variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    # Where no ray has hit there is no scatter either: such an entry counts as uncertain as the others are on average.
    unseen = float(variance.mean())
    spread = np.asarray(known[difference.nonzero()], dtype=np.float64).ravel()
    spread[spread == 0] = unseen
    values = np.asarray(difference[difference.nonzero()], dtype=np.float64).ravel()
    largest = float(np.max(np.abs(values) / np.sqrt(spread), initial=0.0))
    single = 2 * float(stats.t.sf(largest, passes - 1))
    chance = -np.expm1(entries * np.log1p(-single)) if single < 1 else 1.0
    rms = float(np.sqrt((difference.data**2).sum() / max(entries, 1)))
    return {"rms_difference_from_ideal": rms, "max_z": largest, "p_value": float(chance)}
