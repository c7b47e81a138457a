"""Fitted geometry of sub-imagers, against closed forms, multinomial draws from them, and traced rays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse, stats

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.prior import independent
from ommatid.reconstruct.problem import Problem
from ommatid.scenes import model_file
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.picture import load
from ommatid.scenes.model import Model
from ommatid.scenes.optics import blur
from ommatid.scenes.optics.footprints import sub_matrix
from ommatid.scenes.pose import Misalignment, misalignments, pose_of
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.entries import entry_variances
from ommatid.simulate.calibration.geometry_fit import GeometryFit, fit_all, fit_geometry
from ommatid.simulate.calibration.geometry_model import (
    BLUR,
    K1,
    MAGNIFICATION,
    ROTATION,
    designed,
    entries,
    misaligned,
    misalignment,
)
from ommatid.simulate.calibration.point_sources import Responses
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.ideal import ideal_matrix, true_matrix
from ommatid.simulate.sampling.passes import BATCHES, FEWEST_PASSES

from ..examples import OPTICS, THREE, camera, needs, with_optics

FEW = (("1/3", [2, 2], [5, 5]), ("1/4", [2, 1], [4, 4]))
WRONG = {"tolerance": {"position": "1 um", "rotation": "1 deg", "focal_length": 0.01}}
RAYS = 1024
NUMBERS = 5  # of a pinhole
FARTHEST = 4  # standard deviations; of 30 normal numbers one is beyond in 500 tests


def drawn(matrix: sparse.csr_array, rays: int, seed: int) -> Responses:
    """Return the responses of independent rays to an H: every row of every pass is a multinomial draw."""
    rng = np.random.default_rng(seed)
    dense = matrix.toarray()
    shares = np.column_stack([dense, np.maximum(1 - dense.sum(axis=1), 0)])
    each = rays // FEWEST_PASSES
    shares /= shares.sum(axis=1, keepdims=True)
    passes = rng.multinomial(each, shares, size=(FEWEST_PASSES, len(shares)))[:, :, :-1] / each
    mean = passes.mean(axis=0)
    found = sparse.csr_array(mean)
    at = np.repeat(np.arange(mean.shape[0]), np.diff(found.indptr)), found.indices
    batches = passes.reshape(FEWEST_PASSES // BATCHES, BATCHES, *mean.shape).mean(axis=0)
    return Responses(
        passes=FEWEST_PASSES,
        samples=each,
        variant="drawn",
        first_seed=seed,
        matrix=found,
        variance=passes[:, at[0], at[1]].var(axis=0, ddof=1) / FEWEST_PASSES,
        batches=(batches[:, at[0], at[1]] - found.data).astype(np.float32),
    )


def scores(fits: list[GeometryFit], expected: list[np.ndarray]) -> np.ndarray:
    """Return the deviations of the fitted parameters from those expected, in standard deviations."""
    pairs = zip(fits, expected, strict=True)
    return np.array([((fit.numbers - one)[fit.free] / fit.deviation[fit.free]) for fit, one in pairs])


def mahalanobis(fit: GeometryFit, expected: np.ndarray) -> float:
    """Return the squared distance of the fitted parameters from those expected, by the fit's covariance."""
    error = (fit.numbers - expected)[fit.free]
    return float(error @ np.linalg.solve(fit.covariance, error))


def put_together(camera: Camera) -> list[np.ndarray]:
    return [
        misaligned(camera, sub, wrong) for sub, wrong in zip(camera.sub_imagers, misalignments(camera), strict=True)
    ]


lengths = st.floats(-0.005, 0.005)


@settings(max_examples=10, deadline=None)
@given(lengths, lengths, st.floats(-0.1, 0.1), st.floats(-0.05, 0.05))
def test_the_model_of_a_misaligned_pinhole_is_its_exact_h(x: float, y: float, turn: float, longer: float) -> None:
    wrong, pinholes = (
        Misalignment((x, y), rotation=turn, focal_length=longer),
        camera((9, 9), (("1/3", [2, 1], [2, 2]),)),
    )
    for sub in pinholes.sub_imagers:
        numbers = misaligned(pinholes, sub, wrong)
        again = misalignment(pinholes, sub, numbers)
        np.testing.assert_allclose([*again.position, again.focal_length], [x, y, longer], atol=1e-12)
        assert abs(entries(pinholes, sub, numbers) - sub_matrix(pinholes, sub, pose_of(sub, wrong))).max() < 1e-10


@pytest.mark.parametrize("diameter", [0.1, 0.5, 1.0, 2.0])
def test_the_model_of_a_disk_is_the_closed_form_to_less_than_noise(diameter: float) -> None:
    """4096 independent rays leave an error of 0.3 / m 64 in an entry of 1 / m^2."""
    pinholes = camera((19, 19), (("1/3", [1, 1], [5, 5]),))
    sub = pinholes.sub_imagers[0]
    numbers = designed(pinholes, sub)
    numbers[BLUR] = diameter
    exact = blur.matrix(pinholes, sub.type, (blur.Blur(disk=diameter), 1.0))
    difference = abs(entries(pinholes, sub, numbers) - exact).max()
    assert difference < 0.1 * (1 / 9 * 8 / 9 / 4096) ** 0.5


