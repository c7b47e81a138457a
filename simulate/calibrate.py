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
from scenes.model import Model
from scenes.moderate import moderate
from scenes.needs import needed
from scenes.partial import Partial
from scenes.progress import Progress, no_progress
from scenes.scene import Scene, resolved
from scenes.versions import versions

from .ideal import ideal_matrix, ideal_model
from .passes import rounding_variance
from .points import Responses, from_points


def made_from(scene: Scene, camera: Camera) -> str:
    """Fingerprint of everything that H depends on."""
    description: dict[str, Any] = {"camera": camera.describe(), "calibration": scene.calibration.model_dump()}
    if scene.calibration.method != "ideal":
        description["simulated"] = needed(scene, camera)[0].describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(scene: Scene, camera: Camera, progress: Progress = no_progress, partial: Partial | None = None) -> Model:
    """H as the scene's `calibration.method` finds it, with the variance of every entry and its record.

    Raises InputError if the variant asked for does not work here, DeniedError if a row fails its check.
    """
    start = perf_counter()
    kept = resolved(scene, (camera.rows, camera.columns))
    record: dict[str, Any] = {"fingerprint": made_from(scene, camera), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(kept, camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    simulated = needed(scene, camera)[0]
    if scene.calibration.method == "transport":
        from .transport import from_transport

        responses = from_transport(scene, simulated, progress)
    else:
        responses = from_points(scene, simulated, progress, partial)
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
    return np.maximum(settled, rounding_variance(responses.matrix.data, responses.samples))


def agreement(matrix: sparse.csr_array, variance: NDArray[np.float64], camera: Camera, passes: int) -> dict[str, float]:
    """How far H lies from the ideal one: RMS difference, largest z, and the chance of so large a one (Sidak).

    Over every entry that either of them has. The chance takes z as Student's t with one degree fewer than passes.
    """
    difference = sparse.csr_array(matrix - ideal_matrix(camera))
    entries = int(difference.nnz)
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
