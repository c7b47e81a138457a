"""What the uncertainty of H adds to the error of a reconstruction: of a stack at hand, or of images of the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ommatid.reconstruct.expected_error import ExpectedError
from ommatid.reconstruct.method_choice import WAYS, choose_method
from ommatid.reconstruct.methods.method import EstimationTask, Execution, total_variance
from ommatid.reconstruct.noise import Noise, everywhere, known_noise, usable_pixels
from ommatid.reconstruct.restore import restore
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest, fingerprint
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.simulate.calibration.stopping_rule import StoppingRule

from .predict import expected_noise

WHITE = 255.0
SMALL = 0.03  # beside the other noise of a measurement
TINY = float(np.finfo(np.float64).tiny)
TOLD = ("prior", "estimator", "tiles", "noise", "sensor")  # what the expected error depends on


def for_stack(stack: Stack) -> StoppingRule:
    """By the error budget of the very stack that the model is for."""

    def adds(model: Model) -> float:
        at_most = _at_most(stack, model)
        if at_most is not None:
            return at_most
        found = restore(stack, model)
        known = replace(model, variance=np.zeros_like(model.variance), batches=model.batches[:0])
        return _added(found.noise, found.expected, lambda: restore(stack, known).expected.mse)

    known = digest(stack.values, stack.variance)
    return StoppingRule(adds, fingerprint(["stack", known, _told(stack.scene)]), "the error budget of this stack")


def for_prior(scene: Scene, camera: Camera) -> StoppingRule:
    """By Eq. 5 for images drawn from the prior, where there is no stack. Raises InputError without noise.

    A prior that is to be found in a stack counts as one of independent pixels, and light as the prior's mean.
    """
    found = expected_noise(scene, camera)
    noise = found if isinstance(found, np.ndarray) else everywhere(found, camera.measurements)
    if not (noise[np.isfinite(noise)] > 0).all():
        raise InputError(
            f"{scene.source}: calibration.samples 'auto' takes as many as are needed beside the sensor's noise, and"
            " there is none; set noise.variance above 0, or give calibration.samples a number"
        )
    prior = scene.prior.model_copy(update={"kind": "independent"}) if scene.prior.kind == "fit" else scene.prior

    def adds(model: Model) -> float:
        used = np.isfinite(noise) & (np.diff(model.matrix.indptr) > 0)
        spread = model.prior_variance_from_model(np.full(model.unknowns, prior.variance))
        causes = {"noise": noise[used], "calibration": spread[used]}
        told = scene.estimator.noise_variance
        seen = model.forward(np.full(model.unknowns, prior.mean))

        def expected(noise: Noise) -> ExpectedError:
            believed = everywhere(told, int(used.sum())) if isinstance(told, float) else total_variance(noise)
            task = EstimationTask(model, seen, used, believed, prior, scene.estimator, scene.tiles)
            return (
                WAYS[choose_method(scene, camera, exact=False).method](task, Execution()).result(noise, None).expected
            )

        return _added(causes, expected(causes), lambda: expected({"noise": causes["noise"]}).mse)

    return StoppingRule(adds, fingerprint(["prior", _told(scene)]), "Eq. 5 for images drawn from the prior")


def _at_most(stack: Stack, model: Model) -> float | None:
    """What the uncertainty of H adds where that is so little that no reconstruction has to tell; else None.

    It is compared with the other noise, measurement by measurement, for values from 0 to 255 that go from end to end:
    as a bound where it is small everywhere, and where rays beside their pixel spoil a few rows as an average.
    """
    used = usable_pixels(stack, model).used
    others = total_variance(known_noise(stack))[used]
    relative = model.prior_variance_from_model(np.full(model.unknowns, WHITE**2))[used] / np.maximum(others, TINY)
    if not relative.size or float(relative.max()) <= SMALL:
        return float(relative.max(initial=0.0))
    return float(relative.mean()) if float(relative.mean()) <= SMALL / 10 else None


def _added(noise: Noise, expected: ExpectedError, without: Callable[[], float]) -> float:
    """What the uncertainty of H adds to the expected error, relative to the rest of it.

    Its part of the budget alone would say too little where it is large: it also makes the estimator believe less of the
    measurements, so that other parts grow. The expected error without it tells; but where it is small beside the other
    noise of every measurement, by a factor r at most, the error is no more than 1 + r times that without it.
    """
    part, rest = expected.parts.get("calibration", 0.0), expected.mse - expected.parts.get("calibration", 0.0)
    if "calibration" not in noise or part == 0:
        return 0.0
    others = total_variance({name: values for name, values in noise.items() if name != "calibration"})
    relative = part / max(rest, TINY)
    if float(np.max(noise["calibration"] / np.maximum(others, TINY), initial=0.0)) <= SMALL:
        return relative
    return max(relative, expected.mse / max(without(), TINY) - 1)


def _told(scene: Scene) -> dict[str, object]:
    return {name: value for name, value in scene.plain().items() if name in TOLD}