def test_the_remaining_error_is_that_of_five_parameters() -> None:
    """Weighted, each fitted number leaves the error of one entry: of an efficient fit this sum is chi-squared.

    And the variance that H states is that of its error. Of six cameras the test refuses one sub-imager at times.
    """
    _, pinholes = with_optics({}, WRONG, FEW)
    true = true_matrix(pinholes)
    weighted, real, stated, raw, count = 0.0, 0.0, 0.0, 0.0, 0
    for seed in range(6):
        responses = drawn(true, RAYS, seed)
        found, variance, record = fit_geometry(responses, responses.variance, pinholes)
        spread = sparse.csr_array((variance, found.matrix.indices, found.matrix.indptr), shape=true.shape)
        for sub, place in zip(pinholes.sub_imagers, pinholes.slices(), strict=True):
            if sub.name in record["refused"]:
                continue
            exact = true[place].toarray()
            error = np.square(found.matrix[place].toarray() - exact)
            weighted += float((RAYS * error / (exact + 0.5 / RAYS)).sum())
            real, stated = real + float(error.sum()), stated + float(spread[place].sum())
            raw += float(np.square(responses.matrix[place].toarray() - exact).sum())
            count += NUMBERS
        if not record["refused"]:
            scatter = np.square(found.batches.astype(float)).sum() / (BATCHES * (BATCHES - 1))
            draws = (BATCHES - 1) * NUMBERS * len(pinholes.sub_imagers)  # of both sums, at least
            assert scatter == pytest.approx(variance.sum(), rel=4 * (2 / draws) ** 0.5)
    assert count >= NUMBERS * (6 * len(pinholes.sub_imagers) - 2)
    assert weighted == pytest.approx(count, abs=4 * (2 * count) ** 0.5)
    assert real == pytest.approx(stated, rel=4 * (2 / count) ** 0.5)
    assert raw > 25 * real


def test_the_p_value_of_a_correct_model_is_uniform() -> None:
    _, pinholes = with_optics({}, WRONG, FEW)
    true = true_matrix(pinholes)
    chances = [fit.chance for seed in range(8) for fit in fit_all(drawn(true, RAYS, 100 + seed), pinholes)]
    assert stats.kstest(chances, "uniform").pvalue > 0.001


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
def test_pinholes_as_designed(sampler: str) -> None:
    needs("llvm_ad_mono")
    described, pinholes = with_optics({}, {}, FEW, calibration={"samples": 256}, render={"sampler": sampler})
    responses = responses_from_rays(Setup(described, pinholes))
    found, variance, record = fit_geometry(responses, entry_variances(responses, pinholes), pinholes)
    assert (record["accepted"], record["refused"]) == (len(pinholes.sub_imagers), [])
    assert np.abs(scores(fit_all(responses, pinholes), put_together(pinholes))).max() < FARTHEST
    exact = ideal_matrix(pinholes)
    error, raw = (float(np.square((each - exact).toarray()).sum()) for each in (found.matrix, responses.matrix))
    assert error < raw / 25  # five numbers for the noise of 200 entries and more
    assert error < 4 * variance.sum()
    assert variance.shape == found.matrix.data.shape == found.batches.shape[1:]


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
def test_a_misaligned_camera_is_recovered(sampler: str) -> None:
    """With a scene that has no tolerance."""
    needs("llvm_ad_mono")
    described, wrong = with_optics({}, WRONG, FEW, calibration={"samples": 1024}, render={"sampler": sampler})
    fits = fit_all(responses_from_rays(Setup(described, wrong)), replace(wrong, tolerance=None))
    expected = put_together(wrong)
    assert all(fit.accepted for fit in fits)
    assert np.abs(scores(fits, expected)).max() < FARTHEST
    # The covariances are estimated, which lengthens the upper tail of chi-squared (Hotelling).
    total = sum(mahalanobis(fit, numbers) for fit, numbers in zip(fits, expected, strict=True))
    assert 0.01 < stats.chi2.cdf(total, 30) < 0.99
    some = [MAGNIFICATION, ROTATION]
    error = np.array([fit.numbers - one for fit, one in zip(fits, expected, strict=True)])[:, some].std(axis=0)
    assert (error < np.array(expected)[:, some].std(axis=0) / 2).all()


