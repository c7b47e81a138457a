"""Stopping rules of an adaptive calibration: by how much the uncertainty of H may raise the expected error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.expected_error import ExpectedError
from ommatid.reconstruct.method_choice import METHODS, choose_method
from ommatid.reconstruct.methods.method import EstimationTask, Execution, total_variance
from ommatid.reconstruct.noise import SHARED, Noise, known_noise, uniform, usable_pixels
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.constants import WHITE
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.calibration.adaptive_rounds import StoppingRule

NEGLIGIBLE = 0.03  # variance relative to the other noise of a measurement
TINY = float(np.finfo(np.float64).tiny)
TABLES = ("prior", "estimator", "tiles", "noise", "sensor")  # on which the expected error depends


def for_stack(stack: Stack) -> StoppingRule:
    """Return the rule by the error budget of the stack for which H is calibrated."""

    def added_error(model: Model) -> float:
        used = usable_pixels(stack, model).used
        bound = _bound(model, used, total_variance(known_noise(stack))[used])
        if bound is not None:
            return bound
        restoration = restore(stack, model, quick=True)
        certain = model.without_uncertainty
        return _added(restoration.noise, restoration.expected, lambda: restore(stack, certain, quick=True).expected.mse)

    made_from = ["stack", digest(stack.values, stack.variance), _tables(stack.scene)]
    return StoppingRule(added_error, fingerprint(made_from), "the error budget of this stack")


def for_prior(setup: Setup) -> StoppingRule:
    """Return the rule by Eq. 5 for images drawn from the prior, for a calibration without a stack.

    A prior that is to be fitted counts as one of independent pixels, and light as the prior's mean.
    Raises InputError without noise.
    """
    scene, camera = setup.scene, setup.camera
    actual = expected_noise(setup)
    noise = actual if isinstance(actual, np.ndarray) else uniform(actual, camera.measurements)
    if not (noise[np.isfinite(noise)] > 0).all():
        raise InputError(
            f"{scene.source}: calibration.samples 'auto' takes as many as are needed beside the sensor's noise, and"
            " there is none; set noise.variance above 0, or give calibration.samples a number"
        )
    prior = scene.prior.model_copy(update={"kind": "independent"}) if scene.prior.kind == "fit" else scene.prior

    assumed_prior = scene.assumed_prior.model_copy(update={"kind": prior.kind})

    def added_error(model: Model) -> float:
        used = np.isfinite(noise)
        if model.stored is not None:
            used &= np.diff(model.stored.indptr) > 0
        elif (bound := _bound(model, used, noise[used])) is not None:
            return bound
        model = model_of_f(model, camera, prior)
        from_model = model.prior_variance_from_model(np.full(model.unknowns, prior.variance), prior.mean)
        random = probe(Purpose.GOAL).normal(size=model.unknowns)
        shared = model.errors(prior.mean + prior.variance**0.5 * random)
        from_model = from_model if shared is None else from_model + shared.variance
        causes = {"noise": noise[used], "calibration": from_model[used]}
        setting = scene.estimator.noise_variance
        recorded = model.forward(np.full(model.unknowns, prior.mean))
        method = METHODS[choose_method(scene, camera, exact=model.is_applied).method]

        def expected(noise: Noise) -> ExpectedError:
            assumed = uniform(setting, int(used.sum())) if isinstance(setting, float) else total_variance(noise)
            task = EstimationTask(
                model,
                recorded,
                used,
                assumed,
                assumed_prior,
                scene.estimator,
                scene.tiles,
                scene.prior_ratio,
                finer=model.camera.rows // camera.rows,
            )
            return method(task, Execution(quick=True)).result(noise, None).expected

        certain = {name: values for name, values in causes.items() if name != "calibration"}
        return _added(causes, expected(causes), lambda: expected(certain).mse)

    return StoppingRule(added_error, fingerprint(["prior", _tables(scene)]), "Eq. 5 for images drawn from the prior")


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


def _added(noise: Noise, expected: ExpectedError, mse_without: Callable[[], float]) -> float:
    """Return the error that the uncertainty of H adds, relative to the expected error without it.

    Its part of the budget is too small a measure where it is large, since the estimator then also gives the
    measurements less weight, and other parts grow: the error without it is computed. Where it is negligible beside the
    other noise of every measurement, by a factor r at most, the error is no more than 1 + r times that without it, and
    the part is measure enough.
    """
    part = expected.parts.get("calibration", 0.0)
    rest = expected.mse - part
    if part == 0:
        return 0.0
    by_model = {name: values for name, values in noise.items() if name in ("calibration", SHARED)}
    others = total_variance({name: values for name, values in noise.items() if name not in by_model})
    relative = part / max(rest, TINY)
    uncertain = total_variance(by_model) if by_model else np.zeros(others.size)
    if float(np.max(uncertain / np.maximum(others, TINY), initial=0.0)) <= NEGLIGIBLE:
        return relative
    return max(relative, expected.mse / max(mse_without(), TINY) - 1)


def _tables(scene: Scene) -> dict[str, object]:
    return {name: value for name, value in scene.plain().items() if name in TABLES}


def expected_noise(setup: Setup) -> float | FloatArray:
    """Return the variance of all measurements, or of each, (M,): with a [sensor] that of light of the prior's mean."""
    scene = setup.scene
    if scene.sensor is not None:
        from ommatid.scenes.optics.radiometry import predicted_noise
        from ommatid.simulate.sensors import response

        return predicted_noise(scene, setup.camera, response(setup))
    return scene.noise.variance + scene.noise.quantisation_variance if scene.noise else 0.0
