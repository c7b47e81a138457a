"""What rendering and calibration come to with so many samples: against the closed form, else against many more rays.

Every repeat has a seed of its own, and none of these streams is one of the scene's data or calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Sampler, Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.adaptive_render import AIM, EXPONENTS, LEAST, MOST, STRATIFIED, AdaptiveRendering, render_until
from ommatid.simulate.cache import cached_model
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix
from ommatid.simulate.noise_target import allowed_variance
from ommatid.simulate.render import Rendering, exposed, light
from ommatid.simulate.sampling.passes import FEWEST_PASSES, JITTERED, Plan, cells_of, on_grid, plan
from ommatid.simulate.sampling.samplers import fitting
from ommatid.simulate.sampling.seeds import repeat_seed

Vector = NDArray[np.float64]
Samples = int | Literal["auto"]

TRUER = 64  # times the samples of what is judged: then the reference brings less than a hundredth of the error
REFERENCE = ".bench.reference.npz"
MOST_SAMPLES = 2**14  # a pixel, of what is judged
MOST_RAYS = 2**27  # of a reference: some ten seconds where lenses are traced surface by surface


@dataclass(frozen=True)
class Reference:
    """What renderings and calibrations are held against: H as it truly is, or as very many rays show it.

    light : (M,) what the sensor pixels truly read of the image;  spread : (M,) its variance, 0 of a closed form
    words : for people
    """

    model: Model
    light: Vector
    spread: Vector
    words: str


def reference(setup: Setup, folder: Path, progress: Progress = no_progress) -> Reference:
    """The closed form where there is one; else H from 64 times the rays, or from as many as can be waited for.

    Such a reference is kept in `folder`. Raises InputError where it takes a backend that does not work here.
    """
    scene, camera, flat = setup.scene, setup.camera, setup.image.ravel()
    if setup.has_closed_form:
        kept = setup.resolved
        perfect = camera.has_box_footprints and camera.tolerance is None
        model = (
            ideal_model(kept, camera) if perfect else exact_model(kept, camera, true_matrix(setup.simulated), "true")
        )
        return Reference(model, model.forward(flat), np.zeros(camera.measurements), "the closed form")
    samples = min(TRUER * MOST_SAMPLES, MOST_RAYS // camera.measurements)
    told = with_calibration(
        scene, "transport", "multijitter", "auto", samples, repeat_seed(scene.render.seed, "right", 0)
    )
    model, _ = cached_model(folder / REFERENCE, replace(setup, scene=told), progress)
    return Reference(
        model, model.forward(flat), model.variance_from_model(flat), f"a reference of {model.record['samples']} samples"
    )


def with_rendering(scene: Scene, sampler: Sampler, variant: str, samples: Samples, seed: int) -> Scene:
    """The scene rendered so."""
    return _changed(scene, "render", sampler=sampler, variant=variant, samples=samples, seed=seed)


def with_calibration(
    scene: Scene, method: Literal["points", "transport"], sampler: Sampler, variant: str, samples: Samples, seed: int
) -> Scene:
    """The scene calibrated so."""
    told = _changed(scene, "render", sampler=sampler, variant=variant, seed=seed)
    return _changed(told, "calibration", method=method, samples=samples, fit=None)


def _changed(scene: Scene, table: str, **update: Any) -> Scene:
    return scene.model_copy(update={table: getattr(scene, table).model_copy(update=update)})


def work_of(samples: int, sampler: Sampler) -> Plan:
    """As renderings divide them over passes; fewer samples than the fewest passes are those of a single one."""
    return plan(samples, sampler) if samples >= FEWEST_PASSES else Plan(1, fitting(sampler, samples))


def foreseen_samples(setup: Setup, right: Reference) -> int:
    """About how many samples a pixel 'auto' will take: those of a first round where grids fit the edges of pixels of f.

    Elsewhere as many as leave a quarter of the variance that is allowed, if a pixel's rays scatter like the image.
    Raises InputError where there is no noise, so that 'auto' cannot tell when it is enough.
    """
    camera, sampler = setup.camera, setup.scene.render.sampler
    allowed = float(np.nanmean(allowed_variance(setup)(right.light)))
    if camera.has_box_footprints and sampler in JITTERED:
        return max(on_grid(LEAST, sampler, cells_of(kind.ratio)).total for kind in camera.types)
    ratio = float(setup.image.var()) / (FEWEST_PASSES * AIM * allowed)
    return int(min(max(FEWEST_PASSES * ratio ** (1 / EXPONENTS.get(sampler, STRATIFIED)), LEAST), MOST))


def rendered(setup: Setup) -> Rendering | AdaptiveRendering:
    """The light alone, as `run` renders it."""
    render = setup.scene.render
    if render.samples == "auto":
        return render_until(setup)
    return light(setup, work=work_of(render.counted, render.sampler))


def error_of_light(rendering: Rendering | AdaptiveRendering, right: Reference) -> float:
    """Root mean square over sensor pixels, in values of f; what the reference itself errs by is taken out."""
    squares = np.square(rendering.mean - right.light) - right.spread
    return float(np.sqrt(max(np.nanmean(squares), 0.0)))


def stack_of(setup: Setup, rendering: Rendering | AdaptiveRendering) -> Stack:
    """A rendering of several passes as the scene's sensor records it, with noise by the scene's seed."""
    return exposed(setup, rendering.mean, rendering.stated_variance(setup.camera), {})


def stack_of_light(setup: Setup, light: Vector, right: Reference) -> Stack:
    """Light, (M,), as the scene's sensor records it; every pixel is said to be as far from right as all are on average.

    Of exact light that is not at all.
    """
    away = float(np.nanmean(np.square(light - right.light)))
    return exposed(setup, light, np.broadcast_to(away, light.shape), {})


def error_of_model(model: Model, right: Reference) -> float:
    """Root mean square over the entries of the right H; what the reference itself errs by is taken out."""
    away = sparse.csr_array(model.matrix - right.model.matrix)
    squares = float(np.square(away.data).sum()) - float(right.model.variance.sum())
    return float(np.sqrt(max(squares, 0.0) / right.model.entries))
