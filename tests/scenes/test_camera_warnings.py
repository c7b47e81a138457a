"""Warnings about cameras: what matters and is left out, and quantities that no camera has."""

from __future__ import annotations

from pathlib import Path

import pytest

from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import FULL_WELL, camera_warnings, optical_terms
from ommatid.scenes.scene import read
from ommatid.scenes.tables.gallery import gallery_names
from ommatid.scenes.tables.sensor import SensorTable


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
