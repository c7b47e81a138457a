"""Pixels that are open in part: H in closed form against that of finer pixels, rendered light and calibrations."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.restore import restore
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.fitted.view import COUNT, MAGNIFICATION, real_box
from ommatid.scenes.hardware.frames import AcquisitionSettings, read_frames
from ommatid.scenes.scene import Scene, parse, read
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import designed_kernels, ideal_matrix, ideal_model, true_matrix
from ommatid.simulate.render import render

from ..examples import THREE, Lenses, inside_interval, needs, scene, with_optics
from ..frames import assert_methods_agree, recorded, wide
from ..lenses import BICONVEX
from ..scenes.mosaics import NOISE, SCENE, as_mosaic

Part = str | list[str]  # a fill factor, or one down and one across

SHAPE = (25, 25)
LENS: Lenses = (("1/3", [2, 2], [6, 6]),)
FINE: Lenses = (("1", [2, 2], [18, 18]),)
ROOM = {"lens_pitch": "1 mm"}
BLUR = {"pixel_blur": "2 um"}  # of pixels of 6 um
OPTICS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "pinholes": ({}, {}),
    "rotated": ({}, {"tolerance": {"rotation": "2 deg", "position": "2 um"}}),
    "distorted": ({"distortion": [0.05, 0.0]}, {}),
    "diffracting": ({"aperture": "0.4 mm"}, {}),
    "out of focus": ({"aperture": "0.4 mm", "focus": "0.7 m"}, {"wavelength": "none"}),
    "surfaces": ({"surfaces": BICONVEX, "scale": "fit"}, {}),
}
SLOW = pytest.mark.slow
SLOW_SURFACES = [*[*OPTICS][:-1], pytest.param("surfaces", marks=SLOW)]


def divided(name: str) -> Camera:
    """The same camera with pixels a third as wide, all open, at the same places of the sensor."""
    lens, table = OPTICS[name]
    _, camera = with_optics(lens, ROOM | table | {"pixel_pitch": "2 um"}, FINE, SHAPE)
    return camera


def opened(name: str, part: Part, light: str = "lost", **more: Any) -> tuple[Scene, Camera]:
    """A camera whose pixels are open in part."""
    lens, table = OPTICS[name]
    return with_optics(lens, ROOM | table | {"fill_factor": part, "fill_light": light} | more, LENS, SHAPE)


@pytest.mark.parametrize("name", SLOW_SURFACES)
def test_the_open_third_of_a_pixel_is_the_middle_one_of_nine_pixels(name: str) -> None:
    """Whatever the lens: the pixels a third as wide have a closed form of their own; a slit is the mean of three."""
    fine = true_matrix(divided(name)).toarray().reshape(4, 6, 3, 6, 3, -1)
    openings = {("1/3", "1"): fine[:, :, 1].mean(axis=3), ("1", "1/3"): fine[..., 1, :].mean(axis=2)}
    squares = fine[:, :, 1, :, 1].reshape(144, -1)
    within = {"surfaces": 2e-4, "diffracting": 1e-6, "out of focus": 1e-6}.get(name, 1e-9)  # edges to 6 digits
    for light, share in (("lost", 1 / 9), ("kept", 1.0)):
        found = true_matrix(opened(name, "1/3", light)[1]).toarray()
        np.testing.assert_allclose(found, share * squares, atol=share * within)
    # Closed forms of blur neglect how it, and the weight of light, vary within a pixel.
    whole = true_matrix(opened(name, "1")[1]).toarray() - fine.mean(axis=(2, 4)).reshape(144, -1)
    for (down, across), seen in openings.items():
        found = 3 * true_matrix(opened(name, [down, across])[1]).toarray()
        np.testing.assert_allclose(found, seen.reshape(144, -1), atol=2 * float(np.abs(whole).max()) + within)


@pytest.mark.parametrize(
    ("ratio", "part"), [("1/3", "2/3"), ("2/5", "1/2"), ("1/4", "7/10"), ("2/5", ["1/2", "1"]), ("1/4", ["1", "7/10"])]
)
def test_a_box_of_any_side_is_a_mean_of_points(ratio: str, part: Part) -> None:
    camera = derive(scene((19, 19), ((ratio, [2, 2], [3, 3]),), camera={"fill_factor": part}))
    (lens,), points = camera.types, (np.arange(2000) + 0.5) / 2000
    parts = [float(Fraction(each)) for each in (part if isinstance(part, list) else [part, part])]
    expected = np.zeros((2, 2, 3, 19))
    for axis, k, i in np.ndindex(2, 2, 3):
        inside = (1 - parts[axis]) / 2 + parts[axis] * points
        places = float(lens.starts(axis)[k]) + float(lens.ratio) * (i + inside)
        expected[axis, k, i] = np.bincount(places.astype(int), minlength=19) / points.size
    matrix = ideal_matrix(camera).toarray().reshape(2, 2, 3, 3, 19, 19)
    both = np.einsum("kia,ljb->klijab", *expected) * np.prod(parts)
    np.testing.assert_allclose(matrix, both, atol=2e-3 * float(np.prod(parts)))
    moved = np.zeros(COUNT)
    moved[MAGNIFICATION] = 1e-9  # which leaves the integers of designed boxes
    displaced = [real_box(camera.shape, sub, moved).to_sparse().toarray() for sub in camera.sub_imagers]
    np.testing.assert_allclose(np.concatenate(displaced), ideal_matrix(camera).toarray(), atol=1e-7)


@pytest.mark.parametrize(("part", "blur"), [("2/3", {}), (["1/3", "1"], {}), (["1/3", "1"], BLUR)])
@pytest.mark.parametrize("name", ["diffracting", "out of focus", SLOW_SURFACES[-1]])
def test_kernels_are_the_entries(name: str, part: Part, blur: dict[str, Any]) -> None:
    _, camera = opened(name, part, **blur)
    kernels = designed_kernels(camera, camera.types[0]).to_sparse().toarray()
    exact = ideal_matrix(camera).toarray()
    assert np.abs(kernels - exact).max() < 4e-3 * exact.max()
    assert exact.sum(axis=1).max() <= float(camera.types[0].light) + 1e-9


@pytest.mark.parametrize("part", [["1/3", "1"], ["1/2", "2/3"], ["1", "1/3"]])
def test_slits_before_pinholes_are_rendered_without_error(part: Part) -> None:
    needs("llvm_ad_mono")
    optics = ROOM | {"fill_factor": part}
    described, camera = with_optics({}, optics, LENS, SHAPE, noise={"variance": 1e-2}, render={"samples": "auto"})
    setup = Setup.from_scene(described)
    rendering = render_until(setup)
    np.testing.assert_allclose(rendering.mean, ideal_matrix(camera) @ setup.image.ravel(), atol=2e-3)
    assert rendering.record["samples"] <= 256, "in a round or two"


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("pinholes", {"fill_factor": "2/3"}),
        ("pinholes", BLUR),
        *(pytest.param(each, {"fill_factor": "2/3"}, marks=SLOW) for each in ("rotated", "diffracting")),
    ],
)
def test_a_camera_is_rendered_and_calibrated_as_it_is(name: str, pixels: dict[str, Any]) -> None:
    """By few numbers, with "auto": the readings are those of the closed form, and the error is the expected one."""
    needs("llvm_ad_mono")
    lens, table = OPTICS[name]
    variance = 1.0 if name == "diffracting" or pixels == BLUR else 1e-2  # which takes fewer rays
    auto = {"noise": {"variance": variance}, "render": {"samples": "auto"}, "prior": {"kind": "fit"}}
    calibration = {"samples": 4096, "fit": "auto"}
    optics = ROOM | table | pixels
    described, camera = with_optics(lens, optics, THREE, SHAPE, calibration=calibration, **auto)
    setup = Setup.from_scene(described)
    stack, model = render(setup), calibrate(setup)
    exact = true_matrix(camera)
    assert not model.record["fit"]["refused"]
    scale = np.sqrt(np.square(exact.data).mean())
    assert np.sqrt(np.square((model.to_sparse() - exact).toarray()).sum() / exact.nnz) < 0.03 * scale
    noise = stack.values - exact @ setup.image.ravel()
    assert np.square(noise).mean() == pytest.approx(variance, rel=0.2)
    done = restore(stack, model, setup.image.ravel())
    assert done.verdict.level == "green"
    assert inside_interval(done)


@pytest.mark.parametrize(
    "part", ["1/3", ["1/3", "1"], pytest.param("2/3", marks=SLOW), pytest.param("1/2", marks=SLOW)]
)
def test_frames_of_open_parts_have_the_error_bars_of_dense_matrices(part: Part) -> None:
    def described(method: str) -> Scene:
        made = wide((41, 38), calibration={"method": "ideal"}, noise={"variance": 1e-2}, estimator={"method": method})
        data = made.plain()
        data["camera"]["fill_factor"] = part
        return parse(data, made.source)

    assert_methods_agree(described, ["frame"], 0.02)


def test_a_uniform_target_reads_what_the_open_part_receives() -> None:
    for light, value in (("lost", 100 / 9), ("kept", 100.0)):
        described, camera = opened("pinholes", "1/3", light)
        stack = recorded(described, np.full(camera.unknowns, 100.0), 0.0)
        np.testing.assert_allclose(stack.values, value)
        assert ideal_model(described, camera).applied.forward(np.ones(camera.unknowns)) == pytest.approx(value / 100)


def test_flat_frames_are_seen_through_the_same_openings(tmp_path: Path) -> None:
    """Readings of a recorded picture are those of H, whatever the gain; a flat frame shows a value of 200."""
    path = tmp_path / "scene.toml"
    path.write_text((SCENE + NOISE).replace("[camera]", '[camera]\nfill_factor = "1/3"', 1), encoding="utf-8")
    camera = derive(read(path))
    readings = ideal_matrix(camera) @ np.random.default_rng(0).uniform(0, 255, camera.unknowns)
    flat = ideal_matrix(camera) @ np.full(camera.unknowns, 200.0)
    for name, values in (("image", readings), ("flat", flat)):
        np.save(tmp_path / f"{name}.npy", as_mosaic(camera, 7.0 * values).astype(np.float32))
    settings = AcquisitionSettings(flat=(tmp_path / "flat.npy",), flat_value=200.0)
    found = read_frames(camera, [tmp_path / "image.npy"], settings, mosaics=True).values()
    np.testing.assert_allclose(found[0], readings, rtol=1e-5)


@pytest.mark.parametrize("part", ["0", "3/2", "1/21", "wide", ["1", "0"], ["1"], ["1", "1", "1"], ["1/2", "3/2"]])
def test_other_fill_factors_are_refused(part: Part) -> None:
    with pytest.raises(InputError, match="fill_factor"):
        opened("pinholes", part)


def test_the_scalar_backend_is_refused() -> None:
    needs("scalar_rgb")
    described, _ = opened("pinholes", "1/3")
    scalar = described.model_copy(update={"render": described.render.model_copy(update={"variant": "scalar_rgb"})})
    with pytest.raises(InputError, match=r"camera\.fill_factor below 1.* need Mitsuba's fast backend"):
        render(Setup.from_scene(scalar))
