"""What `show` says of lenses, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ommatid.analysis.lens_table import lens_rows
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics import sharpness
from ommatid.scenes.optics.field import optics_of
from ommatid.scenes.optics.point_spread import point_spread
from ommatid.scenes.scene import read

from ..examples import GALLERY
from ..lenses import THIN, camera_with

LARGE = ("camera.lens_pitch=1 mm", "target.shape=[185, 185]", "target.origin=[0, 0]", "camera.lens.I.pixels=[61, 61]")


def thin(*changes: str) -> Camera:
    """Return a camera of one lens type, 61 x 61 pixels, with changes of its lens."""
    wide = (*LARGE, *(f"camera.lens.I.{change}" for change in changes))
    return derive(read(GALLERY / "tile19.toml", wide, ["I"]))


@pytest.mark.parametrize("waves", [0.0, 0.21, 0.5, 1.0, 2.0])
def test_a_defocused_thin_lens(waves: float) -> None:
    """W20 waves at the rim: a deviation of W20 / sqrt(12) over a uniform disk, and a Strehl ratio of sinc(W20)^2.

    Light at the rim of an f/20 lens is within 0.13 % of that on the axis.
    """
    aperture, distance, wavelength = 0.1, 1000.0, 5.5e-4
    focus = 1 / (1 / distance + 8 * waves * wavelength / aperture**2)
    (found,) = sharpness.describe(thin(f"aperture={aperture} mm", f"focus={focus} mm"))
    assert found["wavefront_axis"] == pytest.approx(waves / np.sqrt(12), rel=2e-3, abs=1e-9)
    centre = np.sinc(waves) ** 2  # the peak itself where less than a wave is lost
    if waves < 1:
        assert found["strehl_axis"] == pytest.approx(centre, abs=1e-3)
    else:
        assert found["strehl_axis"] > centre
    assert [found["sharpest_axis"], found["sharpest_rim"]] == pytest.approx([focus, focus], rel=1e-6)
    assert found["focus"] == pytest.approx(focus, rel=1e-9)


def test_a_thin_lens_is_darker_at_the_rim_by_the_fourth_power_of_the_cosine() -> None:
    camera = thin("aperture=20 um")
    (found,) = sharpness.describe(camera)
    kind = camera.types[0]
    square = 2 * (61 / 2 * camera.pixel_pitch / camera.depth(kind)) ** 2
    assert found["illumination"] == pytest.approx(1 / (1 + square) ** 2, rel=1e-4)
    assert found["distortion"] == 0
    assert found["curvature"] == pytest.approx(0, abs=1e-9)


def test_the_given_distortion_is_reported_where_the_sensor_ends() -> None:
    """Magnification times 1 + k1 r^2, r of the object point whose image is the farthest sensor point."""
    camera = derive(read(GALLERY / "distorted.toml", ["camera.lens.I.aperture=0.1 mm", "camera.lens_pitch=1 mm"]))
    (found,) = sharpness.describe(camera)
    kind = camera.types[0]
    field, (k1, k2) = optics_of(camera, kind, None), kind.optics.distortion or (0.0, 0.0)
    image = field.field / camera.depth(kind) * camera.distance / camera.half_diagonal
    radius = np.linspace(0, image, 200_001)
    at = float(np.interp(image, radius * (1 + k1 * radius**2 + k2 * radius**4), radius))
    assert found["distortion"] == pytest.approx(k1 * at**2 + k2 * at**4, rel=1e-6)


def test_the_field_of_a_thin_single_lens_is_curved_as_the_third_order_says() -> None:
    """Stop at the lens: best images on h^2 / 2f (2 + 1/n), midway between tangential 3 + 1/n and sagittal 1 + 1/n.

    The distance of the image does not matter to the third order but by h, the height on the image.
    """
    camera = camera_with(THIN, LARGE)
    (found,) = sharpness.describe(camera)
    field = optics_of(camera, camera.types[0], None)
    expected = -(field.field**2) / (2 * field.focal_length) * (2 + 1 / 1.5)
    assert found["curvature"] == pytest.approx(expected, rel=0.03)
    assert abs(found["distortion"]) < 1e-3


def test_quantities_that_no_lens_has_are_not_in_the_table() -> None:
    camera = thin("aperture=0.1 mm")
    lens = {"name": "I", "magnification": "1/3"}
    optics = sharpness.describe(camera)
    names = [name for name, _ in lens_rows([lens], optics)]
    assert "Strehl ratio" in names
    assert "steered" not in names
    assert [name for name, _ in lens_rows([lens])] == ["magnification"]


def test_thousands_in_the_table_are_whole_numbers() -> None:
    rows = lens_rows([{"name": "I", "pixels": [1019, 340], "airy_diameter": 1.2344, "sub_image_width": 0.1234}])
    assert rows == [("pixels of each", "1019 x 340"), ("width of each, mm", "0.123"), ("Airy disk, um", "1234")]


def test_a_thin_lens_through_focus_is_symmetric_and_agrees_with_a_displaced_focus() -> None:
    """A sensor moved by s has the contrast of one that is focused at 1/F + s / depth^2."""
    lens = "aperture=0.4 mm"
    camera = thin(lens)
    (curve,) = sharpness.through_focus(camera)
    np.testing.assert_allclose(curve.axis, curve.axis[::-1], atol=1e-9)
    np.testing.assert_allclose(curve.shifts, -curve.shifts[::-1])
    depth = camera.depth(camera.types[0])
    for number in (2, 7, 10):
        focus = 1 / (1 / camera.distance - curve.shifts[number] / depth**2)
        (found,) = sharpness.describe(thin(lens, f"focus={focus} mm"))
        assert curve.axis[number] == pytest.approx(found["contrast_axis"], abs=1e-3)
        assert curve.rim[number] == pytest.approx(found["contrast_rim"], abs=1e-3)


def test_pixels_far_wider_than_the_light_s_detail_have_a_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """The zeros of a disk of rays would be a hundred waves away: the curve ends at 10."""
    monkeypatch.setattr(sharpness, "FOCUS_STEPS", 3)
    camera = replace(thin("aperture=0.99 mm"), wavelength=2e-5)
    (curve,) = sharpness.through_focus(camera)
    number = camera.depth(camera.types[0]) / 0.99
    assert curve.shifts[-1] == pytest.approx(10 * 8 * 2e-5 * number**2)
    assert int(np.argmax(curve.axis)) == curve.axis.size // 2


@pytest.mark.slow
def test_a_lens_of_surfaces_through_focus_agrees_with_waves_traced_to_a_moved_sensor() -> None:
    camera = derive(read(GALLERY / "doublet.toml"))
    kind = camera.types[0]
    curve = sharpness.through_focus(camera)[0]
    for number in (5, 8, 12):
        moved = replace(optics_of(camera, kind, camera.wavelength), depth=camera.depth(kind) + curve.shifts[number])
        frequency = moved.depth / camera.distance / (4 * camera.pixel_pitch)  # which stays as it is on the sensor
        along = np.array([[frequency, 0.0], [0.0, frequency]])
        for height, contrast in ((0.0, curve.axis), (moved.field, curve.rim)):
            traced = point_spread(moved.lit_wave(height, moved.outline(height).extent)).transfer(along).min()
            assert contrast[number] == pytest.approx(traced, abs=0.01)


@pytest.mark.parametrize("changes", [(), ("aperture=0.4 mm", "pixels=[60, 60]")])
def test_pinholes_and_rays_have_no_curve(changes: tuple[str, ...]) -> None:
    camera = thin(*changes)
    assert sharpness.through_focus(replace(camera, wavelength=None)) == []
