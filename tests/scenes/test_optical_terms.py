"""A camera in the terms of optics, against values worked out by hand."""

from __future__ import annotations

from fractions import Fraction
from math import radians, tan
from pathlib import Path

import pytest

from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import OpticalTerms, optical_terms
from ommatid.scenes.scene import read


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
    assert lens.airy_diameter is not None
    assert lens.airy_diameter * 6 == pytest.approx(2.44 * 0.5 * 4 * 1.5, rel=1e-3), "um on the sensor, of 2.43934"


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