def test_distortion_is_recovered() -> None:
    needs("llvm_ad_mono")
    described, bent = with_optics({"distortion": [0.05, 0.0]}, {}, FEW, calibration={"samples": 1024})
    _, straight = with_optics({}, {}, FEW)
    fits = fit_all(responses_from_rays(Setup(described, bent)), straight)
    expected = np.zeros(6)
    expected[K1] = 0.05
    assert all(fit.accepted for fit in fits)
    assert all(fit.deviation[K1] < 0.01 for fit in fits)
    assert np.abs(scores(fits, [expected] * len(fits))).max() < FARTHEST


def test_defocus_is_recovered() -> None:
    """A disk of 0.17 pixels of f in a camera whose scene says 0.04."""
    needs("llvm_ad_mono")
    few, complete = (("1/3", [1, 2], [5, 5]),), {"complete": True}
    rays = {"wavelength": "none"}
    described, blurred = with_optics(
        {"aperture": "0.4 mm", "focus": "700 mm"}, rays, few, calibration={"samples": 2048}, render=complete
    )
    _, sharper = with_optics({"aperture": "0.4 mm", "focus": "900 mm"}, rays, few)
    fits = fit_all(responses_from_rays(Setup(described, blurred)), sharper)
    expected = [designed(blurred, sub) for sub in blurred.sub_imagers]
    assert expected[0][BLUR] == pytest.approx(0.4 * 3 / 7)
    assert all(fit.accepted and fit.free[BLUR] and fit.deviation[BLUR] < 0.02 for fit in fits)
    assert np.abs(scores(fits, expected)).max() < FARTHEST


def test_a_ghost_image_is_rejected_and_keeps_its_measured_entries() -> None:
    """5 % of the light of one sub-imager, displaced by 4 texels."""
    pinholes = camera((19, 19), FEW)
    haunted, exact = pinholes.slices()[1], ideal_matrix(pinholes).toarray()
    exact[haunted] = 0.95 * exact[haunted] + 0.05 * np.roll(exact[haunted], 4, axis=1)
    responses = drawn(sparse.csr_array(exact), RAYS, 3)
    found, _, record = fit_geometry(responses, responses.variance, pinholes)
    assert record["refused"] == [pinholes.sub_imagers[1].name]
    assert record["accepted"] == len(pinholes.sub_imagers) - 1
    assert abs(found.matrix[haunted] - responses.matrix[haunted]).max() == 0
    others = np.delete(np.arange(len(exact)), np.arange(haunted.start, haunted.stop))
    assert abs(found.matrix[others] - responses.matrix[others]).max() > 0


def test_diffraction_is_rejected() -> None:
    _, camera = with_optics(*OPTICS["diffraction"], FEW)
    responses = drawn(ideal_matrix(camera), 64, 0)
    found, _, record = fit_geometry(responses, responses.variance, camera)
    assert record["refused"] == [sub.name for sub in camera.sub_imagers]
    assert (record["parameters"], record["chi_squared"]) == ({}, None)
    assert abs(found.matrix - responses.matrix).max() == 0


def test_few_rays_and_a_fit_reconstruct_as_well_as_an_exact_h() -> None:
    """The paper's tile: light comes from the true H, and the estimator has one calibrated with 256 rays per pixel."""
    described, camera = with_optics({}, {}, THREE)
    true, image = ideal_matrix(camera), load(described).ravel()
    noise = 1e-2
    recorded = true @ image + np.random.default_rng(1).normal(0, noise**0.5, camera.measurements)
    responses = drawn(true, 256, 2)
    fit, _, record = fit_geometry(responses, responses.variance, camera)
    assert record["accepted"] >= len(camera.sub_imagers) - 1
    prior = independent(127.5, 5461.25, camera.unknowns)

    def error(matrix: sparse.csr_array, found: Responses | None) -> float:
        uncertain = np.zeros(camera.measurements)
        if found is not None:
            uncertain = Model(
                described, camera, matrix, found.variance, found.batches, {"method": "transport"}
            ).variance_from_model(image)
        problem = Problem(matrix, prior, noise + uncertain)
        return float(np.square(estimate(problem, recorded).image - image).mean())

    exact, raw, modelled = error(true, None), error(responses.matrix, responses), error(fit.matrix, fit)
    assert modelled - exact < (raw - exact) / 10


def test_the_scene_file_asks_for_it(tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    few: Any = (("1/3", [1, 2], [2, 2]),)
    calibration = {"samples": 64, "method": "transport", "fit": "geometry"}
    described, camera = with_optics({}, WRONG, few, (9, 9), calibration=calibration)
    found = calibrate(Setup(described, camera))
    told = found.record["fit"]
    assert (told["kind"], told["accepted"]) == ("geometry", 2)
    assert set(told["parameters"]["A"]) == set(told["units"])
    json.dumps(told, allow_nan=False)
    model_file.write(tmp_path / "model.npz", found)
    again = model_file.read(tmp_path / "model.npz")
    assert abs(again.matrix - found.matrix).max() == 0
    assert found.matrix.has_canonical_format
