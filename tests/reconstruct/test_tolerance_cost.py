"""The predicted cost of a tolerance: against cameras and images drawn at random, limits, and the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.reconstruct.estimator.estimate import factorise
from ommatid.reconstruct.misalignment.tolerance_cost import misalignment_variance
from ommatid.reconstruct.prior import exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.simulate.ideal import ideal_matrix, true_matrix

from ..conftest import Command
from ..examples import GALLERY, scene
from ..runs import document

NOISE = 0.1
DRAWS = 300
ALL = np.ones(1000, dtype=np.bool_)


def drawn_to(position: str, seed: int = 0) -> Camera:
    camera = derive(scene((12, 12), (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))))
    return replace(camera, tolerance=ToleranceTable.model_validate({"position": position, "seed": seed}))


@pytest.mark.parametrize("smooth", [False, True])
def test_the_cost_is_the_mean_error_over_cameras_and_images(smooth: bool) -> None:
    camera = drawn_to("60 nm")
    paper = exponential(127.5, 5461.25, (12, 12), 6.0) if smooth else independent(127.5, 5461.25, 144)
    matrix = ideal_matrix(camera)
    form, _ = factorise(Problem(matrix, paper, np.full(camera.measurements, NOISE)), "auto", 1e-8)
    added = float(misalignment_variance(form, ALL[: camera.measurements], camera, paper).mean())
    rng = np.random.default_rng(0)
    differences: list[float] = []
    for seed in range(DRAWS):
        image = paper.mean + paper.apply_root(rng.standard_normal(paper.dimension))
        noise = rng.normal(0, NOISE**0.5, camera.measurements) - matrix @ paper.mean
        estimates = (paper.mean + form.gain(h @ image + noise) for h in (true_matrix(drawn_to("60 nm", seed)), matrix))
        misaligned, designed = (float(np.square(estimate - image).mean()) for estimate in estimates)
        differences.append(misaligned - designed)
    spread = float(np.std(differences, ddof=1)) / DRAWS**0.5
    assert np.mean(differences) > 5 * spread, "misalignment raises the error"
    assert added == pytest.approx(float(np.mean(differences)), abs=4 * spread)


def test_the_cost_falls_with_the_tolerance() -> None:
    costs: list[float] = []
    for position in ("80 nm", "40 nm", "1e-6 nm"):
        camera, prior = drawn_to(position), independent(127.5, 5461.25, 144)
        form, _ = factorise(Problem(ideal_matrix(camera), prior, np.full(camera.measurements, NOISE)), "auto", 1e-8)
        costs.append(float(misalignment_variance(form, ALL[: camera.measurements], camera, prior).mean()))
    assert 2 < costs[0] / costs[1] < 4.5, "between linear and quadratic, because of kinks"
    assert costs[2] < 1e-6


def test_predict_includes_the_cost(tmp_path: Path, ommatid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tile = (GALLERY / "tile19.toml", "--no-rays", "--set", "noise.variance=1e-2")
    strict = document(ommatid("predict", *tile, "--json"))
    loose = document(ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"', "--json"))
    assert "misalignment" not in strict
    assert loose["mse"] == pytest.approx(strict["mse"] + loose["misalignment"], rel=1e-6)
    assert loose["misalignment"] > 1
    assert "by misalignment" in ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"').out
    robust = ("--set", 'camera.tolerance.position="41 nm"', "--set", "estimator.misalignment=robust", "--json")
    trusting = ("--set", 'camera.tolerance.position="41 nm"', "--json")
    assert document(ommatid("predict", *tile, *robust))["mse"] < document(ommatid("predict", *tile, *trusting))["mse"]
    ended = ommatid("predict", *tile, *robust[:2], "--set", "estimator.misalignment=fit")
    assert ended.code == 2
    assert "recorded stack" in ended.err


def test_predict_with_saturated_pixels_and_with_blurred_lenses(ommatid: Command) -> None:
    """Saturated pixels are left out of both; a cost without closed form is reported as missing."""
    loose = ("--set", 'camera.tolerance.position="10 nm"')
    aperture = [part for name in ["I", "II", "III"] for part in ("--set", f'camera.lens.{name}.aperture="0.4 mm"')]
    aperture += ["--set", 'camera.wavelength="none"']
    sensor = ("--set", "noise=", "--set", 'sensor.illuminance="500 lux"', "--set", 'sensor.exposure="10 ms"')
    bright = document(ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *aperture, *sensor, *loose, "--json"))
    assert bright["measurements"] < 706
    assert bright["misalignment"] > 0
    known = ("--set", "prior.kind=independent")  # a fitted prior takes a stack
    lens = ommatid("predict", "--no-rays", GALLERY / "doublet.toml", *loose, *known)
    assert lens.code == 0
    assert "not included" in lens.out
    assert "not included" not in ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *loose).out
    ranked = document(ommatid("design", GALLERY / "tile19.toml", *aperture, *sensor, "--candidates", "1/2", "--json"))
    assert ranked["candidates"][0]["expected"] is not None, "the added type has the aperture of the others"
