"""H with the variance of each of its entries, from point sources, from rays or in closed form; reused from its file.

With `calibration.samples = "auto"` rounds take more and more samples. A stopping rule yields the contribution of a
round's uncertainty of H to the expected error, and the samples are those that reduce it below a tenth of the other
contributions, from the exponent with which it has decreased. Rounds are independent of each other. Grids of samples fit
the edges of pixels of f where the lens types allow it, see `passes.on_grid`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy import sparse, special

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import cached, fingerprint
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes import model_file
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.model import MeasuredRows, Model, fitted_model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances

from .calibration.fit.chart import SIDE
from .calibration.responses import Responses, Subsets, measured, same_plans
from .ideal import ideal_matrix, ideal_model
from .renderer.variant import choose
from .sampling.checkpoint import Checkpoint, open_checkpoint
from .sampling.passes import FEWEST_PASSES, MOST_SAMPLES, Plan, Plans, SampleLaw, cells_of, on_grid, rounding_variance
from .validation import check_entries

GOAL = 0.1  # of all the rest of the expected error: what the uncertainty of H may add
DONE, AIM = 0.025, 0.0125  # addition at which a round is accepted, and the one it is planned for
LEAST, MOST, MOST_FLOAT32 = 256, 2**19, 40960  # samples per pixel of a round; the last if sums are float32
MOST_EXACT = 2**16  # samples per pixel of a pass if sums are float64
FLAT = 0.01  # relative fall of the addition over two growths, below which more samples are of no use


@dataclass(frozen=True)
class StoppingRule:
    """Decides whether H is known precisely enough for the reconstruction that will use it.

    added_error : maps a model to the expected error due to the uncertainty of its H, relative to all other error
    fingerprint : of the reconstruction;  description : of the same for people
    """

    added_error: Callable[[Model], float]
    fingerprint: str
    description: str


def made_from(setup: Setup, stopping_rule: StoppingRule | None = None) -> str:
    """Return the fingerprint of everything that H depends on."""
    setup = setup.calibrated
    scene = setup.scene
    description: dict[str, Any] = {"camera": setup.camera.describe(), "calibration": scene.calibration.model_dump()}
    if stopping_rule is not None and is_adaptive(scene):
        description["judged"] = stopping_rule.fingerprint
    if scene.calibration.method != "ideal":
        description["simulated"] = setup.simulated.describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    stopping_rule: StoppingRule | None = None,
) -> Model:
    """Determine H by the scene's `calibration.method`, with the variance of every entry and a record.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises InputError if the requested variant does not work here, MachineError if a row fails its check.
    """
    setup, start = setup.calibrated, perf_counter()
    scene = setup.scene
    record: dict[str, Any] = {"fingerprint": made_from(setup, stopping_rule), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(setup.resolved, setup.camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    if is_adaptive(scene):
        model = calibrate_until(setup, stopping_rule, progress, checkpoint)
        return replace(model, record=model.record | record | {"seconds": perf_counter() - start})
    model = rendered_model(setup, progress, checkpoint)
    return replace(model, record=record | model.record)


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
        from .calibration.fit.fit import calibrate_by_fit

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
    from .calibration.fit.fit import has_chart

    with_kernels = setup.scene.calibration.fit != "geometry"
    return all(has_chart(setup.simulated, lens, with_kernels) for lens in setup.simulated.types)


def calibrate_until(
    setup: Setup,
    stopping_rule: StoppingRule | None,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
) -> Model:
    """Return the first model whose uncertainty adds little, or the one with the most samples; its record lists all.

    A part that no samples reduce, such as that of views which too few centroids determine, also ends the rounds.
    Raises ValueError without a stopping rule, and what calibration raises.
    """
    if stopping_rule is None:
        raise ValueError("calibration.samples 'auto' needs a stopping rule, got none")
    scene = setup.scene
    float64 = not choose(scene.render.variant).startswith("scalar")
    most = MOST if float64 else MOST_FLOAT32
    state = {} if checkpoint is None else checkpoint.state()
    tried: list[dict[str, Any]] = json.loads(str(state["tried"])) if "tried" in state else []
    while True:
        samples = _next(tried, SampleLaw.expected(scene.render.sampler), most)
        plans = plans_of(setup, samples, float64)
        model = rendered_model(setup, progress, plans=plans, float64=float64)
        spent = {name: plan.total for name, plan in plans.items()}
        tried.append({"asked": max(spent.values()), "samples": spent, "adds": stopping_rule.added_error(model)})
        if tried[-1]["adds"] <= DONE or samples >= most or _is_flat(tried):
            break  # not in the checkpoint: a run that is interrupted before the model is written repeats this round
        if checkpoint is not None:
            text = json.dumps(tried)
            checkpoint.offer(lambda text=text: {"tried": np.array(text)})
    adaptive = {
        "goal": GOAL,
        "adds": tried[-1]["adds"],
        "reached": tried[-1]["adds"] <= GOAL,
        "judged_by": stopping_rule.description,
        "tried": tried,
    }
    totals = [sum(each["samples"][name] for each in tried) for name in plans]
    counts = {"samples": max(totals), "fewest_samples": min(totals), "auto": adaptive}
    return replace(model, record=model.record | counts)


def plans_of(setup: Setup, samples: int, float64: bool) -> Plans:
    """Return plans of about `samples` per pixel, by lens type, on grids that fit the edges of pixels of f."""
    most, sampler = MOST_EXACT if float64 else MOST_SAMPLES, setup.scene.render.sampler
    return {lens_type.name: on_grid(samples, sampler, cells_of(lens_type), most) for lens_type in setup.camera.types}


def _next(tried: list[dict[str, Any]], law: SampleLaw, most: int) -> int:
    """Return the samples of the next round."""
    if not tried:
        return LEAST
    asked, adds = tried[-1]["asked"], tried[-1]["adds"]
    if len(tried) > 1:
        before = tried[-2]
        law = SampleLaw.measured(before["adds"] / adds, asked / before["asked"])
    return min(law.samples(adds / AIM, Plan(FEWEST_PASSES, asked // FEWEST_PASSES), MOST_EXACT), most)


def _is_flat(tried: list[dict[str, Any]]) -> bool:
    """Return True if the samples have grown twice, at least fourfold, and the addition has hardly changed."""
    if len(tried) < 3:
        return False
    adds = [each["adds"] for each in tried[-3:]]
    return max(adds) - min(adds) < FLAT * max(adds)


def is_adaptive(scene: Scene) -> bool:
    """Return True if the scene leaves the number of samples of its calibration open."""
    return scene.calibration.samples == "auto" and scene.calibration.method != "ideal"


@one_thread()
def cached_model(
    path: Path, setup: Setup, progress: Progress, stopping_rule: StoppingRule | None = None
) -> tuple[Model, bool]:
    """Return the model at `path` as it is on disk, and True if it had to be calibrated.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises what `calibrate` raises.
    """
    wanted = made_from(setup, stopping_rule)
    with open_checkpoint(path, wanted) as checkpoint:
        return cached(
            path,
            wanted,
            _read_model,
            lambda: calibrate(setup, progress, checkpoint, stopping_rule),
            model_file.write,
        )


def _read_model(path: Path) -> tuple[Model, str | None]:
    model = model_file.read(path)
    return model, model.record.get("fingerprint")
