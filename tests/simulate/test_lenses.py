"""Whole runs through lenses and sensors beyond the paper's: measured errors against predicted ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.lens_table import lens_rows
from ommatid.reconstruct.noise import usable_pixels
from ommatid.reconstruct.restore import restore
from ommatid.runtime.errors import InputError
from ommatid.scenes import stack as stacks
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.optics import sharpness
from ommatid.scenes.optics.diffraction import pattern
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.render import render
from ommatid.simulate.renderer.plugins import export

from ..examples import THREE, Lenses, inside_interval, mean_weights, needs, with_optics

BIPLANE = [
    {"thickness": "5 mm", "semi_diameter": "0.1 mm"},  # a baffle, far before the lens
    {"radius": "1.0333 mm", "thickness": "0.3 mm", "index": 1.5, "semi_diameter": "0.1 mm", "stop": True},
    {"semi_diameter": "0.2 mm"},
]
# With 1024 samples most of the error behind such wide lenses is that of H, which is stated too large: docs/coverage.md.
MANY = {"method": "transport", "samples": 32768, "fit": "auto"}
SENSOR = {"illuminance": "300 lux", "exposure": "10 ms", "read_noise": 3, "gain": 0.5, "black_level": 40, "prnu": 0.01}


def built(
    lens: dict[str, Any], lenses: Lenses = THREE, shape: tuple[int, int] = (19, 19), wavelength: str = "", **tables: Any
) -> Scene:
    """Return a scene whose lens types all have these keys, calibrated by transport."""
    few = {"render": {"samples": 1024}, "calibration": {"method": "transport", "samples": 1024}}
    return with_optics(lens, {"wavelength": wavelength} if wavelength else {}, lenses, shape, **few | tables)[0]


@pytest.mark.parametrize(
    ("lens", "tables"),
    [
        ({"aperture": "0.4 mm", "focus": "700 mm"}, {"noise": {"variance": 1.0}}),
        pytest.param({"distortion": [0.05, 0.0]}, {"noise": {"variance": 1.0}}, marks=pytest.mark.slow),
        pytest.param({"aperture": "0.4 mm", "focus": "900 mm"}, {"sensor": SENSOR}, marks=pytest.mark.slow),
        pytest.param({"surfaces": BIPLANE[1:]}, {"sensor": SENSOR, "calibration": MANY}, marks=pytest.mark.slow),
    ],
    ids=["defocus", "distortion", "sensor", "surfaces and sensor"],
)
def test_the_measured_error_is_the_expected_one(lens: dict[str, Any], tables: dict[str, Any], tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    described = built(lens, **tables)
    camera, truth = derive(described), load(described)
    stacks.write(tmp_path / "stack.exr", render(Setup(described, camera, truth)))
    stack = stacks.read(tmp_path / "stack.exr")
    assert (stack.recording is not None) == ("sensor" in tables)
    found = restore(stack, calibrate(Setup(described, camera)), truth.ravel())
    assert inside_interval(found)


def test_pixels_that_no_light_can_reach_are_dead(tmp_path: Path) -> None:
    """A baffle vignettes the corners of the field: NaN in the stack, empty rows of H, unused by the estimate."""
    needs("llvm_ad_mono")
    described = built({"surfaces": BIPLANE}, (("1/3", [1, 1], [25, 25]),), (75, 75), "none", noise={"variance": 1.0})
    camera, truth = derive(described), load(described)
    stack, model = render(Setup(described, camera, truth)), calibrate(Setup(described, camera))
    stacks.write(tmp_path / "stack.exr", stack)
    np.testing.assert_array_equal(stacks.read(tmp_path / "stack.exr").values, stack.values.astype(np.float32))
    dark = np.isnan(stack.values)
    picture = dark.reshape(25, 25)
    assert picture[0, 0]
    assert picture[-1, -1]
    assert not picture[12, 12]
    sums = np.asarray(model.matrix.sum(axis=1)).ravel()
    inner = sums.reshape(25, 25)[2:-2, 2:-2]  # at the target's edges some light comes from beside it
    assert ((inner == 0) | (np.abs(inner - 1) < 1e-9)).all(), "what is known of a pixel is known wholly"
    assert sums[0] == sums[-1] == 0
    assert usable_pixels(stack).dead == dark.sum() > 40
    assert usable_pixels(stack, model).dead >= dark.sum()
    with_sensor = built({"surfaces": BIPLANE}, (("1/3", [1, 1], [25, 25]),), (75, 75), "none", sensor=SENSOR)
    # Dark is where one of 16 passes of 64 rays brought nothing: a fifth of the light makes that a chance of 1e-5.
    freed = electrons(with_sensor, camera)
    assert (freed[dark] < 0.2 * freed.max()).all()
    counted = render(Setup(with_sensor, camera, truth))
    assert np.isnan(counted.values[dark]).all()


@pytest.mark.slow
def test_electrons_follow_the_rendered_light() -> None:
    """Electrons from traced solid angles against the light that rendered rays bring: within 1 per cent."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer.renderer import Renderer

    described = built({"surfaces": BIPLANE[1:]}, sensor=SENSOR)
    camera = derive(described)
    freed = electrons(described, camera)
    renderer = Renderer(camera, "llvm_ad_mono", together=False)
    for group in renderer.groups:
        light, rows = mean_weights(renderer, group, 2**14), renderer.rows(group)
        np.testing.assert_allclose(light / light.mean(), freed[rows] / freed[rows].mean(), rtol=0.01)
    # One f-number for all types brings a pixel the same light, whatever the magnification.
    means = [freed[place].mean() for place in camera.type_slices()]
    assert max(means) / min(means) == pytest.approx(1, abs=0.05)


def test_lenses_without_a_closed_form_are_calibrated() -> None:
    """Distortion with defocus: H is there, only nothing to compare it with; and points see it as transport does."""
    needs("llvm_ad_mono")
    lens = {"aperture": "0.4 mm", "focus": "700 mm", "distortion": [0.05, 0.0]}
    described = built(lens, (("1/3", [2, 2], [3, 3]),), (12, 12), noise={"variance": 1e-2})
    model = calibrate(Setup.from_scene(described))
    assert "agreement" not in model.record
    # All light within the pattern's largest radius, but what misses the target, meets it.
    assert 0.9 < model.matrix.sum(axis=1).max() < pattern(0.0).encircled


def test_only_pinholes_can_be_exported(tmp_path: Path) -> None:
    described = built({"aperture": "0.4 mm"})
    with pytest.raises(InputError, match="cannot be exported"):
        export(Setup.from_scene(described), tmp_path / "lens.xml")


def test_a_corner_without_light_has_no_spot_size() -> None:
    """JSON has no NaN, and a table no `nan um`."""
    described = built({"surfaces": BIPLANE}, (("1/3", [1, 1], [25, 25]),), (75, 75), noise={"variance": 1.0})
    (found,) = sharpness.describe(derive(described))
    assert found["spot_rim"] is None
    assert found["spot_axis"] > 0
    assert found["illumination"] == 0
    described_type = {"name": found["lens"], "magnification": "1/3"}
    rows = {row[0]: row[1] for row in lens_rows([described_type], [found])}
    assert rows["spot, rms um"].endswith("/ no light")
    assert rows["sharpest at, mm"].endswith("/ no light")
    assert rows["distortion, %"] == "no light"
