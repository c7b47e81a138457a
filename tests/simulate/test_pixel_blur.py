"""Pixels whose charges diffuse: H in closed form against products of normal distributions, rays and renderings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import j0, ndtr

from ommatid.analysis.summary import describe
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.blur import Blur
from ommatid.scenes.optics.radial_density import RadialDensity, diffused, disk_density, panel_nodes
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import designed_kernels, ideal_matrix
from ommatid.simulate.render import render

from ..examples import THREE, needs, with_optics
from .test_fill_factor import LENS, OPTICS, ROOM, SHAPE, SLOW, Part

BLUR = {"pixel_blur": "2 um"}  # of pixels of 6 um


def blurred(name: str, part: Part = "1", detail: int = 1, distance: str = "1 m", **tables: Any) -> tuple[Scene, Camera]:
    """A camera whose pixels blur, on the grid of H's columns."""
    lens, table = OPTICS[name]
    optics = ROOM | table | BLUR | {"fill_factor": part}
    data = with_optics(lens, optics, LENS, SHAPE, **tables)[0].plain()
    data["target"] |= {"detail": detail, "distance": distance}
    described = parse(data, Path("test.toml"))
    return described, derive(described).with_grid_of_matrix


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


@pytest.mark.parametrize("sigma", [0.05, 0.4, 3.0])
@pytest.mark.parametrize("name", ["disk", "in focus", "out of focus"])
def test_transfer_functions_are_multiplied(name: str, sigma: float) -> None:
    """The Hankel transform of the density is the product of the lens's and of the Gaussian's."""
    blurs = {"in focus": Blur(airy=0.2), "out of focus": Blur(disk=2.0, airy=0.1)}
    sharp = disk_density(2.0, 0.1) if name == "disk" else blurs[name].spread_density

    def transfer(radial: RadialDensity, frequencies: FloatArray) -> FloatArray:
        r, weights = panel_nodes(radial.breaks)
        return j0(2 * np.pi * np.outer(frequencies, r)) @ (weights * radial.density(r))

    k = np.array([0.0, 0.1, 0.3, 0.7])
    expected = transfer(sharp, k) * np.exp(-2 * np.square(np.pi * sigma * k))
    np.testing.assert_allclose(transfer(diffused(sharp, sigma), k), expected, atol=1e-5)


@pytest.mark.parametrize("detail", [1, pytest.param(3, marks=SLOW)])
@pytest.mark.parametrize("part", ["1", ["1/3", "1"]])
@pytest.mark.parametrize("name", ["pinholes", "diffracting", "out of focus", pytest.param("surfaces", marks=SLOW)])
def test_rays_measure_the_closed_form(name: str, part: Part, detail: int) -> None:
    """Entry by entry: squared errors over the variances of counted rays have mean 1.

    But for what closed forms of blur neglect, the variation of the light's weight within a pixel.
    """
    needs("llvm_ad_mono")
    samples = {"samples": 8192, "method": "transport", "fit": "none"}
    described, camera = blurred(name, part, detail, calibration=samples, render={"sampler": "independent"})
    model, light = calibrate(Setup.from_scene(described)), float(camera.types[0].light)
    share, found = ideal_matrix(camera).toarray() / light, model.matrix.toarray() / light
    hit = share > 20 / 8192  # by some rays
    scores = np.square(found - share)[hit] / (share * (1 - share) / 8192)[hit]
    error = 4 * scores.std(ddof=1) / scores.size**0.5
    neglected = 0.0 if name == "pinholes" else 0.1
    assert 1 - error - neglected < scores.mean() < 1 + error + neglected


@pytest.mark.parametrize("name", ["diffracting", pytest.param("surfaces", marks=SLOW)])
def test_kernels_are_the_entries(name: str) -> None:
    _, camera = blurred(name, ["1/3", "1"])
    exact = ideal_matrix(camera).toarray()
    kernels = designed_kernels(camera, camera.types[0]).to_sparse().toarray()
    assert np.abs(kernels - exact).max() < 4e-3 * exact.max()


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


def test_a_camera_is_rendered_and_calibrated_as_it_is() -> None:
    needs("llvm_ad_mono")
    tables = {"noise": {"variance": 1.0}, "render": {"samples": "auto"}, "prior": {"kind": "fit"}}
    described, camera = with_optics({}, ROOM | BLUR, THREE, SHAPE, calibration={"samples": 4096}, **tables)
    setup = Setup.from_scene(described)
    stack, model = render(setup), calibrate(setup)
    noise = stack.values - ideal_matrix(camera) @ setup.image.ravel()
    assert np.square(noise).mean() == pytest.approx(1.0, rel=0.2)
    done = restore(stack, model, setup.image.ravel())
    assert done.verdict.level == "green"
    assert done.result.interval is not None
    assert done.error is not None
    assert done.result.interval.low <= done.error.mse <= done.result.interval.high


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
