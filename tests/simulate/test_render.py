"""Rendering to a stack: repeatable to the bit on any number of threads, with variances and fingerprints; exports."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ommatid.scenes.camera import derive
from ommatid.scenes.formats.exr import read_picture
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import made_from, mean_of_neighbours, render
from ommatid.simulate.renderer.plugins import export

from ..examples import THREE, VARIANTS, needs, scene


def recorded(described: Scene) -> Stack:
    """Render and record a scene."""
    return render(Setup.from_scene(described))


@pytest.mark.parametrize(("samples", "sampler"), [(256, "multijitter"), ("auto", "independent")])
@pytest.mark.parametrize("variant", VARIANTS)
def test_same_seed_same_bits_on_any_number_of_threads(
    variant: str, samples: int | str, sampler: str, threads: Callable[[int], None]
) -> None:
    needs(variant)
    render = {"variant": variant, "samples": samples, "sampler": sampler}
    described = scene((19, 19), THREE, render=render, noise={"variance": 100.0})
    found: list[Stack] = []
    for count in (1, 8, 5):
        threads(count)
        found.append(recorded(described))
    record = {key: value for key, value in found[0].record.items() if key != "seconds"}
    for other in found[1:]:
        assert other.values.tobytes() == found[0].values.tobytes()
        assert other.variance.tobytes() == found[0].variance.tobytes()
        assert record == {key: value for key, value in other.record.items() if key != "seconds"}


def test_progress_ends_at_one_and_another_seed_gives_other_noise() -> None:
    fractions: list[float] = []
    one, other = (
        render(Setup.from_scene(scene(render={"variant": "scalar_rgb", "samples": 16, "seed": seed})), fractions.append)
        for seed in (1, 2)
    )
    assert (one.values != other.values).mean() > 0.5
    half = len(fractions) // 2
    assert fractions[:half] == fractions[half:] == sorted(fractions[half:])
    assert fractions[-1] == 1.0
    assert one.rendering_variance.astype(np.float32).min() > 0, "in the file's precision too"


def test_the_fingerprint_changes_with_the_inputs_of_the_values_only() -> None:
    plain = scene()
    camera, image = derive(plain), load(plain)
    first = made_from(Setup(plain, camera, image))
    assert made_from(Setup(scene(prior={"mean": 100.0}), camera, image)) == first
    assert made_from(Setup(scene(noise={"variance": 1.0}), camera, image)) != first
    assert made_from(Setup(scene(render={"seed": 3}), camera, image)) != first
    assert made_from(Setup(plain, camera, image + 1)) != first


def test_the_neighbours_of_a_pixel_do_not_hold_its_own_value() -> None:
    """At edges and corners, too: what tells how large a sample variance should be must not depend on it."""
    image = np.random.default_rng(4).uniform(1, 2, (6, 7))
    for place in np.ndindex(image.shape):
        changed = image.copy()
        changed[place] = 100.0
        assert mean_of_neighbours(changed)[place] == pytest.approx(mean_of_neighbours(image)[place], rel=1e-12)


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
