"""Moments of H of misaligned cameras, against random cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.misalignment.moments import (
    as_misalignments,
    misaligned_matrix,
    misaligned_moments,
    points_of,
    tolerances,
)
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.pose import misalignments
from ommatid.scenes.tables.camera import Surface

from ..examples import POSITION, TOLERANCES, as_table, drawn_from, misaligned_camera

SIGNIFICANCE = 0.01
SIDE = 12


def priors(side: int = SIDE) -> dict[str, Prior]:
    return {
        "independent": independent(127.5, 5461.25, side * side),
        "exponential": exponential(127.5, 5461.25, (side, side), 20.0),
    }


def drawn_matrix(camera: Camera, rng: np.random.Generator) -> Any:
    spread = tolerances(camera)
    return misaligned_matrix(camera, spread * rng.standard_normal(spread.shape))


def test_points_have_the_moments_of_independent_normal_parameters() -> None:
    weights, points = points_of(np.ones(6, dtype=np.bool_))
    assert weights.sum() == pytest.approx(1, rel=1e-14)
    assert weights @ points == pytest.approx(np.zeros(6), abs=1e-14)
    assert points.T @ (weights[:, None] * points) == pytest.approx(np.eye(6), abs=1e-13)
    assert weights @ np.abs(points) ** 3 == pytest.approx(np.full(6, stats.halfnorm.moment(3)), rel=1e-13)
    absolute = np.full((6, 6), stats.halfnorm.mean() ** 2)
    np.fill_diagonal(absolute, 1)
    assert np.abs(points).T @ (weights[:, None] * np.abs(points)) == pytest.approx(absolute, rel=1e-13)


def test_a_parameter_has_the_same_distribution_whatever_others_there_are() -> None:
    """So that vanishing tolerances beside others change nothing."""
    weights, points = points_of(np.ones(6, dtype=np.bool_))
    for free in (np.arange(6) == 4, np.arange(6) < 2):
        fewer, of_fewer = points_of(free)
        assert len(fewer) <= 36, "equal points are joined"
        assert not of_fewer[:, ~free].any()
        for weight, point in zip(fewer, of_fewer, strict=True):
            assert weights[(points[:, free] == point[free]).all(axis=1)].sum() == pytest.approx(weight, rel=1e-14)


def test_tables_hold_the_drawn_misalignments() -> None:
    scores: list[FloatArray] = []
    for seed in range(20):
        camera = misaligned_camera(tolerance=TOLERANCES | {"seed": seed})
        drawn = misalignments(camera)
        assert as_misalignments(as_table(drawn)) == drawn
        scores.append(as_table(drawn) / tolerances(camera))
    assert stats.kstest(np.ravel(scores), "norm").pvalue > SIGNIFICANCE


@pytest.mark.parametrize(
    ("name", "tolerance", "draws"),
    [
        pytest.param("independent", POSITION, 50, id="0.03 pixels, few"),
        pytest.param("independent", POSITION, 300, id="0.03 pixels", marks=pytest.mark.slow),
        pytest.param("exponential", {"position": "600 nm"}, 300, id="0.4 pixels", marks=pytest.mark.slow),
        pytest.param("exponential", TOLERANCES, 300, id="all", marks=pytest.mark.slow),
    ],
)
def test_moments_agree_with_random_cameras_and_images(name: str, tolerance: dict[str, Any], draws: int) -> None:
    camera, rng, prior = misaligned_camera(tolerance=tolerance), np.random.default_rng(1), priors()[name]
    misaligned = misaligned_moments(camera, prior)
    residuals = np.empty((draws, camera.measurements))
    for draw in range(draws):
        residuals[draw] = (drawn_matrix(camera, rng) - misaligned.matrix) @ drawn_from(prior, rng)
    for rows, covariance in zip(camera.slices(), misaligned.covariances, strict=True):
        of_sub = residuals[:, rows]
        # Along the eigenvectors, so that independent numbers of expected square 1 are compared.
        values, vectors = np.linalg.eigh(covariance)
        strong = values > 1e-3 * values[-1]
        squares = np.square(of_sub @ vectors[:, strong]) / values[strong]
        assert abs(squares.mean() - 1) < 5 * squares.mean(axis=1).std() / draws**0.5 + 0.05
    z = residuals.mean(axis=0) / (residuals.std(axis=0) / draws**0.5)
    assert np.abs(z).max() < 5


def test_without_tolerance_nothing_is_added() -> None:
    camera = replace(misaligned_camera(), tolerance=None)
    misaligned = misaligned_moments(camera, priors()["independent"])
    assert not any(block.any() for block in misaligned.covariances)


def test_blurred_lenses_are_refused() -> None:
    camera = misaligned_camera()
    real = Surface.model_validate({"radius": "1 mm", "semi_diameter": "0.1 mm"})
    for optics in (LensOptics(surfaces=(real,)), LensOptics(aperture=0.1, focus=500.0)):
        lens_type = replace(camera.types[0], optics=optics)
        with pytest.raises(InputError, match=r"camera\.lens\.A: .* take estimator\.misalignment = 'trust'"):
            tolerances(replace(camera, types=(lens_type, *camera.types[1:])))
