"""A camera in the terms of optics, against values worked out by hand, and warnings about it."""

from __future__ import annotations

from fractions import Fraction
from math import radians, sqrt, tan
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import FULL_WELL, OpticalTerms, camera_warnings, optical_terms
from ommatid.scenes.scene import read
from ommatid.scenes.tables.gallery import gallery_names
from ommatid.scenes.tables.sensor import SensorTable

from ..examples import not_none


def terms_of(name: str, *changes: str) -> OpticalTerms:
    scene = read(Path(name), changes)
    return optical_terms(scene, derive(scene))


def test_type_i_of_the_tile_images_at_one_to_five_hundred() -> None:
    """A 6 um pixel spans 3 pixels of 1 mm: 1/500. So the sensor is 2 mm behind the lens, and 1/f = 1/2 + 1/1000."""
    lens = terms_of("tile19").types[0]
    assert lens.grid_magnification == Fraction(1, 3)
    assert lens.magnification == pytest.approx(1 / 500, rel=1e-12)
    assert lens.total_track == pytest.approx(2.0, rel=1e-12)
    assert lens.focal_length == pytest.approx(2000 / 1002, rel=1e-12)
    assert (lens.aperture, lens.f_number, lens.airy_diameter) == (None, None, None)


def test_the_field_of_view_spans_the_window_at_the_targets_distance() -> None:
    """The 5 x 5 pixels of type I see 15 mm of the target at 1 m."""
    height, width = terms_of("tile19").types[0].field_of_view
    assert 2 * 1000 * tan(radians(width) / 2) == pytest.approx(15, rel=1e-12)
    assert height == width


def test_the_airy_disk_is_that_of_the_working_f_number() -> None:
    """2.44 wavelength N (1 + m): type I at 1/2 magnification and f/4 is f/6 at the sensor."""
    close = ("target.distance=6 mm", "target.pixel_pitch=4 um", "camera.wavelength=500 nm")
    changes = (*close, "camera.lens.I.aperture=0.5 mm", "camera.lens_pitch=20 mm")
    lens = terms_of("tile19", *changes).types[0]
    assert lens.magnification == pytest.approx(0.5)
    assert lens.focal_length == pytest.approx(2.0)
    assert lens.f_number == pytest.approx(4.0)
    assert not_none(lens.airy_diameter) * 6 == pytest.approx(2.44 * 0.5 * 4 * 1.5, rel=1e-3), (
        "um on the sensor, of 2.43934"
    )


def test_the_area_is_that_of_the_recorded_pixels() -> None:
    terms = terms_of("tile19")
    assert terms.lenses == 9 + 25 + 16
    assert terms.sensor_area == pytest.approx((9 * 25 + 25 * 9 + 16 * 16) * 0.006**2)
    assert terms.total_track == terms.types[0].total_track
    assert (terms.sensor_size, terms.sensor_share) == (None, None)


def test_the_extent_is_that_of_the_patches_of_all_lens_types() -> None:
    """Nine lenses at 0.5 mm and patches of 66 um stand 1.066 mm wide, plus the patches' shift towards the outside.

    The outer lenses stand 1 mm apart and their windows 2 pixels of 1 mm the same way, so (1 - 2) / 500 mm is added.
    """
    scene = read(Path("tile35"), (), ("I",))
    height, width = optical_terms(scene, derive(scene)).sensor_extent
    assert width == pytest.approx(1.0 + 0.066 + (1.0 - 2.0) / 500, rel=1e-9)
    assert height == pytest.approx(width)


def test_a_sensor_of_a_named_format_is_used_in_part() -> None:
    """A 1/2.3 inch sensor has 4.55 x 6.17 mm."""
    terms = terms_of("tile19", 'camera.sensor.size="1/2.3"')
    assert terms.sensor_size == (4.55, 6.17)
    assert terms.sensor_share == pytest.approx(706 * 0.006**2 / (4.55 * 6.17))


