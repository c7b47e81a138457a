"""What Eq. 5 promises of a camera whose frame is too large for one dense problem."""

from __future__ import annotations

from math import isfinite

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model

from .expected_error import widths
from .method_choice import WAYS, MethodChoice
from .methods.method import EstimationTask, Execution, Vector
from .noise import everywhere, of_used
from .prediction import TRIM, Prediction, trimmed


def predict_frame(choice: MethodChoice, model: Model, actual: float | Vector) -> Prediction:
    """Expected squared error for noise of variance `actual`; rank, null space and condition are not computed.

    actual : of every measurement the same, or (M,); NaN where a measurement tells nothing and is left out
    Raises InputError where the estimator is to find what takes a stack, or has no noise to expect.
    """
    scene, camera = model.scene, model.camera
    told = scene.estimator.noise_variance
    noise = actual if isinstance(actual, np.ndarray) else everywhere(actual, model.measurements)
    used = np.isfinite(noise)
    noise = of_used(noise, used)
    believed = everywhere(told, noise.size) if isinstance(told, float) else noise
    if told == "fit" or not (believed > 0).all():
        raise InputError(
            f"{camera.unknowns} pixels are predicted with noise alone; set noise.variance or estimator.noise_variance"
            " above 0"
        )
    recorded = model.forward(np.full(model.unknowns, scene.prior.mean))
    task = EstimationTask(model, recorded, used, believed, scene.prior, scene.estimator, scene.tiles)
    outcome = WAYS[choice.method](task, Execution()).result({"noise": noise}, None)
    variance, width = outcome.expected.variance, float(np.median(widths(outcome.expected.resolved)))
    return Prediction(
        measurements=noise.size,
        unknowns=model.unknowns,
        rank=None,
        null_space=None,
        condition=None,
        mse=float(variance.mean()),
        trimmed_mse=trimmed(variance, camera.shape),
        trim=TRIM,
        degrees_of_freedom=outcome.expected.degrees_of_freedom,
        resolution=width if isfinite(width) else None,
        method=outcome.solver.method,
    )
