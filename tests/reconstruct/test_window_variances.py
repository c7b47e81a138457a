"""Variances of frames with uneven noise: stencils of K, windows beside whole frames, and the check by solutions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import linalg, sparse

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.frame.error_map import SPACING, ExactVariances, check_map, spread_pixels
from ommatid.reconstruct.frame.preconditioner import preconditioner_for
from ommatid.reconstruct.frame.variance_map import interior_variance
from ommatid.reconstruct.frame.window_variances import (
    EvenNoise,
    Source,
    box_stencil,
    even_couplings,
    frame_variances,
    pixel_numbers,
    stencil_variances,
    stored_stencil,
)
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.model import Model
from ommatid.scenes.optics.boxes import BoxFootprints
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..frames import FITTED, P0, blurred, frame_camera, precision, recorded, wide

SMALL = (47, 41)
WIDE = (79, 73)


def uneven(camera: Camera, decades: float, by_type: tuple[float, ...] = (1.0, 1.0, 1.0)) -> FloatArray:
    """Noise variances from 1e-2 on, over some decades, of types that differ by a factor."""
    factors = np.repeat(by_type, [lens_type.measurements for lens_type in camera.types])
    return 1e-2 * factors * 10 ** np.random.default_rng(0).uniform(0, decades, camera.measurements)


def sources(camera: Camera, weights: FloatArray) -> tuple[Source, Source]:
    """K of windows, from boxes and from the stored H."""
    matrix = sparse.csc_array(ideal_matrix(camera))

    def stored(rows: slice, columns: slice) -> object:
        return stored_stencil(matrix, weights, 1 / P0, pixel_numbers(camera.shape, rows, columns), 4)

    return partial(box_stencil, camera, weights, 1 / P0), stored  # type: ignore[return-value]


@pytest.mark.slow
@pytest.mark.parametrize("window", [(slice(0, 33), slice(0, 30)), (slice(5, 28), slice(9, 30))], ids=["all", "part"])
def test_a_window_is_that_part_of_the_dense_precision(window: tuple[slice, slice]) -> None:
    """Pixels beyond it count as known: the inverse of the block of K; the transposed stencil has the same inverse."""
    camera = frame_camera((33, 30))
    weights = 1 / uneven(camera, 3)
    dense = precision(ideal_matrix(camera), weights, 1 / P0)
    inside = pixel_numbers((33, 30), *window)
    exact = np.diagonal(linalg.inv(dense[np.ix_(inside.ravel(), inside.ravel())])).reshape(inside.shape)
    for source in sources(camera, weights):
        stencil = source(*window)
        np.testing.assert_allclose(stencil_variances(stencil), exact, rtol=1e-9)
        np.testing.assert_allclose(stencil_variances(stencil.transposed()).T, exact, rtol=1e-9)


@pytest.mark.parametrize(
    ("decades", "by_type", "pixel", "mean"),
    [
        pytest.param(0.0, (1, 1, 1), 3e-3, 5e-4, marks=pytest.mark.slow),
        pytest.param(1.0, (1, 1, 1), 5e-3, 1e-3, marks=pytest.mark.slow),
        pytest.param(3.0, (1, 1, 1), 2e-2, 2e-3, marks=pytest.mark.slow),
        (1.0, (1, 4, 2), 2e-2, 2e-3),
    ],
)
def test_windows_are_the_whole_frame_to_the_stated_accuracy(
    decades: float, by_type: tuple[float, ...], pixel: float, mean: float
) -> None:
    """Short halos, against one sweep over the frame without any: 2 % a pixel and 0.2 % in the mean."""
    camera = frame_camera(WIDE)
    weights = 1 / uneven(camera, decades, by_type)
    source = sources(camera, weights)[0]
    exact = stencil_variances(source(slice(0, WIDE[0]), slice(0, WIDE[1])))
    means = tuple(float(weights[part].mean()) for part in camera.type_slices())
    even = EvenNoise(
        even_couplings([3, 5, 4], means, 1 / P0, 4), interior_variance(preconditioner_for(camera, means, 1 / P0))
    )
    variance = frame_variances(source, WIDE, 15, even)
    np.testing.assert_allclose(variance, exact, rtol=pixel)
    assert variance.mean() == pytest.approx(exact.mean(), rel=mean)


@pytest.mark.parametrize("as_expected", [pytest.param(True, marks=pytest.mark.slow), False])
def test_one_solution_measures_the_variances_of_distant_pixels(as_expected: bool) -> None:
    """Against the dense Eq. 5 where one pixel fits into the frame, and a map that is 5 % off is found."""
    camera = frame_camera(SMALL)
    expected = uneven(camera, 1)
    actual = expected if as_expected else expected[::-1].copy()
    weights = 1 / expected
    matrix = ideal_matrix(camera)
    covariance = linalg.inv(precision(matrix, weights, 1 / P0))
    gain = covariance @ (matrix.T.toarray() * weights)
    error = np.square(covariance).sum(axis=1) / P0 + np.square(gain) @ actual
    system = FrameSystem(camera, BoxFootprints(camera), weights, 1 / P0)
    exact = ExactVariances(system, None if as_expected else weights**2 * actual, 0.01)
    posterior = np.ascontiguousarray(np.diagonal(covariance))
    assert check_map(error, posterior, SMALL, exact, local=True).worst < 2e-3
    wrong = check_map(1.05 * error, posterior, SMALL, exact, local=True)
    assert wrong.worst == pytest.approx(0.05, abs=3e-3)
    assert wrong.mean == pytest.approx(0.05, abs=3e-3)


def test_pixels_of_a_set_lie_far_apart_and_some_near_edges() -> None:
    pixels = spread_pixels((600, 500), np.random.default_rng(0), edges=True)
    row, column = np.divmod(pixels, 500)
    apart = np.maximum(np.abs(np.subtract.outer(row, row)), np.abs(np.subtract.outer(column, column)))
    assert apart[~np.eye(pixels.size, dtype=bool)].min() >= SPACING
    assert pixels.size > 10
    assert min(row.min(), 599 - row.max(), column.min(), 499 - column.max()) < 4


def _restored(
    stack: Stack, model: Model, truth: FloatArray | None, monkeypatch: pytest.MonkeyPatch, halo: int
) -> Reconstruction:
    """The estimate of a frame that counts as large, with windows whose halo is so many boxes."""
    monkeypatch.setattr("ommatid.reconstruct.frame.error_map.MANY", 1000)
    monkeypatch.setattr("ommatid.reconstruct.frame.error_map.SHORT_HALO", halo)
    settings = stack.scene.estimator.model_copy(update={"method": "frame"})
    return restore(replace(stack, scene=stack.scene.model_copy(update={"estimator": settings})), model, truth)


def check_error_bars(whole: Reconstruction, windows: Reconstruction) -> None:
    """Compare windows with one sweep over the frame: 2 % a pixel, 0.2 % in the mean, and the bound holds."""
    ratio = windows.expected.variance / whole.expected.variance
    assert 1e-12 < np.abs(ratio - 1).max() < 0.02
    assert windows.expected.mse == pytest.approx(whole.expected.mse, rel=2e-3)
    assert windows.expected.degrees_of_freedom == pytest.approx(whole.expected.degrees_of_freedom, rel=1e-4)
    assert windows.budget()["null_space"] == pytest.approx(whole.budget()["null_space"], rel=0.01)
    assert max(windows.solver.variance_bound, whole.solver.variance_bound) < 0.01
    assert windows.interval is not None
    assert whole.interval is not None
    assert windows.interval.mse == pytest.approx(whole.interval.mse, rel=5e-3)
    assert windows.interval.high == pytest.approx(whole.interval.high, rel=0.01)


BROAD = (75, 71)  # the smallest frame that is cut into windows with a halo of three boxes


@pytest.mark.slow
@pytest.mark.parametrize("expected", [{}, {"noise_variance": 0.1}], ids=["noise as expected", "other noise"])
def test_a_rendering_with_an_ideal_h_has_the_error_bars_of_one_sweep(
    monkeypatch: pytest.MonkeyPatch, expected: dict[str, float]
) -> None:
    """Rendering noise that is uneven over two decades."""
    scene = wide(BROAD, noise={"variance": 1e-2}, estimator=expected)
    truth, camera = drawn(BROAD), derive(scene)
    rendering = uneven(camera, 2)
    stack = replace(recorded(scene, truth, 1e-2 + rendering), variance=rendering)
    model = ideal_model(scene, camera)
    check_error_bars(*(_restored(stack, model, truth, monkeypatch, halo) for halo in (40, 3)))


@pytest.mark.slow
def test_a_stored_h_has_the_error_bars_of_one_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    """An uncertain H, whose noise differs between pixels."""
    scene = wide(BROAD, FITTED, noise={"variance": 1e-2})
    model, true = blurred(scene, 0.003)
    truth = drawn(BROAD)
    stack = recorded(scene, truth, 1e-2, matrix=true)
    check_error_bars(*(_restored(stack, model, truth, monkeypatch, halo) for halo in (40, 3)))


def drawn(shape: tuple[int, int]) -> FloatArray:
    return 127.5 + np.random.default_rng(2).normal(0, P0**0.5, shape[0] * shape[1])


def test_noise_that_is_uneven_by_less_than_a_thousandth_is_even(monkeypatch: pytest.MonkeyPatch) -> None:
    """The map of even noise then serves, without windows, and differs by no more than the noise does."""
    shape = (62, 57)
    scene = wide(shape, noise={"variance": 1e-2})
    stack = recorded(scene, drawn(shape), 1e-2)
    model = ideal_model(scene, stack.camera)

    def windows(*_: object) -> FloatArray:
        raise AssertionError("windows where the noise is even")

    monkeypatch.setattr("ommatid.reconstruct.frame.error_map.frame_variances", windows)
    rendering = 2e-6 * np.random.default_rng(0).uniform(0, 2, stack.values.size)
    rendered, even = (
        _restored(replace(stack, variance=variance), model, None, monkeypatch, 3)
        for variance in (rendering, np.zeros(stack.values.size))
    )
    np.testing.assert_allclose(rendered.expected.variance, even.expected.variance, rtol=1e-3)


@pytest.mark.slow
def test_correlated_pixels_with_uneven_noise() -> None:
    """Bright and dark halves whose noise differs fourfold: the map of the level near each pixel, to a few percent."""
    shape = (44, 40)
    prior = {"kind": "exponential", "variance": 2000.0, "correlation_length": "3 mm"}
    scene = wide(shape, noise={"variance": 1.0}, prior=prior)
    camera = derive(scene)
    truth = np.full(camera.unknowns, 127.5)
    half = BoxFootprints(camera).forward((np.arange(camera.unknowns) % shape[1] > shape[1] // 2).astype(float))
    noise = 1.0 + 3 * half
    stack = replace(recorded(scene, truth, noise), variance=noise - 1.0)
    frame, dense = (
        restore(
            replace(
                stack,
                scene=scene.model_copy(update={"estimator": scene.estimator.model_copy(update={"method": method})}),
            ),
            ideal_model(scene, camera),
        )
        for method in ("frame", "information")
    )
    ratio = (frame.expected.variance / dense.expected.variance).reshape(shape)
    inner = ratio[12:-12, 12:-12]
    assert inner.mean() == pytest.approx(1.0, abs=0.02)
    assert np.abs(inner - 1).max() < 0.15
