"""The error that a run of a scene will have, from the recording that it would give.

The recording is reconstructed as a run's is, with the same choice of methods, prior and noise. Without rays its image
is known: the noise is that of this image, and of a frame whose lens types see the same everywhere transfer functions
give the error. Where the estimator's H is not that of the camera which records, Eq. 5 gains what the difference brings:
on average over assemblies within camera.tolerance, or of the lenses as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ommatid.reconstruct.assumptions import Assumptions, assumptions_at, assumptions_for, with_fallback
from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.frame.frame_method import FrameMethod
from ommatid.reconstruct.frame.readings import leaves_null_space
from ommatid.reconstruct.frame.windows import varies_over_field
from ommatid.reconstruct.method_choice import METHODS, MethodChoice
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import Execution, MethodResult
from ommatid.reconstruct.misalignment.moments import (
    CAUSE,
    MisalignedMoments,
    misaligned_moments,
    mismatch_of_image,
    mismatch_variance,
)
from ommatid.reconstruct.noise import OVEREXPOSED, overexposed, undithered, usable_pixels
from ommatid.reconstruct.prediction import Prediction, observability
from ommatid.reconstruct.prior import Prior
from ommatid.reconstruct.restore import BUDGET, truth_for
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.optics.negligible import assumptions
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import PriorTable

from .predicted_recording import PredictedRecording, predicted_recording, recording_without_rays

MODEL = "model"  # in the budget: H as designed is not that of the lenses
UNPREDICTED = "is seen by saturated pixels alone, and what the light beyond their limit adds to the error is left out"
BY_TRANSFER = "Eq. 5 by transfer functions, with edges, to 2 %"
BY_MEANS = "Eq. 5 by transfer functions of the mean over each lens's field, to 5 %"


@dataclass(frozen=True)
class _Outcome:
    """A reconstruction of the predicted recording."""

    choice: MethodChoice
    assumed: Assumptions
    result: MethodResult


@dataclass(frozen=True)
class _Mismatch:
    """What the difference between the camera's H and the estimator's adds.

    variance : (N,) to Eq. 5;  of_picture : mean over the pixels of the picture's, None without one
    """

    cause: str
    variance: FloatArray
    of_picture: float | None
    assumes: tuple[str, ...]


def predict_run(setup: Setup) -> Prediction:
    """Predict what a run of a scene states and measures. Raises InputError as a run does."""
    recording = predicted_recording(setup)
    outcome = _reconstructed(recording)
    prediction = _prediction(setup, recording, outcome)
    if setup.camera.tolerance is None or not setup.camera.has_sharp_footprints or not _dense(outcome):
        return prediction
    return replace(
        prediction,
        as_designed=_mse_with(setup, "ideal", prediction),
        calibrated=_mse_with(setup, "transport", prediction),
    )


def predict_without_rays(setup: Setup, assumes: tuple[str, ...], *, picture: bool = True) -> Prediction:
    """Predict the error of a perfect rendering and the ideal H.

    assumes : what is taken for granted, which the prediction says first
    picture : False leaves out the error of the scene's picture, where images of the prior alone matter
    Raises InputError where H has no closed form.
    """
    recording, camera = recording_without_rays(setup), setup.camera
    stack, model = recording.stack, recording.model
    # In front of detail no wave is hidden exactly, but the error of a picture by nearly hidden ones is its own.
    null_space = leaves_null_space(camera) and (picture or not camera.has_detail)
    alike = camera.is_sliding and camera.tolerance is None and not null_space
    alike = alike and overexposed(model, usable_pixels(stack, model)) <= OVEREXPOSED

    def work(choice: MethodChoice) -> _Outcome:
        quick = alike and choice.method == "frame"
        assumed = assumptions_at(stack, model, choice, recording.image, Execution(quick=quick))
        if quick and undithered(assumed.noise) is not None:
            # Errors of rounding that measurements share depend on the readings.
            assumed = assumptions_at(stack, model, choice, recording.image, Execution())
        truth = truth_for(assumed.method, recording.truth, stack.camera) if picture else None
        return _Outcome(choice, assumed, assumed.result(truth))

    outcome = with_fallback(stack, model, work)
    method = outcome.assumed.method
    if isinstance(method, FrameMethod) and method.quick_bands is not None:
        assumes = (*assumes, BY_MEANS if varies_over_field(model.applied) else BY_TRANSFER)
    return _prediction(setup, replace(recording, assumes=(*assumes, *recording.assumes)), outcome)


def _mse_with(setup: Setup, method: str, prediction: Prediction) -> float:
    """Return the error with H as designed or calibrated, of an estimator that takes it for exact."""
    scene = setup.scene
    asked = scene.calibration.method == "ideal"
    if asked == (method == "ideal") and scene.estimator.misalignment == "trust":
        return prediction.mse
    calibration = scene.calibration.model_copy(
        update={"method": method, **({"fit": None} if method == "ideal" else {})}
    )
    estimator = scene.estimator.model_copy(update={"misalignment": "trust"})
    changed = replace(setup, scene=with_tables(scene, calibration=calibration, estimator=estimator))
    recording = predicted_recording(changed)
    return _prediction(changed, recording, _reconstructed(recording)).mse


def _reconstructed(recording: PredictedRecording) -> _Outcome:
    stack, model = recording.stack, recording.model

    def work(choice: MethodChoice) -> _Outcome:
        assumed = assumptions_for(stack, model, choice, Execution())
        truth = truth_for(assumed.method, recording.truth, stack.camera)
        return _Outcome(choice, assumed, assumed.result(truth))

    return with_fallback(stack, model, work)


def _prediction(setup: Setup, recording: PredictedRecording, outcome: _Outcome) -> Prediction:
    expected, given, camera = outcome.result.expected, outcome.result.interval, setup.camera
    hidden = overexposed(outcome.assumed.method.task.model, outcome.assumed.usable)
    if hidden > OVEREXPOSED:
        given = None  # its error depends on how far the light exceeds the limit
    mismatch = _mismatch(setup, recording, outcome)
    variance = expected.variance if mismatch is None else expected.variance + mismatch.variance
    parts = {"null_space": expected.missing, **expected.parts}
    budget = {name: parts.get(name, 0.0) for name in BUDGET} | parts
    if mismatch is not None:
        budget[mismatch.cause] = float(mismatch.variance.mean())
    seen = None
    if _dense(outcome):
        of_pixels = model_of_f(recording.certain, camera, PriorTable())
        seen = observability(of_pixels.matrix[outcome.assumed.usable.used])
    return Prediction.of(
        variance,
        expected,
        seen,
        camera.shape,
        measurements=int(outcome.assumed.usable.used.sum()),
        method=outcome.result.solver.method,
        misalignment=budget.get(CAUSE),
        prior_variance=setup.scene.prior_ratio * outcome.assumed.prior.variance,
        mse_for_picture=None if given is None else given.mse + (mismatch.of_picture or 0.0 if mismatch else 0.0),
        interval=None if given is None or mismatch is not None else (given.low, given.high),
        budget=budget,
        assumes=(
            *recording.assumes,
            *((f"{100 * hidden:.3g} % of the image {UNPREDICTED}",) if hidden > OVEREXPOSED else ()),
            *(() if mismatch is None else mismatch.assumes),
            *assumptions(setup.scene, setup.camera),
        ),
    )


def _dense(outcome: _Outcome) -> bool:
    return outcome.choice.method == "dense"


def _mismatch(setup: Setup, recording: PredictedRecording, outcome: _Outcome) -> _Mismatch | None:
    """Return what the camera's deviation from the estimator's H brings; None where there is none."""
    if recording.true is None or setup.scene.estimator.misalignment != "trust":
        return None
    method = outcome.assumed.method
    if not isinstance(method, DenseMethod) or setup.camera.has_detail:
        return _mismatch_of_images(recording, outcome, _cause(setup.camera))
    camera, used = setup.camera, outcome.assumed.usable.used
    prior = method.task.prior_on(camera.shape).scaled(setup.scene.prior_ratio)
    form, slices = method.estimate.form, setup.camera.slices()
    averaged = camera.tolerance is not None and camera.has_sharp_footprints
    of_picture = None
    if recording.truth is not None:
        image = Prior(recording.truth, np.zeros(camera.unknowns))
        moments = misaligned_moments(camera, image) if averaged else MisalignedMoments(recording.true, ())
        of_picture = float(mismatch_of_image(form, used, moments, slices, recording.truth).mean())
    moments = misaligned_moments(camera, prior) if averaged else MisalignedMoments(recording.true, ())
    variance = mismatch_variance(form, used, moments, slices, prior)
    said = "H as designed; the error is the mean over assemblies within camera.tolerance"
    if not averaged:
        said = "H as designed; the error is that of these lenses, for an estimator that does not know them"
    return _Mismatch(_cause(camera), variance, of_picture, (said,))


def _cause(camera: Camera) -> str:
    return MODEL if camera.tolerance is None else CAUSE


def _mismatch_of_images(recording: PredictedRecording, outcome: _Outcome, cause: str) -> _Mismatch:
    """Return the same of a frame, from the error of noiseless readings of the image by the true H.

    Their estimate is off by the expected error of the image less that by noise.
    """
    if recording.true is None:
        raise ValueError("expected a camera whose H differs from the estimator's, got one that it knows")
    task, world = outcome.assumed.method.task, recording.image
    image = averaged(world.reshape(recording.model.camera.shape), task.model.camera.detail).ravel()
    if recording.model.camera.shape == task.model.camera.shape:
        image = world
    readings = {"true": recording.true @ world, "designed": recording.model.forward(world)}
    errors = {
        name: np.square(METHODS[outcome.choice.method](replace(task, recorded=values), Execution()).image - image)
        for name, values in readings.items()
    }
    added = errors["true"] - errors["designed"]
    said = "H as designed; the error is that of one image and of the assembly that camera.tolerance draws"
    of_picture = None if recording.truth is None else float(added.mean())
    return _Mismatch(cause, np.broadcast_to(added.mean(), image.shape), of_picture, (said,))
