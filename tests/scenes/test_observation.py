"""The action of H on another grid of the target: boxes, kernels and entries alike."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.scenes.model import designed_observation
from ommatid.scenes.observation import Entries, Observation
from ommatid.scenes.setup import Setup
from tests.examples import with_optics

LENSES = (("1/3", [3, 3], [2, 3]), ("2/7", [2, 2], [2, 3]))


@pytest.mark.parametrize("optics", [{}, {"aperture": "0.8 mm"}])
@pytest.mark.parametrize("stored", [False, True])
def test_an_image_of_larger_pixels_reads_as_the_world_that_repeats_them(optics: dict[str, str], stored: bool) -> None:
    lenses = LENSES[:1] if optics else LENSES
    described, _ = with_optics(optics, {"lens_pitch": "1 mm"}, lenses, (11, 12), calibration={"method": "ideal"})
    described = described.model_copy(update={"target": described.target.model_copy(update={"detail": 2})})
    camera = Setup.from_scene(described).camera
    fine = designed_observation(camera.world)
    assert fine is not None
    if stored:
        fine = Observation(fine.shape, (Entries(fine.to_sparse(), fine.shape),))
    coarse, rng = fine.coarser(camera, 2), np.random.default_rng(0)
    image, readings = rng.normal(size=camera.shape), rng.normal(size=camera.measurements)
    world = np.kron(image, np.ones((2, 2))).astype(np.float64)
    np.testing.assert_allclose(coarse.forward(image), fine.forward(world), atol=1e-12)
    back = fine.adjoint(readings).reshape(11, 2, 12, 2).sum(axis=(1, 3)).ravel()
    np.testing.assert_allclose(coarse.adjoint(readings), back, atol=1e-12)
    window = slice(2, 9), slice(1, 10)
    np.testing.assert_array_equal(
        coarse.measurements_inside(*window), fine.measurements_inside(slice(4, 18), slice(2, 20))
    )


@pytest.mark.parametrize("optics", [{}, {"aperture": "0.8 mm"}])
@pytest.mark.parametrize("stored", [False, True])
def test_a_window_holds_what_is_seen_of_it_by_measurements_that_see_more(optics: dict[str, str], stored: bool) -> None:
    described, _ = with_optics(optics, {"lens_pitch": "1 mm"}, LENSES[:1], (11, 12))
    camera = Setup.from_scene(described).camera
    seen = designed_observation(camera)
    assert seen is not None
    if stored:
        seen = Observation(seen.shape, (Entries(seen.to_sparse(), seen.shape),))
    rows, columns, numbers = slice(3, 8), slice(2, 9), np.array([0, 7, 30])
    whole = seen.to_sparse()[numbers].toarray().reshape(-1, 11, 12)
    cut = seen.rows_on(numbers, rows, columns).toarray().reshape(-1, 5, 7)
    np.testing.assert_allclose(cut, whole[:, rows, columns], atol=1e-15)
    everything = np.sort(seen.measurements_inside(slice(0, 11), slice(0, 12)))
    np.testing.assert_array_equal(everything, np.arange(camera.measurements))
