"""The recording that a scene would give, from H, with or without a pilot's rays, instead of a rendering.

Its values are H f with noise of every cause: the rendering's, whose variance a pilot shows, and the sensor's. It is
reconstructed like any other stack, so that a prediction knows of everything that a run does. Its seeds are its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ommatid.reconstruct.prior import FittedPrior, coloured, spectrum_of
from ommatid.reconstruct.prior_fit import fit_picture, natural_prior
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, derived_seed, stream
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.adaptive_render import AIM as RENDERING_AIM
from ommatid.simulate.adaptive_render import DONE as RENDERING_DONE
from ommatid.simulate.adaptive_render import SHARE, allowed_variance, check_noise_target
from ommatid.simulate.calibrate import AIM, DONE, calibrate, explains
from ommatid.simulate.calibration import pilot
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix
from ommatid.simulate.render import exposed
from ommatid.simulate.sampling.passes import rounding_variance

from .calibration_goal import for_stack

Assumptions = tuple[str, ...]


@dataclass(frozen=True)
class PredictedRecording:
    """A recording of a known image, and the model with which it is to be reconstructed.

    H and images are on the grid of H's columns, the world's where its detail matters; the stack is on that of f.

    true : (M, N) H of the camera that records, None where the model's is the same or a calibration of it
    certain : H without the errors of a calibration, whose rank is the camera's
    truth : (N,) the scene's picture, None where it has none that can be read and the image is a draw of the prior
    """

    stack: Stack
    model: Model
    true: sparse.csr_array | None
    certain: Model
    image: FloatArray
    truth: FloatArray | None
    assumes: Assumptions


@dataclass(frozen=True)
class _Camera:
    """H of the camera that records, and the uncertainty of a calibration of it, None without one."""

    model: Model
    pilot: pilot.Pilot | None
    assumes: Assumptions


def recording_without_rays(setup: Setup) -> PredictedRecording:
    """Return the recording by a perfect rendering, and the ideal H as its model; the prior is known.

    Raises InputError where H has no closed form.
    """
    coarse = _with_own_seed(setup)
    table, said_of_prior = prior_without_stack(coarse.calibrated)
    coarse = replace(coarse, scene=with_tables(coarse.scene, prior=table))
    setup = coarse.calibrated
    _, image, truth, said = _image(coarse)
    designed, camera, true = ideal_model(setup.scene, setup.camera), setup.camera, None
    if camera.tolerance is not None and camera.has_sharp_footprints and camera.unknowns <= MOST_DENSE:
        true = true_matrix(camera)
    light = designed.forward(image) if true is None else true @ image
    stack = exposed(coarse, light, np.zeros(light.size), {})
    return PredictedRecording(stack, designed, true, designed, image, truth, (*said, *said_of_prior))


def _image(coarse: Setup) -> tuple[FloatArray, FloatArray, FloatArray | None, Assumptions]:
    """Return what is recorded on the grid of the world, (rows, columns), on that of H's columns, and the picture."""
    truth, said = known_image(coarse.calibrated)
    if truth is not None:
        return coarse.world.image, truth, truth, said
    world = _prior_draw(coarse.world).reshape(coarse.world.camera.shape)
    return world, averaged(world, world.shape[0] // coarse.calibrated.camera.rows).ravel(), None, said


def predicted_recording(setup: Setup) -> PredictedRecording:
    """Return the recording that a run of this scene would give, and its model of H.

    Raises InputError where only Mitsuba's scalar backend works.
    """
    coarse = _with_own_seed(setup)
    setup = coarse.calibrated
    world, image, truth, said = _image(coarse)
    camera = _camera(setup)
    variance, said_of_light = _rendering_variance(coarse, camera, image, world.ravel())
    rng = stream(setup.scene.render.seed, Purpose.PREDICTED_LIGHT)
    light = camera.model.forward(image)
    light = light + rng.normal(size=light.size) * np.sqrt(variance)
    light = np.maximum(light, 0.0) if setup.scene.sensor is not None else light
    stack = exposed(coarse, light, variance, {})
    assumes = (*said, *camera.assumes, *said_of_light)
    if setup.scene.calibration.method == "ideal":
        same = camera.model.is_exact
        designed = camera.model if same else ideal_model(setup.scene, setup.camera)
        true = None if same or not _differs(camera.model, designed) else camera.model.matrix
        return PredictedRecording(stack, designed, true, designed, image, truth, assumes)
    fitted = _fitted(setup, stack)
    if fitted is not None:
        return PredictedRecording(stack, fitted, None, camera.model, image, truth, assumes)
    model, said_of_model = _calibrated(setup, camera, stack)
    return PredictedRecording(stack, model, None, camera.model, image, truth, (*assumes, *said_of_model))


def known_image(setup: Setup) -> tuple[FloatArray | None, Assumptions]:
    """Return the scene's picture, (N,), None where there is none to read, and the assumption made in its place."""
    world = ("the world is flat, and the target's plane is all of it",) if setup.scene.world is not None else ()
    drawn = "light and contrast of an image drawn from the prior"
    if setup.scene.target.image is None:
        return None, (*world, f"{drawn}, since the target has no picture")
    try:
        return setup.image.astype(np.float32).astype(np.float64).ravel(), world
    except InputError:
        return None, (*world, f"{drawn}, since the target's picture cannot be read")


def _with_own_seed(setup: Setup) -> Setup:
    render = setup.scene.render
    render = render.model_copy(update={"seed": derived_seed(render.seed, Purpose.PREDICTION)})
    return replace(setup, scene=with_tables(setup.scene, render=render))


def prior_without_stack(setup: Setup) -> tuple[PriorTable, Assumptions]:
    """Return the prior that predictions assume, and the assumption where the scene's is one that is fitted to a stack.

    It is fitted to the scene's picture, and where there is none to read it is that of natural pictures.
    """
    scene, camera = setup.scene, setup.camera
    if scene.prior.kind != "fit" or isinstance(scene.prior, FittedPrior):
        return scene.prior, ()
    fitted = None
    if known_image(setup)[0] is not None:
        fitted = fit_picture(setup.world.picture, camera.detail, camera.target_pitch, scene.prior)
    if fitted is not None:
        return fitted, ("a prior fitted to the scene's picture in place of its stack",)
    return natural_prior(scene.prior, camera.target_pitch), (
        "a prior of natural pictures, with a spectrum of 1/frequency^2, since the scene has no picture to fit it to",
    )


def _prior_draw(setup: Setup) -> FloatArray:
    """Return an image drawn from the prior, (N,)."""
    scene, camera = setup.scene, setup.camera
    random = stream(scene.render.seed, Purpose.PREDICTED_IMAGE).normal(size=camera.shape)
    table, _ = prior_without_stack(setup)
    spectrum = spectrum_of(table, camera.shape, camera.target_pitch, camera.detail)
    image = table.mean + coloured(spectrum, random).ravel()
    return np.maximum(image, 0.0) if scene.sensor is not None else image


def _camera(setup: Setup) -> _Camera:
    """Return H of the camera that records: in closed form, or where it has none from a pilot."""
    scene, simulated = setup.scene, setup.simulated
    calibrated = scene.calibration.method != "ideal"
    designed = simulated.tolerance is None and setup.has_closed_form
    if designed and (setup.is_applied or (setup.camera.has_box_footprints and explains(setup))):
        return _Camera(ideal_model(scene, setup.camera), None, ())
    plans = pilot.calibration_plans(setup)
    uncertain = pilot.pilot(setup, plans) if calibrated and not explains(setup) else None
    assumes = _extrapolation("H", uncertain is not None and uncertain.extrapolated)
    if setup.has_closed_form:
        matrix = true_matrix(simulated)
    else:
        matrix = _traced_matrix(setup, uncertain, plans)
        assumes = (*assumes, "H of lenses without a closed form is that of a pilot's rays")
    model = exact_model(scene, setup.camera, matrix, "ideal" if simulated.is_ideal_pinhole else "true")
    return _Camera(model, uncertain, assumes)


def _traced_matrix(setup: Setup, uncertain: pilot.Pilot | None, plans: pilot.Plans) -> sparse.csr_array:
    """Return H by a pilot of as many rays as are affordable; `uncertain`, of `plans`, serves where it has as many."""
    best = pilot.best_plans(setup, plans if uncertain is not None else pilot.rendering_plans(setup))
    if uncertain is not None and best == plans:
        return uncertain.model.matrix
    return pilot.pilot(setup, best).model.matrix


def _fitted(setup: Setup, stack: Stack) -> Model | None:
    """Return H as a calibration by few numbers finds it, with seeds of its own; None where they do not explain it."""
    if setup.scene.calibration.method == "ideal" or not explains(setup):
        return None
    rule = for_stack(stack) if setup.scene.calibration.samples == "auto" else None
    model = calibrate(pilot.setup_of_pilot(setup), stopping_rule=rule)
    return None if model.fitted is None or model.variance.any() else model


def _calibrated(setup: Setup, camera: _Camera, stack: Stack) -> tuple[Model, Assumptions]:
    """Return H as the scene's calibration may measure it: the true one with errors, and their uncertainty."""
    uncertain = pilot.pilot(setup, pilot.calibration_plans(setup)) if camera.pilot is None else camera.pilot
    true = camera.model.matrix
    model = uncertain.around(true)
    model = replace(model, record={**model.record, "method": setup.scene.calibration.method})
    if setup.scene.calibration.samples != "auto":
        return model, ()
    adds = for_stack(stack).added_error(model)
    said = (
        f"the uncertainty of H adds {100 * min(adds, AIM):.2g} %, which calibration.samples 'auto' aims at or finds",
    )
    if adds > DONE:
        model = replace(uncertain.around(true, AIM / adds), record=model.record)
    return model, said


def _rendering_variance(
    setup: Setup, camera: _Camera, image: FloatArray, world: FloatArray
) -> tuple[FloatArray, Assumptions]:
    """Return the variance of the rendered light, (M,).

    setup : on the grid of f;  image : on that of H's columns;  world : on that of what is rendered
    """
    scene, plans, setup, rendered = setup.scene, pilot.rendering_plans(setup), setup.calibrated, setup.world
    light = camera.model.forward(image)
    floor = rounding_variance(light, max(work.samples for work in plans.values()))
    if scene.world is not None:
        variance, extrapolated = pilot.world_variance(rendered, plans)
    else:
        same = image.size == world.size and plans == pilot.calibration_plans(setup)
        traced = camera.pilot if same and camera.pilot is not None else pilot.pilot(rendered, plans)
        variance, extrapolated = traced.rendering_variance(world), traced.extrapolated
    variance = np.maximum(variance, floor)
    said = _extrapolation("the rendering", extrapolated)
    if scene.render.samples != "auto":
        return variance, said
    check_noise_target(scene)
    allowed = np.nan_to_num(allowed_variance(setup)(light, slice(0, light.size)))
    variance = np.where(variance > RENDERING_DONE * allowed, np.maximum(RENDERING_AIM * allowed, floor), variance)
    aim = (
        f"the rendering's variance is {RENDERING_AIM * SHARE:g} of the sensor's or less, as render.samples 'auto' plans"
    )
    return variance, (*said, aim)


def _extrapolation(what: str, extrapolated: bool) -> Assumptions:
    return (f"the variance of {what} is extrapolated from fewer samples",) if extrapolated else ()


def _differs(model: Model, other: Model) -> bool:
    if model.stored is None or other.stored is None:
        return False
    difference = sparse.csr_array(model.stored - other.stored)
    return bool(np.abs(difference.data).max(initial=0.0) > 1e-12)
