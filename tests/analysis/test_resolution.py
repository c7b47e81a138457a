"""Averaging kernels and transfer functions against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.averaging_kernel import ErrorWindow, error_window
from ommatid.analysis.resolution import of_sub_image, of_window, transfer
from ommatid.reconstruct.output.result_files import reconstruct
from ommatid.reconstruct.prior import exponential
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses, covariance_of, gain_and_error, not_none, scene
from ..page.runs import record

PRIOR = 100.0  # variance


def window_of(shape: tuple[int, int], lenses: Lenses, noise: float, **tables: Any) -> ErrorWindow:
    """The window of a camera of ideal pinholes, and of independent pixels unless `tables` says otherwise."""
    tables = {"prior": {"mean": 127.5, "variance": PRIOR}, "noise": {"variance": noise}} | tables
    described = scene(shape, lenses, **tables)
    image = np.full(shape, 127.5)
    stack, model = record(described, image)
    report = reconstruct(stack, model, None, (Path("stack"), Path("model")))[1]
    return not_none(error_window(replace(stack, values=model.forward(image)), model, image, report))


def test_pixels_seen_one_by_one_have_the_response_of_a_wiener_filter() -> None:
    window = window_of((12, 12), (("1", [1, 1], [12, 12]),), 50.0)
    waves = of_window(window)
    share = PRIOR / (PRIOR + 50.0)
    np.testing.assert_allclose(waves.horizontal, share)
    np.testing.assert_allclose(waves.vertical, share)
    assert window.correlated_pixels == pytest.approx(1)


def test_blocks_of_two_pixels_have_the_response_of_a_box() -> None:
    """Each pixel of a block is estimated by the mean of its four, times p / (p + 4 v)."""
    window = window_of((12, 12), (("1/2", [1, 1], [6, 6]),), 10.0)
    waves = of_window(window)
    share = PRIOR / (PRIOR + 4 * 10.0)
    # Pixels stand half a pixel before and after the middle of their block: exp(+-i pi u) cos(pi u), on average.
    np.testing.assert_allclose(waves.horizontal, share * np.cos(np.pi * waves.frequencies) ** 2, atol=1e-12)
    np.testing.assert_allclose(waves.vertical, waves.horizontal, atol=1e-12)
    assert waves.half == pytest.approx(np.arccos(np.sqrt(0.5 / share)) / np.pi, abs=1e-3)
    # C = p (I - share J / 4) in a block: correlations of three pixels, -share / 4 / (1 - share / 4)
    correlation = share / 4 / (1 - share / 4)
    assert window.correlated_pixels == pytest.approx(1 + 3 * correlation**2)


def test_a_kernel_along_a_row_lowers_the_contrast_of_waves_along_it_alone() -> None:
    """The mean of three pixels of a row is the Dirichlet kernel, and none of a column."""
    kernels = np.zeros((1, 7, 9))
    kernels[0, 3, 3:6] = 1 / 3
    found = transfer(kernels, np.array([[3.0, 4.0]]))
    waves = 2 * np.pi * found.frequencies
    np.testing.assert_allclose(found.horizontal, np.abs(1 + 2 * np.cos(waves)) / 3, atol=1e-12)
    np.testing.assert_allclose(found.vertical, 1.0)


def test_a_sensor_pixel_has_the_response_of_its_box() -> None:
    described = scene((16, 16), (("1/4", [2, 2], [3, 3]),), noise={"variance": 1.0})
    stack, model = record(described, np.zeros((16, 16)))
    window = window_of((16, 16), (("1/4", [2, 2], [3, 3]),), 1.0)
    shown = not_none(of_sub_image(model, window, stack.camera.sub_imagers[0].name))
    frequencies = shown.frequencies[1:]
    box = np.abs(np.sin(4 * np.pi * frequencies) / (4 * np.sin(np.pi * frequencies)))
    np.testing.assert_allclose(shown.horizontal[1:], box, atol=1e-12)
    assert of_sub_image(model, window, "nothing") is None


def test_kernels_and_covariance_are_those_of_the_dense_equations() -> None:
    lenses: Lenses = (("1/3", [3, 3], [3, 3]), ("1/2", [2, 2], [5, 5]))
    prior = {"kind": "exponential", "mean": 127.5, "variance": PRIOR, "correlation_length": "3 mm"}
    window = window_of((12, 12), lenses, 2.0, prior=prior)
    matrix = ideal_matrix(record(scene((12, 12), lenses), np.zeros((12, 12)))[0].camera).toarray()
    gain, covariance = gain_and_error(matrix, covariance_of(exponential(0.0, PRIOR, (12, 12), 3.0)), 2.0)
    pixels = np.array([0, 77])
    np.testing.assert_allclose(window.kernels(pixels).reshape(2, -1), (gain @ matrix)[pixels], atol=1e-9)
    np.testing.assert_allclose(window.covariance, covariance, atol=1e-9)


@pytest.mark.parametrize("size", [37, 12])
def test_the_middle_of_a_frame_is_that_of_its_window(size: int) -> None:
    lenses: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
    window = window_of((size, size), lenses, 1.0)
    assert window.is_whole == (size == 12)
    waves = of_window(window)
    assert 0.9 < waves.horizontal[0] < 1.02, "a uniform image keeps its value, but for the prior's part"
    np.testing.assert_allclose(waves.horizontal, waves.vertical, rtol=1e-9)


# --- degrees of freedom


def test_degrees_of_freedom_of_the_mean_square_of_correlated_errors() -> None:
    """Twice its squared mean over its variance: of normal errors of covariance C, (tr C)^2 / tr C^2."""
    window, pixels = window_of((12, 12), (("1/3", [2, 2], [3, 3]),), 0.01), np.arange(40)
    covariance = window.covariance[:40, :40]
    expected = np.trace(covariance) ** 2 / np.square(covariance).sum()
    assert window.degrees_of_freedom(pixels) == pytest.approx(expected, rel=1e-9)
    assert expected < 39