def test_a_rotated_patch_takes_the_upright_box_around_it() -> None:
    """59 x 59 pixels of 6 um, turned by 45 degrees, are sqrt(2) times as wide."""
    turned = 'camera.lens.I.sub_imager=[{at = [0, 0], rotation = "45 deg"}]'
    scene = read(Path("single"), [turned])
    assert optical_terms(scene, derive(scene)).sensor_extent == pytest.approx([59 * 0.006 * sqrt(2)] * 2)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ('["4.55 mm", "5 mm"]', ("height x width", "4.55 x 5 mm", "smaller camera.lens_pitch")),
        ('["6.17 mm", "4.55 mm"]', ("6.17 x 4.55 mm", "its height comes first")),
        ('"1/2.4"', ("1/2.3", "got '1/2.4'")),
        ("5", ("camera.sensor.size", "one of the formats", "got 5;")),
    ],
)
def test_sensors_that_do_not_hold_the_arrays_are_refused(size: str, words: tuple[str, ...]) -> None:
    """Twelve lenses side by side, 0.5 mm apart, take 5.5 mm and the patches at their ends."""
    with pytest.raises(InputError) as caught:
        terms_of("tile19", f"camera.sensor.size={size}")
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("size", ["1", "1.0", '"1"', '"1 inch"'])
def test_the_format_of_one_inch_needs_no_quotation_marks(size: str) -> None:
    """TOML reads 1 as a number, but 1/2.3 as text."""
    assert terms_of("tile19", f"camera.sensor.size={size}").sensor_size == (8.8, 13.2)


def test_a_sensor_as_large_as_the_arrays_holds_them() -> None:
    height, width = terms_of("tile19").sensor_extent
    exact = f'camera.sensor.size=["{height!r} mm", "{width!r} mm"]'
    assert terms_of("tile19", exact).sensor_size == (height, width)
    with pytest.raises(InputError, match="the sub-images of all arrays"):
        terms_of("tile19", f'camera.sensor.size=["{height * 0.999!r} mm", "{width!r} mm"]')


# --- warnings


def warnings_of(name: str, *changes: str) -> list[str]:
    scene = read(Path(name), changes)
    camera = derive(scene)
    return camera_warnings(scene, camera, optical_terms(scene, camera))


@pytest.mark.parametrize("name", gallery_names())
def test_the_gallery_gives_no_warning(name: str) -> None:
    assert warnings_of(name) == []


RAYS = "camera.wavelength=none"
SINGLE = ("target.pixel_pitch=1 mm", "camera.lens_pitch=9 mm")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        # 2.44 * 0.55 um * 2 mm / 0.5 mm = 5.37 um
        (("camera.pixel_pitch=3 um", "target.pixel_pitch=0.5 mm"), ("set camera.lens.I.aperture", "lens I is 1.8")),
        # 2.44 * 0.55 um * 2 mm / 0.08 mm = 33.5 um
        (("camera.lens.I.aperture=80 um", RAYS), ("set camera.wavelength", "lens I is 5.6 sensor pixels wide at 550")),
        (("camera.lens.I.aperture=80 um",), ("wider than its sub-image", "5.59 sensor pixels", "aperture wider")),
        (("target.distance=4 mm", *SINGLE), ("field of view of 124 degrees", "target.distance longer")),
        (("noise.variance=1e-2", "noise.bits=6"), ("0.025 times the", "EMVA 1288", "raise noise.bits")),
        (("camera.lens.I.f_number=0.4", "camera.lens_pitch=20 mm"), ("lens type I is f/0.4", "f/0.5")),
        # the root of 10000 electrons, of which 255 stands for all
        (("noise=",), ("sensor noise is not modelled: add [noise] or [sensor]", "deviation of 2.55 of 255")),
    ],
)
def test_each_warning_names_the_number_and_the_key(changes: tuple[str, ...], words: tuple[str, ...]) -> None:
    said = warnings_of("tile19", *changes)
    assert any(all(word in sentence for word in words) for sentence in said), said


def test_the_full_well_is_the_default_of_a_sensor() -> None:
    assert SensorTable.model_fields["full_well"].default == FULL_WELL


def test_diffraction_that_is_modelled_or_narrow_is_no_warning() -> None:
    assert warnings_of("tile19", "camera.lens.I.f_number=5") == []
    assert warnings_of("tile19", "camera.lens.I.f_number=3", "camera.lens_pitch=1 mm", RAYS) == []


def test_a_single_lens_may_be_wider_than_the_pitch() -> None:
    assert warnings_of("single", "camera.pixel_pitch=3 um") == []


def test_a_sensor_whose_dark_noise_is_below_a_quarter_of_a_step() -> None:
    """2 electrons and 20 per second for 0.1 s are a noise of 2.4, of 0.12 steps at 20 electrons per number."""
    (words,) = warnings_of("sensor", "sensor.gain=0.05", *DARK)
    assert "0.12 times the quantisation step" in words
    assert "raise sensor.gain" in words
    assert not warnings_of("sensor", "sensor.gain=0.2", *DARK)


DARK = ("sensor.read_noise=2", "sensor.dark_current=20", "sensor.exposure=100 ms")
