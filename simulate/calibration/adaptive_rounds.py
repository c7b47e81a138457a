"""Calibration until H is known well enough for what it is used for: rounds of ever more samples.

What a round's uncertainty of H adds to the expected error is judged by whoever reconstructs with it; this module jumps
to the samples that bring it below a tenth of all the rest, by the exponent with which it has fallen. Each round stands
for itself. Grids of samples fit the edges of pixels of f where the lens types allow it, see `passes.on_grid`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import ceil, log
from typing import Any

import numpy as np

from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from ..adaptive_render import EXPONENTS, STEEPEST, STRATIFIED
from ..renderer.variant import choose
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import MOST_SAMPLES, cells_of, on_grid
from .entries import rendered_model
from .point_sources import Plans
from .stopping_rule import StoppingRule

GOAL = 0.1  # of all the rest of the expected error: what the uncertainty of H may add
DONE, AIM = 0.025, 0.0125  # with how little a round is content, and what it is planned for
LEAST, MOST, MOST_FLOAT32 = 256, 2**19, 40960  # samples a pixel of a round; the last where sums are float32
MOST_EXACT = 2**16  # samples a pixel of a pass where they are not
LEAPS = (2.0, 64.0)  # from the samples of a round to those of the next


def calibrate_until(
    setup: Setup,
    judge: StoppingRule | None,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
) -> Model:
    """The first model whose uncertainty adds little, or the one of the most samples; its record says what it took.

    Raises ValueError without a judge, and what calibration raises.
    """
    if judge is None:
        raise ValueError("calibration.samples 'auto' needs somebody to say when it is enough")
    scene = setup.scene
    exact = not choose(scene.render.variant).startswith("scalar")
    most = MOST if exact else MOST_FLOAT32
    state = {} if partial is None else partial.state()
    tried: list[dict[str, Any]] = json.loads(str(state["tried"])) if "tried" in state else []
    while True:
        samples = _next(tried, EXPONENTS.get(scene.render.sampler, STRATIFIED), most)
        plans = plans_of(setup, samples, exact)
        number = scene.calibration.model_copy(update={"samples": samples})
        told = replace(setup, scene=scene.model_copy(update={"calibration": number}))
        model = rendered_model(told, progress, None, plans, exact)
        spent = {name: plan.total for name, plan in plans.items()}
        tried.append({"asked": max(spent.values()), "samples": spent, "adds": judge.added_error(model)})
        if tried[-1]["adds"] <= DONE or samples >= most:
            break  # and whoever is stopped before the model is written does this round again, not one more
        if partial is not None:
            kept = json.dumps(tried)
            partial.offer(lambda kept=kept: {"tried": np.array(kept)})
    how = {
        "goal": GOAL,
        "adds": tried[-1]["adds"],
        "reached": tried[-1]["adds"] <= GOAL,
        "judged_by": judge.description,
    }
    totals = [sum(one["samples"][name] for one in tried) for name in plans]
    counted = {"samples": max(totals), "fewest_samples": min(totals), "auto": {**how, "tried": tried}}
    return replace(model, scene=_open(model.scene), record=model.record | counted)


def plans_of(setup: Setup, samples: int, exact: bool) -> Plans:
    """Of each lens type, about so many samples a pixel on a grid that fits the edges of its pixels of f."""
    scene = setup.scene
    alike = scene.calibration.fit is not None  # which counts on equal numbers
    most, sampler = MOST_EXACT if exact else MOST_SAMPLES, scene.render.sampler
    return {
        kind.name: on_grid(samples, sampler, 1 if alike else cells_of(kind.ratio), most) for kind in setup.camera.types
    }


def _next(tried: list[dict[str, Any]], exponent: float, most: int) -> int:
    """Samples of the next round."""
    if not tried:
        return LEAST
    asked, adds = tried[-1]["asked"], tried[-1]["adds"]
    if len(tried) > 1:
        before = tried[-2]
        exponent = min(max(log(before["adds"] / adds) / log(asked / before["asked"]), 1.0), STEEPEST)
    fewest, largest = (leap * asked for leap in LEAPS)
    return min(ceil(min(max(asked * (adds / AIM) ** (1 / exponent), fewest), largest)), most)


def _open(scene: Scene) -> Scene:
    """The scene with the number of samples left open, as it was asked for."""
    told = scene.calibration.model_copy(update={"samples": "auto"})
    return scene.model_copy(update={"calibration": told})
