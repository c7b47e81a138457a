"""Predictions of runs: against runs, against cameras drawn at random, and what they say of themselves."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from ommatid.analysis.predict import FIXED, needs_no_rays, predict_scene
from ommatid.analysis.predicted_recording import predicted_recording
from ommatid.analysis.prediction_table import json_of, rows
from ommatid.reconstruct.forms.cholesky import information
from ommatid.reconstruct.misalignment.moments import MisalignedMoments, mismatch_of_image, mismatch_variance
from ommatid.reconstruct.restore import restore
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration import pilot
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import light, render

from ..conftest import Command
from ..examples import GALLERY, needs, not_none, slow, tile_problem
from ..runs import document

TILE = GALLERY / "tile19.toml"
FEW = ("noise.variance=1e-2", "render.samples=1024", "calibration.samples=1024", "calibration.method=transport")
BLUR = tuple(f'camera.lens.{name}.aperture="0.8 mm"' for name in ("I", "II", "III"))
DIFFRACTION = (*BLUR, 'camera.wavelength="550 nm"', 'camera.lens_pitch="1 mm"')
DISTORTION = tuple(f"camera.lens.{name}.distortion=[0.05,0.02]" for name in ("I", "II", "III"))


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1, 150])
def test_an_overexposed_frame_has_the_error_of_the_dense_problem(limit: int) -> None:
    """Transfer functions of its mean weights would spread what the saturated region lacks over all of it."""
    changes = (f"noise.saturation={limit}", "target.shape=[47,47]")
    frame, dense = (
        predict_scene(read(GALLERY / "photo.toml", (*changes, *each)), rays=False)
        for each in (("estimator.method=frame",), ())
    )
    assert (frame.method, dense.method) == ("frame", "covariance")
    assert frame.mse == pytest.approx(dense.mse, rel=5e-3)
    assert frame.mse_for_picture is None
    assert any("saturated pixels alone" in words for words in frame.assumes)


@pytest.mark.parametrize(
    ("changes", "lenses"),
    [
        slow((), (), id="three types"),
        pytest.param(("calibration.method=ideal",), ("I", "II"), id="two types, ideal"),
        *(
            slow(changes, (), id=name)
            for name, changes in (
                ("odd array", ("camera.lens.II.array=[3,4]", "camera.lens.II.pixels=fit")),
                ("diffraction", DIFFRACTION),
                ("distortion", DISTORTION),
                ("misaligned", ('camera.tolerance.position="1 um"',)),
                ("auto", ("render.samples=auto", "calibration.samples=auto")),
            )
        ),
    ],
)
def test_a_prediction_lies_in_the_interval_of_the_run(changes: tuple[str, ...], lenses: tuple[str, ...]) -> None:
    needs("llvm_ad_mono")
    asked = ("calibration.samples=1024", "calibration.method=ideal") if "calibration.samples=auto" in changes else ()
    scene = read(TILE, (*FEW, *changes, *asked), lenses)
    setup = Setup.from_scene(scene)
    predicted = predict_scene(read(TILE, (*FEW, *changes), lenses))
    truth = setup.image.astype(np.float32).astype(np.float64).ravel()
    run = restore(render(setup), calibrate(setup), truth)
    assert not_none(run.interval).low < not_none(predicted.mse_for_picture) < not_none(run.interval).high
    assert sum(not_none(predicted.budget).values()) == pytest.approx(predicted.mse, rel=1e-9)


@pytest.mark.slow
def test_diffraction_with_distortion_has_no_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    needs("llvm_ad_mono")
    monkeypatch.setattr(pilot, "MOST_RAYS", 2**21)
    predicted = predict_scene(read(TILE, (*FEW, *DIFFRACTION, *DISTORTION)))
    alone = predict_scene(read(TILE, (*FEW, *DIFFRACTION)))
    assert any("pilot's rays" in sentence for sentence in predicted.assumes)
    assert predicted.mse_for_picture == pytest.approx(alone.mse_for_picture, rel=0.5), "a little distortion is little"
    assert predict_scene(read(TILE, (*FEW, *DIFFRACTION)), rays=False).mse < 0.5 * alone.mse


@pytest.mark.parametrize(
    ("file", "changes"),
    [
        slow("tile19", (), id="pinholes"),
        slow("tile19", DIFFRACTION, id="light beside the target"),
        pytest.param("tile19", ("target.detail=3",), id="a finer picture"),
        pytest.param("corridor", ("target.shape=[19,19]", 'target.pixel_pitch="120 mm"'), id="a world with depth"),
    ],
)
def test_a_prediction_knows_the_variance_of_a_rendering(file: str, changes: tuple[str, ...]) -> None:
    """Against the scatter of eight renderings: 7 x 706 degrees of freedom, but neighbours go together."""
    needs("llvm_ad_mono")
    few = (*FEW, *changes, "render.samples=256", "calibration.method=ideal")
    setups = [Setup.from_scene(read(GALLERY / f"{file}.toml", (*few, f"render.seed={seed}"))) for seed in range(9)]
    values = [light(setup).mean for setup in setups[1:]]
    stated = predicted_recording(setups[0]).stack.rendering_variance
    assert stated.mean() == pytest.approx(np.var(values, axis=0, ddof=1).mean(), rel=0.15)


@pytest.mark.slow
def test_an_h_around_the_true_one_deviates_as_a_calibration_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """With half the passes, and with fewer samples in each of them."""
    needs("llvm_ad_mono")
    setup = Setup.from_scene(read(TILE, FEW))
    true, plans = ideal_matrix(setup.camera), pilot.calibration_plans(setup)
    norms: list[float] = []
    for most in (2**26, 600_000, 200_000):
        monkeypatch.setattr(pilot, "MOST_RAYS", most)
        around = pilot.pilot(setup, plans).around(true)
        norms.append(float(np.sqrt(np.square((around.matrix - true).data).sum())))
        assert around.variance.sum() == pytest.approx(norms[-1] ** 2, rel=0.15)
    assert norms[1] == pytest.approx(norms[0], rel=0.1)
    assert norms[2] == pytest.approx(norms[0], rel=0.5), "extrapolated: edges of texels do not follow a power"


def test_a_predicted_h_has_the_errors_of_one_calibration() -> None:
    """It deviates from the true one by its stated variances, within 3 %; by twice as much if errors are drawn again."""
    needs("llvm_ad_mono")
    setup = Setup.from_scene(read(TILE, (*FEW, "calibration.fit=none")))
    model = predicted_recording(setup).model
    away = np.square((model.matrix - ideal_matrix(setup.camera)).data).sum()
    assert away == pytest.approx(model.variance.sum(), rel=0.15)


@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_an_estimator_with_the_wrong_h(stretch: float) -> None:
    """By Eq. 5 with matrices: A of one H, light of another that scatters, before images of another prior."""
    rng = np.random.default_rng(0)
    problem = tile_problem(2, 1.0)
    form, count = information(problem), problem.measurements
    true = problem.matrix + 0.02 * problem.matrix.multiply(rng.normal(size=problem.matrix.shape))
    gain, prior = form.gain(np.eye(count)), replace(problem.prior, root=stretch * problem.prior.root)
    used = np.ones(count, dtype=np.bool_)
    slices = [slice(start, min(start + 9, count)) for start in range(0, count, 9)]
    roots = [rng.normal(size=(each.stop - each.start, 2)) for each in slices]
    moments = MisalignedMoments(true.tocsr(), tuple(root @ root.T for root in roots))
    scatter = np.square(gain @ linalg.block_diag(*roots)).sum(axis=1)
    left, lost = (np.eye(problem.unknowns) - gain @ h for h in (problem.matrix.toarray(), true.toarray()))
    known, missing = (prior.variance[0] * np.square(each).sum(axis=1) for each in (left, lost))
    missing += np.square(gain @ ((true - problem.matrix) @ prior.mean))
    added = mismatch_variance(form, used, moments, slices, prior)
    np.testing.assert_allclose(known + added, missing + scatter, rtol=1e-8)
    image = prior.mean + 50 * rng.normal(size=problem.unknowns)
    error = prior.mean + gain @ (true @ image - problem.matrix @ prior.mean) - image
    as_stated = prior.mean + gain @ (problem.matrix @ (image - prior.mean)) - image
    of_image = mismatch_of_image(form, used, moments, slices, image)
    np.testing.assert_allclose(np.square(as_stated) + of_image, np.square(error) + scatter, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_a_tolerance_as_designed_and_calibrated_side_by_side(ommatid: Command) -> None:
    needs("llvm_ad_mono")
    loose = ("--set", 'camera.tolerance.position="41 nm"', "--set", "calibration.samples=1024")
    (ideal,) = document(ommatid("predict", TILE, *loose, "--set", "calibration.method=ideal", "--json"))
    assert ideal["mse"] == ideal["as_designed"]["mse"] > 5 * ideal["calibrated"]["mse"]
    assert sum(ideal["budget"].values()) == pytest.approx(ideal["mse"], rel=1e-9)
    assert "mean over assemblies" in " ".join(ideal["assumes"])
    assert "with a calibrated H" in ommatid("predict", TILE, *loose).out


def test_without_a_fast_backend_it_is_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.simulate.calibration.pilot.choose", lambda _: "scalar_rgb")
    scene = read(TILE, FEW)
    predicted, closed = predict_scene(scene), predict_scene(scene, rays=False)
    assert predicted.mse == closed.mse
    assert "scalar backend" in predicted.assumes[0]
    assert rows([json_of(predicted)])[0][0] == "assumes"


def test_without_mitsuba_it_is_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "drjit", None)
    assert "not installed" in predict_scene(read(TILE, FEW)).assumes[0]


def test_adaptive_samples_of_a_camera_that_sees_the_same_everywhere_need_no_rays() -> None:
    """Rays are traced where samples are fixed, H is drawn at random or has no closed form, and before worlds."""
    assert "samples 'auto'" in predict_scene(read(TILE)).assumes[0]
    auto = Setup.from_scene(read(TILE))
    assert needs_no_rays(auto)
    for change in (
        'camera.tolerance.position="1 um"',
        "calibration.samples=64",
        "camera.lens.I.distortion=[0.05,0.02]",
    ):
        assert not needs_no_rays(Setup.from_scene(read(TILE, (change,)))), change
    assert not needs_no_rays(Setup.from_scene(read(GALLERY / "corridor.toml")))
    assert needs_no_rays(Setup.from_scene(read(GALLERY / "sensor119.toml"))), "its entries took 23 GB"


def test_fixed_samples_behind_blurred_lenses_are_left_out_and_the_interval_with_them() -> None:
    blurred = read(GALLERY / "sensor119.toml", ("target.detail=1",))
    prediction = predict_scene(blurred)
    assert prediction.assumes[0] == FIXED
    assert prediction.mse == predict_scene(blurred, rays=False).mse
    assert (prediction.mse_for_picture, prediction.interval) == (None, None)


def test_it_says_where_nothing_is_recovered(ommatid: Command) -> None:
    dark = ("--set", "noise.variance=1e8", "--no-rays")
    assert document(ommatid("predict", TILE, *dark, "--json"))[0]["recovers_nothing"]
    assert "nothing is recovered" in ommatid("predict", TILE, *dark).out
    assert "nothing is recovered" not in ommatid("predict", TILE, "--no-rays").out


@pytest.mark.slow
def test_a_scene_without_a_picture(tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    scene = tmp_path / "scene.toml"
    scene.write_text(TILE.read_text().replace("photo:camera", "missing.png"))
    predicted = predict_scene(read(scene, FEW))
    known = predict_scene(read(TILE, FEW))
    assert predicted.mse_for_picture is None
    assert "cannot be read" in predicted.assumes[0]
    assert predicted.mse > known.mse, "white noise has more contrast than the photograph"
    assert "mse_for_picture" not in json_of(predicted)
