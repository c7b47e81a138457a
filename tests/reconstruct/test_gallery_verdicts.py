"""Every scene of the gallery has the verdict that its key `expect` states, in smaller variants where it is slow.

The variants keep what a verdict depends on: the lenses, the way to H, the depth and the method.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.restore import restore
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import read, with_changes
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import gallery_names
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ground_truth import cached_truth
from ommatid.simulate.render import render

from ..examples import needs, not_none, scene, slow

TRANSPORT = "calibration.method=transport"  # the same H as from points, sooner
TILE = (
    "target.shape=[19, 19]",
    "camera.lens.I.pixels=[5, 5]",
    "camera.lens.II.pixels=[3, 3]",
    "camera.lens.III.pixels=[4, 4]",
)
SAMPLES = ("render.samples=8192", "calibration.samples=8192")
PERSON = ("target.origin=[96, 224]",)
DEEP = ("target.shape=[29, 29]", "render.samples=256")
VARIANTS: dict[str, tuple[str, ...]] = {
    "corridor": DEEP,
    "distorted": (TRANSPORT,),
    "doublet": SAMPLES,
    "doublet119": (),
    "machine_vision": (),
    "misaligned": TILE,
    "photo": ("target.shape=[47, 47]", "estimator.method=tiles", TRANSPORT),
    "planoconvex": ("render.samples=8192", "calibration.samples=16384", "noise.variance=1e-2"),
    "planoconvex119": (*PERSON, "target.shape=[35, 35]", "noise.variance=1e-3"),  # a first image of entries
    "sensor": (*TILE, "calibration.samples=4096"),
    "sensor119": (),
    "single": ("target.shape=[29, 29]", TRANSPORT),
    "still_life": DEEP,
    "tile19": (TRANSPORT,),
    "tile35": (TRANSPORT,),
    "tile41": (TRANSPORT,),
}
LARGE = ("doublet119", "machine_vision", "planoconvex119", "sensor119")
CROP = (*PERSON, "target.shape=[13, 13]", "calibration.method=ideal", "render.samples=64")


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(slow(name, VARIANTS[name], id=name) for name in gallery_names()),
        *(pytest.param(name, CROP, id=f"{name}, a crop") for name in gallery_names() if name in LARGE),
    ],
)
def test_scenes_of_the_gallery_have_their_stated_verdict(name: str, changes: tuple[str, ...], tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    described = read(Path(name), changes)
    camera = derive(described)
    setup = Setup(described, camera)
    truth = load(described) if described.world is None else cached_truth(tmp_path / "truth.exr", setup)
    stack = render(setup)
    verdict = restore(stack, calibrate(setup, stopping_rule=for_stack(stack)), truth.ravel()).verdict
    assert verdict.trusted == (not_none(described.expect) == "trusted"), verdict.reasons
    if described.world is not None:
        assert "before or behind the target's plane" in verdict.reasons[0]


def test_the_stated_verdict_is_no_part_of_a_result() -> None:
    """With another one, nothing of a run has to be made again."""
    plain = scene().plain()
    stated = with_changes(plain, Path("a.toml"), ['expect="not trusted: a reason"'], ())
    assert stated.expect == "not trusted: a reason"
    assert stated.plain() == plain
