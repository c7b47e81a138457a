"""The exported scene, rendered by Mitsuba's own command, gives the sub-images of the camera."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from ommatid.scenes.camera import derive
from ommatid.scenes.formats.exr import read_picture
from ommatid.scenes.formats.picture import load
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.plugins import export

from ..examples import THREE, scene

MITSUBA = Path(sys.executable).with_name("mitsuba")


def test_mitsubas_own_command_renders_the_same(tmp_path: Path) -> None:
    """A sub-image of each lens type, films of mixed sizes, from another folder than the scene's."""
    described = scene((19, 20), THREE[:1] + THREE[1:2] + (("1/4", [2, 2], [4, 3]),), render={"samples": 4096})
    camera = derive(described)
    image = load(described)
    (tmp_path / "scene").mkdir()
    picture = export(Setup(described, camera, image), tmp_path / "scene" / "camera.xml")
    assert sorted(path.name for path in picture.parent.iterdir()) == ["camera.target.exr", "camera.xml"]
    ideal = ideal_matrix(camera) @ image.ravel()
    slices = camera.slices()
    for number in (0, 5, 9, 30, len(slices) - 1):
        output = tmp_path / f"{number}.exr"
        command = [
            str(MITSUBA),
            "-m",
            "scalar_rgb",
            "-s",
            str(number),
            "-o",
            str(output),
            str(picture.parent / "camera.xml"),
        ]
        subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
        rendered = read_picture(output).pixels
        pixels = camera.sub_imagers[number].type.pixels
        assert rendered.shape == pixels
        # 4096 stratified samples of steps of at most 255 err by 255 / 4096^(3/4) = 0.5 at most.
        np.testing.assert_allclose(rendered, ideal[slices[number]].reshape(pixels), atol=0.5)
