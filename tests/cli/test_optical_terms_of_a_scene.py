"""A camera in the terms of optics from the scene file to what is printed: docs/choose-a-camera.md behind pinholes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ommatid.scenes.scene import read

from ..conftest import Command
from ..documentation import ROOT, blocks, text_of

PAGE = ROOT / "docs" / "choose-a-camera.md"


@pytest.fixture
def phone(tmp_path: Path) -> str:
    """The scene of the page, which has no picture, behind pinholes."""
    text = next(block.text for block in blocks(PAGE) if block.file_name == "phone.toml")
    path = tmp_path / "phone.toml"
    path.write_text("".join(line for line in text.splitlines(True) if "aperture" not in line), encoding="utf-8")
    return str(path)


def test_the_example_has_the_pitch_that_it_states(phone: str) -> None:
    """2 mm at 0.5 m images at 1/249: a pixel of 1.55 um spans 0.38595 mm, three pixels of 0.12865 mm."""
    assert read(Path(phone)).target.pixel_pitch == pytest.approx(0.12865, rel=1e-12)
    assert "A pixel of the target is 0.12865 mm wide." in text_of(PAGE)
    coarse = read(Path(phone), [f"camera.lens.{name}.magnification={ratio}" for name, ratio in COARSE.items()])
    assert coarse.target.pixel_pitch == pytest.approx(0.38595, rel=1e-12)


COARSE = {"I": "1", "II": "3/4", "III": "3/5"}


def test_show_prints_the_terms_and_warns_of_what_is_left_out(phone: str, ommatid: Command) -> None:
    """2.44 * 550 nm * 2.008 mm / 0.5 mm = 5.39 um, 3.48 pixels; the pixels' area is 706 * (1.55 um)^2."""
    ended = ommatid("show", phone, "-v")
    words = " ".join(ended.out.replace("│", " ").split())
    for expected in ("on the sensor 1/249", "focal length, mm 2 ", "field of view, ° ", "total track 2.008 mm"):
        assert expected in words
    assert "warning: diffraction is not modelled: set camera.lens.I.aperture" in ended.err
    assert "lens I is 3.5, of lens II 2.6" in ended.err
    shown: dict[str, Any] = json.loads(ommatid("show", phone, "--json").out)
    assert shown["camera"]["sensor_share"] == pytest.approx(706 * 0.00155**2 / (4.55 * 6.17))
    assert shown["camera"]["lenses"] == 50


@pytest.mark.parametrize("command", [("run", "-o", "out"), ("render", "-o", "out"), ("export", "-o", "out.xml")])
def test_a_scene_without_a_picture_is_not_rendered(command: tuple[str, ...], phone: str, ommatid: Command) -> None:
    ended = ommatid(command[0], phone, *command[1:])
    assert ended.code == 2
    assert "target.image is absent, so there is nothing to render; name a picture" in ended.err
    assert not Path("out").exists()
    assert not Path("out.xml").exists()
