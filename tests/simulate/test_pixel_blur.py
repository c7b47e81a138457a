"""Pixels whose charges diffuse: H in closed form against products of normal distributions, rays and renderings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from ommatid.analysis.summary import describe
from ommatid.reconstruct.method_choice import choose_method
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.lens_matrix import row_by_rays, row_by_waves
from ommatid.scenes.optics.point_spread import point_spread
from ommatid.scenes.optics.wavefront import thin_wavefront
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import ideal_matrix

from ..examples import needs, with_optics
from .test_fill_factor import BLUR, LENS, OPTICS, ROOM, SHAPE, Part


def blurred(name: str, part: Part = "1", detail: int = 1, distance: str = "1 m", **tables: Any) -> tuple[Scene, Camera]:
    """A camera whose pixels blur, on the grid of H's columns."""
    lens, table = OPTICS[name]
    optics = ROOM | table | BLUR | {"fill_factor": part}
    target = {"detail": detail, "distance": distance}
    described, camera = with_optics(lens, optics, LENS, SHAPE, target=target, **tables)
    return described, camera.with_grid_of_matrix


def softened(ratio: float, start: float, size: int, deviation: float) -> FloatArray:
    """Share of an interval, moved by a normal distribution, in each of `size` texels: the mean of a difference."""
    t = np.arange(size + 1, dtype=np.float64)

    def integral(x: FloatArray) -> FloatArray:
        density = np.exp(-np.square(x / deviation) / 2) / np.sqrt(2 * np.pi)
        return x * ndtr(x / deviation) + deviation * density

    ramp = (integral(start + ratio - t) - integral(start - t)) / ratio
    return -np.diff(ramp)


@pytest.mark.parametrize(("part", "detail"), [("1", 1), ("2/3", 1), (["1/3", "1"], 3)])
def test_behind_a_pinhole_h_is_a_product_of_normal_distributions(part: Part, detail: int) -> None:
    _, camera = blurred("pinholes", part, detail)
    expected: list[FloatArray] = []
    for sub in camera.sub_imagers:
        sides, insets, ratio = sub.type.footprint, sub.type.inset, float(sub.type.ratio)
        rows, columns = (
            np.stack(
                [
                    softened(float(side), float(start + inset) + ratio * i, size, ratio / 3)
                    for i in range(sub.type.pixels[0])
                ]
            )
            for side, inset, start, size in zip(sides, insets, sub.window, camera.shape, strict=True)
        )
        expected.append(np.einsum("ia,jb->ijab", rows, columns).reshape(36, -1) * float(sub.type.light))
    exact = np.concatenate(expected)
    np.testing.assert_allclose(ideal_matrix(camera).toarray(), exact, atol=1e-5 * exact.max())


@pytest.mark.parametrize("wavelength", [None, 5.5e-4])
@pytest.mark.parametrize("focus", [1.0, 0.96])
def test_transfer_functions_are_multiplied(focus: float, wavelength: float | None) -> None:
    """The transform of a row is the one without the blur of pixels times a Gaussian's; texels are fine."""
    wave, width = thin_wavefront(0.4, 2.0, 0.0, 1.0, focus, wavelength, finest=2e-4), 401
    edges, side = (np.array([188.5, 212.5]),) * 2, 24.0

    def row(sigma: float) -> FloatArray:
        blur = sigma / side, sigma / side
        if wavelength is None:
            return row_by_rays(wave, 1e-3, edges, blur, (width, width))
        spread = point_spread(wave)
        return row_by_waves(spread.values, spread.cell / 1e-3, edges, blur, (width, width))

    k = np.array([0.0, 0.005, 0.01, 0.02])
    waves = np.exp(2j * np.pi * np.outer(k, np.arange(width)))
    sharp, soft = (np.abs(waves @ row(sigma).sum(axis=1)) for sigma in (0.0, 8.0))
    np.testing.assert_allclose(soft, sharp * np.exp(-2 * np.square(np.pi * 8.0 * k)), atol=5e-4)


@pytest.mark.parametrize("distance", ["1 m", "20 mm"])
def test_readings_are_those_of_the_closed_form(distance: str) -> None:
    """Rendered until the variance is a tenth of the noise's: it is the one that is stated, or less.

    Light behind a pinhole has the same weight from everywhere, also at the angles of a target that is near.
    """
    needs("llvm_ad_mono")
    tables: dict[str, Any] = {"noise": {"variance": 1e-2}, "render": {"samples": "auto"}}
    described, camera = blurred("pinholes", distance=distance, **tables)
    setup = Setup.from_scene(described)
    rendering = render_until(setup)
    errors = rendering.mean - ideal_matrix(camera) @ setup.image.ravel()
    assert rendering.variance.max() < 2e-3
    assert np.mean(np.square(errors) / rendering.variance) < 1.5


def test_the_contrast_at_nyquist_is_that_of_a_wave() -> None:
    """The transform of a pixel's row at half a period per pixel, and the numbers of docs/lenses.md."""
    for blur, known in (("1.5 um", 0.47), ("0.12 um", 0.64)):
        described, camera = with_optics({}, ROOM | {"pixel_blur": blur}, (("1/12", [1, 1], [5, 5]),), (61, 61))
        row = ideal_matrix(camera).toarray().reshape(5, 5, 61, 61)[2, 2].sum(axis=0)
        wave = np.exp(1j * np.pi / 12 * np.arange(61))
        setup = Setup.from_scene(described)
        shown = describe(setup, "llvm_ad_mono", choose_method(described, camera, setup.is_applied))["lens_types"][0]
        assert abs(row @ wave) == pytest.approx(shown["pixel_contrast"], abs=0.005)
        assert shown["pixel_contrast"] == pytest.approx(known, abs=0.005)


@pytest.mark.parametrize("blur", ["0.1 um", "13 um"])
def test_too_little_and_too_much_are_refused(blur: str) -> None:
    with pytest.raises(InputError, match=r"expected a pixel_blur from 0\.12 um to 12 um"):
        with_optics({}, {"pixel_blur": blur})


def test_without_a_closed_form_it_says_so() -> None:
    _, camera = blurred("distorted")
    with pytest.raises(InputError, match="pixel_blur has no closed form"):
        ideal_matrix(camera)
    with pytest.raises(InputError, match=r"camera\.pixel_blur"):
        calibrate(Setup.from_scene(blurred("pinholes", render={"variant": "scalar_rgb"})[0]))
