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

from ommatid.runtime.files import cached, fingerprint
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes import model_file
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from .calibration.entries import rendered_model
from .ideal import ideal_model
from .renderer.variant import choose
from .sampling.checkpoint import Checkpoint, open_checkpoint
from .sampling.passes import FEWEST_PASSES, MOST_SAMPLES, Plan, Plans, SampleLaw, cells_of, on_grid

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
