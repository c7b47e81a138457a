"""Stopping rules of an adaptive calibration: by how much the uncertainty of H may raise the expected error.

What the uncertainty of H adds is noise of its variance, as an estimator passes it on that takes H for exact: the trace
of A S A^T over all other error. One that counts the uncertainty errs by no more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ommatid.reconstruct.assumptions import assumptions_at, assumptions_for, with_fallback
from ommatid.reconstruct.method_choice import MethodChoice
from ommatid.reconstruct.methods.method import Execution, total_variance
from ommatid.reconstruct.noise import SHARED, Noise, known_noise, usable_pixels
from ommatid.reconstruct.prior_fit import natural_prior
from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.constants import WHITE
from ommatid.scenes.model import Model
from ommatid.scenes.optics.radiometry import electrons, predicted_noise
from ommatid.scenes.scene import Scene, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.calibrate import StoppingRule
from ommatid.simulate.render import exposed

NEGLIGIBLE = 0.03  # variance relative to the other noise of a measurement
TINY = float(np.finfo(np.float64).tiny)
TABLES = ("prior", "estimator", "tiles", "noise", "sensor")  # on which the expected error depends
UNCERTAIN = ("calibration", SHARED)  # causes that are the uncertainty of H


def for_stack(stack: Stack) -> StoppingRule:
    """Return the rule by the expected error of the stack for which H is calibrated.

    A prior that is to be fitted counts as one of natural pictures.
    """
    known = _with_known_prior(stack)
    made_from = ["stack", digest(stack.values, stack.rendering_variance), _tables(stack.scene)]
    return StoppingRule(
        lambda model: _added_error(known, model, None), fingerprint(made_from), "the expected error of this stack"
    )


def for_prior(setup: Setup) -> StoppingRule:
    """Return the rule by Eq. 5 for images drawn from the prior, for a calibration without a stack.

    Light is the prior's mean. Raises InputError without noise, and where this light saturates every pixel.
    """
    scene, camera = setup.scene, setup.camera
    if not scene.has_noise:
        raise InputError(
            f"{scene.source}: calibration.samples 'auto' takes as many as are needed beside the sensor's noise, and"
            " there is none; set noise.variance above 0, or give calibration.samples a number"
        )
    if scene.sensor is not None:
        predicted_noise(scene, camera, electrons(scene, camera))

    def added(model: Model) -> float:
        mean, deviation = scene.prior.mean, scene.prior.variance**0.5
        light = model.forward(np.full(model.unknowns, mean))
        stack = _with_known_prior(exposed(setup, light, np.zeros(camera.measurements), {}))
        return _added_error(stack, model, mean + deviation * probe(Purpose.GOAL).normal(size=model.unknowns))

    return StoppingRule(added, fingerprint(["prior", _tables(scene)]), "Eq. 5 for images drawn from the prior")


def _added_error(stack: Stack, model: Model, image: FloatArray | None) -> float:
    """Return the error that the uncertainty of H adds, relative to all other error.

    stack : its prior is known;  image : (unknowns,) on which errors of H act; None: a first estimate
    """
    used = usable_pixels(stack, model).used
    bound = _bound(model, used, total_variance(known_noise(stack))[used])
    if bound is not None:
        return bound

    def added(choice: MethodChoice) -> float:
        execution, certain = Execution(quick=True), model.without_uncertainty
        acted_on = image
        if acted_on is None:
            acted_on = assumptions_for(stack, certain, choice, execution).method.preliminary_image
        assumed = assumptions_at(stack, model, choice, acted_on, execution)
        uncertain = [values for name, values in assumed.noise.items() if name in UNCERTAIN]
        if not uncertain:
            return 0.0
        others: Noise = {name: values for name, values in assumed.noise.items() if name not in UNCERTAIN}
        task = assumed.method.task
        if not isinstance(stack.scene.estimator.noise_variance, float):
            task = replace(task, expected_noise=total_variance(others), shared_image=None)
        causes = {**others, "calibration": sum(uncertain[1:], uncertain[0])}
        expected = type(assumed.method)(task, execution).result(causes, None).expected
        part = expected.parts["calibration"]
        return part / max(expected.mse - part, TINY)

    return with_fallback(stack, model, added)


def _with_known_prior(stack: Stack) -> Stack:
    """Return a stack with a prior of natural pictures in place of one that is to be fitted."""
    scene = stack.scene
    if scene.prior.kind != "fit":
        return stack
    return replace(stack, scene=with_tables(scene, prior=natural_prior(scene.prior, stack.camera.target_pitch)))


def _bound(model: Model, used: BoolArray, others: FloatArray) -> float | None:
    """Return a bound on the part due to the uncertainty of H where a reconstruction can be saved, else None.

    It is compared with the variances of the other noise, of the measurements used, for images of white noise from 0 to
    255: by the maximum where it is negligible everywhere, by the mean where a few rows are spoilt by stray rays. By the
    mean, too, where H is large and follows from kernels, whose errors all measurements of a lens type share alike.
    """
    uncertain = model.prior_variance_from_model(np.full(model.unknowns, WHITE**2))
    shared = model.errors(WHITE * probe(Purpose.GOAL_BOUND).random(model.unknowns))
    uncertain = uncertain if shared is None else uncertain + shared.variance
    relative = uncertain[used] / np.maximum(others, TINY)
    if not relative.size or float(relative.max()) <= NEGLIGIBLE:
        return float(relative.max(initial=0.0))
    alike = model.stored is None and not model.camera.has_box_footprints
    return float(relative.mean()) if alike or float(relative.mean()) <= NEGLIGIBLE / 10 else None


def _tables(scene: Scene) -> dict[str, object]:
    return {name: value for name, value in scene.plain().items() if name in TABLES}
