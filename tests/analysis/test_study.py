"""Estimators that expect misalignment, and studies of several models of H."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.analysis import study
from ommatid.reconstruct.output import facts
from ommatid.reconstruct.output.report import report_of
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix

from ..conftest import Command
from ..examples import needs, not_none, scene
from ..runs import document

ONE = (("1/2", [3, 3], [8, 8]),)
FIT = {"misalignment": "fit"}
SMOOTH = {"kind": "exponential", "correlation_length": "25 mm"}


def misaligned(how: str = "trust", shape: tuple[int, int] = (18, 18), **tables: Any) -> Scene:
    tables = {"prior": SMOOTH, "noise": {"variance": 1e-2}, "estimator": {"misalignment": how}, **tables}
    data = scene(shape, ONE, **tables).plain()
    data["camera"]["tolerance"] = {"position": "300 nm"}
    return parse(data, Path("test.toml"))


def recorded(described: Scene) -> tuple[Stack, Model, FloatArray]:
    """The stack of the misaligned camera, H as designed, and the truth."""
    camera, truth = derive(described), load(described).ravel()
    noise = np.random.default_rng(4).normal(0, 0.1, camera.measurements)
    values = true_matrix(camera) @ truth + noise
    record = {"seconds": 0.0, "versions": {}, "seed": 3, "first_seed": 3}
    model = ideal_model(described, camera)
    model = replace(model, record={**model.record, "seconds": 0.0, "versions": {}})
    return Stack(described, camera, values, np.zeros_like(values), record), model, truth


@cache
def restored(how: str) -> Reconstruction:
    return restore(*recorded(misaligned(how)))


@pytest.mark.slow
def test_a_misaligned_camera_with_each_estimator() -> None:
    """With H as designed the error leaves its interval; with a fitted H it is inside, close to that of the true H."""
    restorations = {how: restored(how) for how in ("trust", "fit")}
    stack, model, truth = recorded(misaligned())
    camera = derive(misaligned())
    best = restore(stack, exact_model(stack.scene, camera, true_matrix(camera), "true"), truth)
    errors = {how: one.error.mse for how, one in restorations.items() if one.error is not None}
    assert errors["trust"] > not_none(restorations["trust"].interval).high
    assert errors["fit"] < not_none(restorations["fit"].interval).high
    assert errors["fit"] < 0.5 * errors["trust"]
    assert errors["fit"] < 1.5 * not_none(best.error).mse
    fitted = restorations["fit"]
    assert sum(fitted.budget().values()) == pytest.approx(fitted.expected.mse, rel=1e-6)
    assert fitted.budget()["misalignment"] > 0
    assert fitted.choice.method == "fit"
    assert "  from misalignment of the lenses" in dict(facts.rows(report_of(stack, model, fitted)))


def test_the_deviation_of_a_region_includes_misalignment() -> None:
    fitted = restored("fit")
    mean, deviation = fitted.region((4, 4), (6, 6))
    assert abs(mean - not_none(fitted.truth).reshape(18, 18)[4:10, 4:10].mean()) < 5 * deviation


@pytest.mark.parametrize(
    ("described", "message"),
    [
        (scene((18, 18), ONE, estimator=FIT), r"needs to know what may be misaligned, got no \[camera.tolerance\]"),
        (misaligned("fit", (80, 80)), "serves up to 4000 pixels of f, got 6400"),
        (misaligned(estimator=FIT | {"method": "tiles"}), "takes one dense problem, got estimator.method 'tiles'"),
        (misaligned(estimator=FIT | {"memory": "1 MB"}), "are allowed; raise estimator.memory"),
    ],
)
def test_cameras_and_keys_that_a_fit_does_not_serve_are_refused(described: Scene, message: str) -> None:
    with pytest.raises(InputError, match=message):
        restore(*recorded(described))


def test_an_impossible_study_is_refused_before_it_starts() -> None:
    for models, lens, words in (
        (["ideal", "fitted"], {"aperture": "0.4 mm", "focus": "600 mm"}, "serves pinholes and thin lenses in focus"),
        (["ideal", "true"], {"aperture": "0.4 mm", "focus": "600 mm"}, "the 'true' H of misaligned lenses"),
    ):
        data = misaligned().plain()
        data["camera"]["lens"][0] |= lens
        data["study"] = {"models": models}
        described = parse(data, Path("test.toml"))
        with pytest.raises(InputError, match=words):
            study.check_study(described, derive(described))


def test_a_study_says_which_errors_are_inside_their_intervals() -> None:
    stack, model, truth = recorded(misaligned())
    true = exact_model(stack.scene, stack.camera, true_matrix(stack.camera), "true")
    rows = dict(study.rows(study.study_cases(stack, {"ideal": lambda: model, "true": lambda: true}, truth)))
    assert "OUTSIDE" in rows["the ideal H"]
    assert "inside" in rows["the true H"]


@pytest.mark.slow
def test_a_study_from_the_command_line(tmp_path: Path, ommatid: Command) -> None:
    """Real lenses: point sources and transport give the same error."""
    needs("llvm_ad_mono")
    lens = {"aperture": "0.4 mm", "focus": "600 mm"}
    data = scene((12, 12), (("1/3", [2, 2], [3, 3]),), noise={"variance": 1e-2}).plain()
    data["camera"]["lens"][0] |= lens
    data |= {"render": {"samples": 256}, "calibration": {"samples": 256, "method": "transport"}}
    data["study"] = {"models": ["points", "transport", "ideal"]}
    from ommatid.scenes.scene import write

    write(tmp_path / "lens.toml", parse(data, tmp_path / "lens.toml"))
    report = document(ommatid("run", "lens.toml", "-o", "out", "--json"))[0]
    by_name = {case["model"]: case for case in report["study"]}
    assert by_name["points"]["mse"] == pytest.approx(by_name["transport"]["mse"], rel=1e-9)
    kept = json.loads((tmp_path / "out" / "lens" / "run.json").read_text(encoding="utf-8"))
    assert kept["study"] == report["study"]
    assert document(ommatid("run", "lens.toml", "-o", "out", "--json"))[0]["study"] == report["study"]
