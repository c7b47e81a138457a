"""Calibration by few numbers, against closed forms, multinomial draws from them, and traced rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from ommatid.scenes import model_file
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.view import K1, MAGNIFICATION, ROTATION, misaligned, scales
from ommatid.scenes.formats.picture import load
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.optics.lens_matrix import matrix
from ommatid.scenes.pose import misalignments
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.fit.chart import SIDE, chart_of
from ommatid.simulate.calibration.fit.fit import FittedCalibration, calibrate_by_fit
from ommatid.simulate.calibration.responses import Responses, Subsets
from ommatid.simulate.ideal import ideal_matrix, true_matrix
from ommatid.simulate.sampling.passes import BATCHES, FEWEST_PASSES, Plan

from ..examples import THREE, camera, needs, with_optics

FEW = (("1/3", [2, 2], [5, 5]), ("1/4", [2, 1], [4, 4]))
WRONG = {"tolerance": {"position": "1 um", "rotation": "1 deg", "focal_length": 0.01}}
MOVED = {"tolerance": {"position": "1 um"}}
RAYS = 1024


def multinomial(matrix: sparse.csr_array, rng: np.random.Generator, passes: int, rays: int) -> Responses:
    """Entries from independent rays: a multinomial draw for each row and pass, with the light beside the target."""
    shares = np.maximum(matrix.toarray(), 0.0)
    shares = np.column_stack([shares, np.maximum(1 - shares.sum(axis=1), 0.0)])
    shares /= shares.sum(axis=1, keepdims=True)
    drawn = rng.multinomial(rays, shares, size=(passes, len(shares)))[..., :-1] / rays
    mean = sparse.csr_array(drawn.mean(axis=0))
    at = np.repeat(np.arange(len(shares)), np.diff(mean.indptr)), mean.indices
    batches = drawn.reshape(passes // BATCHES, BATCHES, *mean.shape).mean(axis=0)[:, *at] - mean.data
    variance = drawn[:, *at].var(axis=0, ddof=1) / passes
    return Responses(Plan(passes, rays), {}, mean, variance, batches.astype(np.float32))


def drawn(cam: Camera, matrix: sparse.csr_array, rays: int, seed: int) -> FittedCalibration:
    """Return the calibration by independent rays of an H."""
    rng = np.random.default_rng(seed)

    def measure(subsets: Subsets) -> Responses:
        kept = np.zeros((matrix.shape[0], 1))
        for lens, rows in zip(cam.types, cam.type_slices(), strict=True):
            if lens.name in subsets:
                pixels = subsets[lens.name]
                kept[np.arange(rows.start, rows.stop)[slice(None) if pixels is None else pixels]] = 1
        return multinomial(sparse.csr_array(matrix * kept), rng, FEWEST_PASSES, rays // FEWEST_PASSES)

    names = [lens.name for lens in cam.types]
    return calibrate_by_fit(cam, measure, lambda responses: responses.variance, dict.fromkeys(names, rays))


def rms_error(found: sparse.csr_array, true: sparse.csr_array) -> float:
    """Return the root mean squared error of the entries that either of them has."""
    difference = sparse.csr_array(found - true)
    return float(np.sqrt(np.square(difference.data).sum() / ((found != 0) + (true != 0)).sum()))


def test_the_chart_is_a_grid_with_the_corners() -> None:
    (lens,) = camera((60, 60), (("1/3", [2, 2], [19, 3]),)).types
    pixels = chart_of(lens).reshape(4, SIDE, 3)
    down, across = np.divmod(pixels[1] - 57, 3)
    assert down[0, 0] == across[0, 0] == 0
    assert (down[-1, -1], across[-1, -1]) == (18, 2)
    whole = chart_of(lens, np.array([False, True, False, True]))
    np.testing.assert_array_equal(whole, np.r_[57:114, 171:228])


@pytest.mark.slow
def test_the_numbers_err_as_their_covariance_says() -> None:
    """Over 20 draws of 6 sub-imagers each: squared errors over their stated variances have mean 1.

    Of numbers that were measured: one that is taken as designed errs by nothing here, whatever may be wrong with it.
    """
    _, pinholes = with_optics({}, WRONG, FEW)
    true, squares, refused = true_matrix(pinholes), [], 0
    expected = [misaligned(pinholes, *each) for each in zip(pinholes.sub_imagers, misalignments(pinholes), strict=True)]
    for seed in range(20):
        fit = drawn(pinholes, true, RAYS, seed)
        refused += len(fit.record["refused"])
        for lens in pinholes.types:
            views = fit.matrix.views[lens.name]
            subs = [number for number, sub in enumerate(pinholes.sub_imagers) if sub.type == lens]
            error = views.numbers - np.array([expected[number] for number in subs])
            unit = np.array([scales(pinholes, pinholes.sub_imagers[number]) for number in subs])
            variance = np.square(views.own).sum(axis=2) + np.square(views.shared).sum(axis=2)
            measured = np.array([structure != "designed" for structure in views.structure])
            kept = (variance > (1e-6 * unit) ** 2) & views.explained[:, None] & measured
            squares += (np.square(error)[kept] / variance[kept]).tolist()
        assert {fit.matrix.views["A"].structure[number] for number in (MAGNIFICATION, ROTATION)} == {"own"}
    assert refused <= 3  # of 120, at a significance of 1 % for each camera
    deviation = np.std(squares, ddof=1) / len(squares) ** 0.5
    assert abs(np.mean(squares) - 1) < 4 * deviation
    assert deviation < 0.08


@pytest.mark.parametrize(
    ("wrong", "share"),
    [
        pytest.param({}, 0.0, id="as designed"),
        pytest.param(MOVED, 0.1, id="displaced", marks=pytest.mark.slow),
        pytest.param(WRONG, 0.15, id="rotated"),
    ],
)
def test_h_is_far_better_known_than_entry_by_entry(wrong: dict[str, Any], share: float) -> None:
    """Four numbers of nine pixels, each with 25 entries, cannot leave less than 0.13 of the entries' error."""
    _, pinholes = with_optics({}, wrong, THREE)
    true = true_matrix(pinholes)
    fit = drawn(pinholes, true, RAYS, 3)
    assert not fit.record["refused"]
    assert rms_error(fit.matrix.to_sparse(), true) <= share * rms_error(fit.responses.matrix, true)
    assert fit.matrix.is_as_designed == (not wrong)


