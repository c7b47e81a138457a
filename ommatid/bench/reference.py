"""Errors of renderings and calibrations against a reference: the closed form, or else a run with many more rays.

Every repeat has its own seed, and none of these random streams is one of the scene's data or calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix
from ommatid.simulate.render import exposed, light
from ommatid.simulate.sampling.passes import FEWEST_PASSES, Plan, Rendering, plan
from ommatid.simulate.sampling.samplers import fitting

Samples = int | Literal["auto"]

SAMPLE_RATIO = 64  # reference samples per measured sample: the reference adds less than a hundredth of the error
MOST_SAMPLES = 2**14  # per pixel, of a measured cell
MOST_RAYS = 2**27  # of a reference: about ten seconds where rays are traced through surfaces


@dataclass(frozen=True)
class Reference:
    """The reference for renderings and calibrations: the true H, or an estimate of it from very many rays.

    light : (M,) true values of the sensor pixels;  variance : (M,) their variance, 0 for a closed form
    description : how the reference was obtained
    """

    model: Model
    light: FloatArray
    variance: FloatArray
    description: str


def reference(setup: Setup) -> Reference:
    """Return the closed form where there is one, else H from 64 times the rays, or as many as MOST_RAYS permits.

    Raises InputError if its backend does not work on this machine.
    """
    scene, camera, image = setup.scene, setup.camera, setup.image.ravel()
    if setup.has_closed_form:
        if camera.has_box_footprints and camera.tolerance is None:
            model = ideal_model(setup.resolved, camera)
        else:
            model = exact_model(setup.resolved, camera, true_matrix(setup.simulated), "true")
        return Reference(model, model.forward(image), np.zeros(camera.measurements), "the closed form")
    samples = min(SAMPLE_RATIO * MOST_SAMPLES, MOST_RAYS // camera.measurements)
    seed = derived_seed(scene.render.seed, Purpose.REPEAT, "right", 0)
    many = with_calibration(scene, "transport", "multijitter", "auto", samples, seed)
    model = calibrate(replace(setup, scene=many))
    description = f"a reference of {model.record['samples']} samples"
    return Reference(model, model.forward(image), model.variance_from_model(image), description)


def with_rendering(scene: Scene, sampler: Sampler, variant: str, samples: Samples, seed: int) -> Scene:
    """Return the scene with these settings of its rendering."""
    return _changed(scene, "render", sampler=sampler, variant=variant, samples=samples, seed=seed)


def with_calibration(
    scene: Scene, method: Literal["points", "transport"], sampler: Sampler, variant: str, samples: Samples, seed: int
) -> Scene:
    """Return the scene with these settings of its calibration."""
    rendered = _changed(scene, "render", sampler=sampler, variant=variant, seed=seed)
    return _changed(rendered, "calibration", method=method, samples=samples, fit=None)


def _changed(scene: Scene, table: str, **update: Any) -> Scene:
    return scene.model_copy(update={table: getattr(scene, table).model_copy(update=update)})


def sample_plan(samples: int, sampler: Sampler) -> Plan:
    """Return passes and samples as renderings use them; too few samples for several passes make a single pass."""
    return plan(samples, sampler) if samples >= FEWEST_PASSES else Plan(1, fitting(sampler, samples))


def render_light(setup: Setup) -> Rendering:
    """Render the light without the sensor's noise, as `run` does."""
    render = setup.scene.render
    if render.samples == "auto":
        return render_until(setup)
    return light(setup, work=sample_plan(render.sample_count, render.sampler))


def light_error(rendering: Rendering, right: Reference) -> float:
    """Return the root mean square error over sensor pixels, in values of f, without the variance of the reference."""
    squares = np.square(rendering.mean - right.light) - right.variance
    return float(np.sqrt(max(np.nanmean(squares), 0.0)))


def model_error(model: Model, right: Reference) -> float:
    """Return the root mean square error over the entries of H, without the variance of the reference."""
    difference = sparse.csr_array(model.matrix - right.model.matrix)
    squares = float(np.square(difference.data).sum()) - float(right.model.variance.sum())
    return float(np.sqrt(max(squares, 0.0) / right.model.entries))


def record_rendering(setup: Setup, rendering: Rendering) -> Stack:
    """Return a rendering of several passes as the scene's sensor records it, with noise from the scene's seed."""
    return exposed(setup, rendering.mean, rendering.stated, {})


def record_light(setup: Setup, light: FloatArray, right: Reference) -> Stack:
    """Return light, (M,), as the scene's sensor records it.

    The stated variance of the light is the same for all pixels: its mean squared error, 0 for exact light.
    """
    mse = float(np.nanmean(np.square(light - right.light)))
    return exposed(setup, light, np.broadcast_to(mse, light.shape), {})
