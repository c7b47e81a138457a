"""Calibration with as many samples as the use of H justifies: rounds with more and more samples.

A stopping rule yields the contribution of a round's uncertainty of H to the expected error. This module chooses the
samples that reduce it below a tenth of the other contributions, from the exponent with which it has decreased. Rounds
are independent of each other. Grids of samples fit the edges of pixels of f where the lens types allow it, see
`passes.on_grid`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup

from ..renderer.variant import choose
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import FEWEST_PASSES, MOST_SAMPLES, Plan, Plans, SampleLaw, cells_of, on_grid
from .entries import rendered_model

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
