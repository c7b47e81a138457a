"""What Eq. 5 promises of a camera whose frame is too large for one dense problem."""

from __future__ import annotations

from math import isfinite

import numpy as np

from scenes.errors import InputError
from scenes.model import Model

from .accuracy import TRIM, Prediction, trimmed
from .choice import WAYS, Choice
from .expected import widths
from .way import Hands, Task


def predict_large(choice: Choice, model: Model, actual: float) -> Prediction:
    """Expected squared error for noise of variance `actual`; rank, null space and condition are not computed.

    Raises InputError where the estimator is to find what takes a stack, or has no noise to expect.
    """
    scene, camera = model.scene, model.camera
    told = scene.estimator.noise_variance
    believed = actual if told is None else told
    if isinstance(believed, str) or believed <= 0:
        raise InputError(
            f"{camera.unknowns} pixels are predicted with noise alone; set noise.variance or estimator.noise_variance"
            " above 0"
        )
    everywhere = (model.measurements,)
    task = Task(
        model,
        model.forward(np.full(model.unknowns, scene.prior.mean)),
        np.ones(everywhere, dtype=np.bool_),
        np.broadcast_to(np.float64(believed), everywhere),
        scene.prior,
        scene.estimator,
        scene.tiles,
    )
    noise = {"noise": np.broadcast_to(np.float64(actual), everywhere)}
    outcome = WAYS[choice.way](task, Hands()).outcome(noise, None)
    variance, width = outcome.expected.variance, float(np.median(widths(outcome.expected.resolved)))
    return Prediction(
        measurements=model.measurements,
        unknowns=model.unknowns,
        rank=None,
        null_space=None,
        condition=None,
        mse=float(variance.mean()),
        trimmed_mse=trimmed(variance, (camera.rows, camera.columns)),
        trim=TRIM,
        degrees_of_freedom=outcome.expected.degrees_of_freedom,
        resolution=width if isfinite(width) else None,
        method=outcome.solver.method,
    )
