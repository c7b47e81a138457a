"""Kernels of blurred lens types, learnt from entries that are drawn from a known H."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse, stats

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernel_shapes import KernelShapes
from ommatid.scenes.fitted.kernels import KernelFootprints, KernelPlaces
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.simulate.calibration.fit.kernel_fit import KernelFit, fit_kernels, refusal
from ommatid.simulate.calibration.responses import Responses
from ommatid.simulate.ideal import ideal_matrix

from ..examples import with_optics
from .test_fit import multinomial

PASSES, RAYS = 16, 256
ONE = (("1/3", [3, 3], [5, 5]),)


def drawn(matrix: sparse.csr_array, rng: np.random.Generator, rays: int = RAYS) -> Responses:
    """Entries from independent rays."""
    return multinomial(matrix, rng, PASSES, rays)


def defocused(lenses: tuple[tuple[object, object, object], ...] = ONE) -> Camera:
    """A camera of thin lenses that are out of focus, of rays."""
    optics = {"aperture": "0.4 mm", "focus": "900 mm"}
    return with_optics(optics, {"wavelength": "none"}, lenses)[1]  # pyright: ignore[reportArgumentType]


def accepted(fit: KernelFit) -> KernelFootprints:
    """The footprints of an accepted fit."""
    assert fit.accepted, fit.reason
    assert fit.footprints is not None
    return fit.footprints


def varying(camera: Camera) -> KernelFootprints:
    """Kernels that are wider, and asymmetric, off the axis of a lens with rotational symmetry."""
    places = KernelPlaces(camera, camera.types[0], 2)
    offset = np.arange(places.width) - (places.width - 1) / 2
    y, x = np.meshgrid(offset, offset, indexing="ij")
    bell = np.exp(-(x**2 + y**2) / 6)
    bell /= bell.sum()
    coma, wide = (x**2 + y**2 - 12) * bell, (x**2 + y**2 - 6) * bell
    wide -= bell * wide.sum()
    kernels = np.array([bell, y * coma, x * coma, wide])
    coefficients = np.zeros((4, 6))  # of 1, u, v, P2(u), u v, P2(v)
    coefficients[0, 0] = 1
    coefficients[1, 1] = coefficients[2, 2] = 0.03
    coefficients[3, [3, 5]] = 0.03
    return KernelFootprints(places, 2, KernelShapes.dense(kernels), coefficients, np.zeros((0, 0, 6)))


def rms(difference: sparse.csr_array, entries: int) -> float:
    """The root mean square over the entries of H."""
    return float(np.sqrt(np.square(difference.data).sum() / entries))


def test_h_of_a_defocused_lens_is_ten_times_better_known_than_its_entries() -> None:
    camera = defocused()
    truth, rng = ideal_matrix(camera), np.random.default_rng(0)
    responses = drawn(truth, rng)
    fit = fit_kernels(responses, camera, camera.types[0])
    learnt = accepted(fit).to_sparse()
    assert rms(learnt - truth, truth.nnz) < 0.1 * rms(responses.matrix - truth, truth.nnz)


@pytest.mark.slow
def test_errors_of_h_f_are_as_large_as_expected() -> None:
    """Of lenses that are focused elsewhere than the design says, so that all of their kernels are learnt."""
    camera, rng = defocused(), np.random.default_rng(1)
    other = with_optics({"aperture": "0.4 mm", "focus": "700 mm"}, {"wavelength": "none"}, ONE)[1]
    truth, image = ideal_matrix(other), np.random.default_rng(2).normal(127, 74, camera.unknowns)
    ratios: list[float] = []
    for _ in range(16):
        footprints = accepted(fit_kernels(drawn(truth, rng), camera, camera.types[0]))
        assert len(footprints.shapes.core)
        error = (footprints.to_sparse() - truth) @ image
        expected = np.square(footprints.error_directions(image)).sum(axis=1)
        ratios.append(float(np.square(error).mean() / expected.mean()))
    assert np.mean(ratios) == pytest.approx(1, abs=3 * float(np.std(ratios, ddof=1)) / len(ratios) ** 0.5)


def diffracting(shape: tuple[int, int]) -> Camera:
    """A camera of lenses whose light reaches 117 pixels of f."""
    optics = {"aperture": "0.4 mm"}, {"wavelength": "550 nm", "lens_pitch": "1 mm"}
    return with_optics(*optics, (("1/3", [3, 3], [6, 6]),), shape)[1]


@pytest.mark.parametrize("calibrations", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_wide_kernels_are_the_ideal_within_their_errors(calibrations: int) -> None:
    """As long as rays show no deviation from the design, in all readings of a picture."""
    camera, rng = diffracting((21, 21)), np.random.default_rng(8)
    truth, image = ideal_matrix(camera), np.random.default_rng(9).uniform(0, 255, camera.unknowns)
    scores: list[float] = []
    for _ in range(calibrations):
        responses = drawn(truth, rng)
        footprints = accepted(fit_kernels(responses, camera, camera.types[0]))
        assert footprints.places.width == 117
        error = (footprints.to_sparse() - truth) @ image
        deviation = np.sqrt(np.square(footprints.error_directions(image)).sum(axis=1))
        scores.append(float(np.abs(error / deviation).max()))
        assert np.square(error).mean() < 0.01 * np.square((responses.matrix - truth) @ image).mean()
    assert max(scores) < stats.norm.isf(0.5e-3 / len(scores) / camera.measurements)


def test_wide_kernels_are_learnt_where_they_deviate() -> None:
    """From lenses of a wavelength that the design does not know: in the core, and in the light around it."""
    camera = diffracting((21, 21))
    truth = ideal_matrix(replace(camera, wavelength=700e-6))
    fit = fit_kernels(drawn(truth, np.random.default_rng(10), 4096), camera, camera.types[0])
    assert not fit.record()["as_designed"]
    learnt, designed = accepted(fit).to_sparse(), ideal_matrix(camera)
    image = np.random.default_rng(11).uniform(0, 255, camera.unknowns)
    assert rms((learnt - truth), truth.nnz) < 0.1 * rms(designed - truth, truth.nnz)
    assert np.abs((learnt - truth) @ image).max() < 0.1 * np.abs((designed - truth) @ image).max()


def test_a_deviation_that_varies_over_the_field_is_rejected() -> None:
    camera = defocused((("1/3", [1, 1], [6, 6]),))
    fit = fit_kernels(drawn(varying(camera).to_sparse(), np.random.default_rng(3), 4096), camera, camera.types[0])
    assert not fit.accepted
    assert "field" in fit.reason
    assert json.loads(json.dumps(fit.record()))["unexplained"] > 0


def test_some_pixels_are_enough() -> None:
    camera = defocused((("1/3", [3, 3], [5, 5]), ("1/4", [4, 4], [4, 4])))
    truth, rng = ideal_matrix(camera), np.random.default_rng(4)
    lens_type, rows = camera.types[1], camera.type_slices()[1]
    chart = np.flatnonzero(rng.random(lens_type.measurements) < 0.4)
    kept = np.zeros((truth.shape[0], 1))
    kept[rows.start + chart] = 1
    fit = fit_kernels(drawn(sparse.csr_array(truth * kept), rng), camera, lens_type, chart)
    assert fit.record()["pixels"] == chart.size
    learnt = accepted(fit).to_sparse()
    assert rms(learnt - truth[rows], truth[rows].nnz) < 0.5 / (RAYS * PASSES) ** 0.5 / 4


def test_correct_explanations_are_rarely_rejected() -> None:
    camera, rng = defocused(), np.random.default_rng(5)
    truth = ideal_matrix(camera)
    fits = [fit_kernels(drawn(truth, rng, 64), camera, camera.types[0]) for _ in range(12)]
    rejected = sum(not fit.accepted or bool(fit.reason) for fit in fits)
    assert stats.binom.sf(rejected - 1, len(fits), 0.001) > 1e-3


def test_sub_imagers_with_a_blur_of_their_own_are_rejected() -> None:
    camera = defocused()
    truth, other = ideal_matrix(camera), ideal_matrix(replace(camera, distance=0.97 * camera.distance))
    sub = camera.slices()[4]
    mixed = sparse.csr_array(sparse.vstack([truth[: sub.start], other[sub], truth[sub.stop :]]))
    fit = fit_kernels(drawn(mixed, np.random.default_rng(6), 4096), camera, camera.types[0])
    assert not fit.accepted
    assert "sub-imagers" in fit.reason


def test_misaligned_cameras_and_dark_pixels_keep_their_entries() -> None:
    camera = defocused()
    tolerance = ToleranceTable.model_validate({"rotation": "1 mrad"})
    assert "misaligned" in refusal(replace(camera, tolerance=tolerance), camera.types[0])
    assert "walls" in refusal(replace(camera, walls=False), camera.types[0])
    truth = ideal_matrix(camera)
    lit: FloatArray = np.ones((truth.shape[0], 1))
    lit[7] = 0
    responses = drawn(sparse.csr_array(truth * lit), np.random.default_rng(7))
    fit = fit_kernels(responses, camera, camera.types[0], np.arange(truth.shape[0]))
    assert not fit.accepted
    assert "dark" in fit.reason
