"""Reconstruct one stack with several models of H, and compare the measured with the expected errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.output.run_json import StudyCase
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import StudyModel
from ommatid.simulate.calibrate import StoppingRule, cached_model
from ommatid.simulate.ideal import ideal_model, true_model

LABELS = {
    "ideal": "the ideal H",
    "points": "H of rendered point sources",
    "transport": "H by ray transport",
    "fitted": "H fitted to the stack itself",
    "true": "the true H",
}


def check_study(scene: Scene, camera: Camera) -> None:
    """Raise InputError where a study names a model with which this camera cannot be reconstructed."""
    for name in () if scene.study is None else scene.study.models:
        choose_method(_with_misalignment(scene, name), camera, camera.is_applied)
        if name == "true" and camera.tolerance is not None and not camera.has_sharp_footprints:
            raise InputError(
                f"{scene.source}: study.models: the 'true' H of misaligned lenses with surfaces or blur has no closed"
                " form; leave it out"
            )


def _with_misalignment(scene: Scene, name: str) -> Scene:
    estimator = scene.estimator.model_copy(update={"misalignment": "fit" if name == "fitted" else "trust"})
    return scene.model_copy(update={"estimator": estimator})


def study_cases(
    stack: Stack,
    models: Mapping[StudyModel, Callable[[], Model]],
    truth: FloatArray | None,
    progress: Progress = no_progress,
) -> tuple[StudyCase, ...]:
    """Reconstruct a stack with each model of H, which are made one after the other. Raises what `restore` raises."""
    cases: list[StudyCase] = []
    for name, model in models.items():
        done = restore(replace(stack, scene=_with_misalignment(stack.scene, name)), model(), truth)
        given = done.interval
        case = StudyCase(
            model=name,
            mse=None if done.error is None else done.error.mse,
            predicted=done.expected.mse,
            expected=None if given is None else given.mse,
            low=None if given is None else given.low,
            high=None if given is None else given.high,
            seconds=done.seconds,
        )
        cases.append(case)
        progress(len(cases) / len(models))
    return tuple(cases)


def rows(cases: Sequence[StudyCase]) -> list[tuple[str, str]]:
    """Return the model and its errors, one row per case."""
    lines: list[tuple[str, str]] = []
    for case in cases:
        words = f"predicted {error_words(case.predicted)}"
        if case.mse is not None:
            words = f"mean squared error {error_words(case.mse)}, {words}"
        if case.mse is not None and case.low is not None and case.high is not None:
            position = "inside" if case.low <= case.mse <= case.high else "OUTSIDE"
            words += f"; for this picture {case.expected:.4g}, {position} {case.low:.4g} to {case.high:.4g}"
        lines.append((LABELS[case.model], words))
    return lines


def study_models(
    setup: Setup, folder: Path, progress: Progress, stopping_rule: StoppingRule | None = None
) -> dict[StudyModel, Callable[[], Model]]:
    """Return by name the functions that make the models of a scene's study; calibrated ones are cached in `folder`."""

    scene, camera = setup.scene, setup.calibrated.camera

    def make(name: StudyModel) -> Model:
        if name == "true":
            return true_model(setup.resolved, camera)
        if name not in ("points", "transport"):
            return ideal_model(setup.resolved, camera)
        calibration = scene.calibration.model_copy(update={"method": name})
        path = folder / ("model.npz" if name == scene.calibration.method else f"model.{name}.npz")
        changed = replace(setup, scene=scene.model_copy(update={"calibration": calibration}))
        return cached_model(path, changed, progress, stopping_rule)[0]

    return {name: partial(make, name) for name in (() if scene.study is None else scene.study.models)}