@pytest.mark.parametrize("seeds", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_pixels_that_lose_light_count_in_rotated_views(seeds: int) -> None:
    """Outer pixels of all four sub-imagers see past the target: without them five and fewer of nine remain."""
    rotated = {"tolerance": {"position": "0.3 um", "rotation": "1 deg", "seed": 1}}
    _, pinholes = with_optics({}, rotated, (("1/5", [2, 2], [3, 3]),), (16, 16))
    true = true_matrix(pinholes)
    assert true.sum(axis=1).min() < 0.9
    for seed in range(seeds):
        fit = drawn(pinholes, true, RAYS, seed)
        assert not fit.record["refused"]
        assert rms_error(fit.matrix.to_sparse(), true) < 0.2 * rms_error(fit.responses.matrix, true)


def test_what_no_view_explains_is_measured_entry_by_entry() -> None:
    """A blur of one pixel of f in one lens type is no view; the other type's views still explain it."""
    cam = camera((19, 19), THREE[:2])
    lens = replace(cam.types[0], optics=LensOptics(aperture=0.4, focus=0.4 * cam.distance / 1.9))
    blurred = matrix(replace(cam, types=(lens, *cam.types[1:])), lens)
    fit = drawn(cam, sparse.csr_array(sparse.vstack([blurred, ideal_matrix(cam)[blurred.shape[0] :]])), RAYS, 0)
    names = {sub.name for sub in cam.sub_imagers if sub.type == cam.types[0]}
    assert set(fit.record["refused"]) == names
    assert fit.rest is not None
    lit = np.diff(fit.rest.matrix.indptr) > 0
    assert lit[: blurred.shape[0]].all()
    assert not lit[blurred.shape[0] :].any()
    assert abs(fit.rest.matrix[: blurred.shape[0]] - blurred).max() < 6 * (0.1 * 0.9 / RAYS) ** 0.5
    assert fit.matrix.views[cam.types[1].name].explained.all()


@pytest.mark.parametrize(
    ("method", "seeds"),
    [("transport", 4), *(pytest.param(method, 16, marks=pytest.mark.slow) for method in ("transport", "points"))],
)
def test_traced_rays_of_a_misaligned_camera(method: str, seeds: int, tmp_path: Path) -> None:
    """By rays through wrongly placed lenses, against exact areas; the file holds the numbers alone."""
    needs("llvm_ad_mono")
    calibration = {"samples": 256, "method": method, "fit": "auto"}
    described, cam = with_optics({}, MOVED, FEW, calibration=calibration)
    setup = Setup(described, cam)
    model, true = calibrate(setup), true_matrix(cam)
    entries = described.calibration.model_copy(update={"fit": "none"})
    raw = calibrate(Setup(described.model_copy(update={"calibration": entries}), cam))
    assert rms_error(model.matrix, true) < 0.1 * rms_error(raw.matrix, true)
    assert model.record["fit"]["accepted"] == len(cam.sub_imagers)
    image = load(described).ravel()

    def ratio(seed: int) -> float:
        """The squared error over the stated one, of a calibration with another seed."""
        render = described.render.model_copy(update={"seed": seed})
        other = calibrate(Setup(described.model_copy(update={"render": render}), cam))
        error, stated = other.forward(image) - true @ image, other.errors(image)
        assert stated is not None
        return float(np.square(error).sum() / stated.variance.sum())

    assert 0.1 < np.mean([ratio(seed) for seed in range(seeds)]) < 5  # two directions have most of the error
    model_file.write(tmp_path / "model.npz", model)
    assert (tmp_path / "model.npz").stat().st_size < 20_000
    again = model_file.read(tmp_path / "model.npz")
    assert abs(again.matrix - model.matrix).max() == 0
    read, written = again.errors(image), model.errors(image)
    assert read is not None
    assert written is not None
    np.testing.assert_array_equal(read.variance, written.variance)
    assert again.record == model.record


def test_distortion_is_the_types() -> None:
    """A lens whose k1 differs from its design by five thousandths: one number for all of its sub-imagers."""
    wide = {"lens_pitch": "3 mm"}
    _, built = with_optics({"distortion": [0.2, 0.0]}, wide, (("1/3", [3, 3], [4, 4]),))
    _, designed = with_optics({"distortion": [0.205, 0.0]}, wide, (("1/3", [3, 3], [4, 4]),))
    fit = drawn(designed, ideal_matrix(built), 16384, 1)
    views = fit.matrix.views["A"]
    assert views.structure[K1] == "shared"
    error = np.square(views.shared[0, K1]).sum() ** 0.5
    assert abs(views.numbers[0, K1] - 0.2) < 4 * error < 5e-3
    assert np.ptp(views.numbers[:, K1]) == 0


def test_null_spaces_are_not_filled() -> None:
    """Two lens types leave a null space, which the noise of entries would fill: expected error by H as calibrated."""
    from ommatid.analysis.predict import predict_scene

    needs("llvm_ad_mono")
    calibration = {"samples": 256, "method": "transport", "fit": "auto"}
    described, cam = with_optics({}, {}, THREE[:2], calibration=calibration, noise={"variance": 1e-4})
    model = calibrate(Setup(described, cam))
    ideal = described.model_copy(
        update={"calibration": described.calibration.model_copy(update={"method": "ideal", "fit": None})}
    )
    rank = np.linalg.matrix_rank(model.matrix.toarray())
    assert rank == np.linalg.matrix_rank(ideal_matrix(cam).toarray()) < cam.unknowns
    assert predict_scene(ideal).mse == pytest.approx(predict_scene(described).mse, rel=0.02)
