"""Fixtures of the tests of recorded frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import read

from .mosaics import NOISE, SCENE


@pytest.fixture
def imaging_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Camera:
    """The camera of scene.toml in the current folder, which is the test's own."""
    (tmp_path / "scene.toml").write_text(SCENE + NOISE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return derive(read(Path("scene.toml")))
