"""Small Mitsuba files, the scenes in front of them, and what tests compare of their renderings."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import light
from ommatid.simulate.sampling.passes import Rendering, rounding_variance

from ..examples import Lenses, assert_student
from ..examples import scene as flat_scene

if TYPE_CHECKING:
    from ommatid.simulate.renderer.lens import Distance
    from ommatid.simulate.renderer.renderer import Renderer

Z = 1000.0
FAST = "llvm_ad_mono"
LETTER = np.zeros((12, 12), dtype=bool)  # F
LETTER[2:10, 3] = LETTER[2, 3:8] = LETTER[5, 3:6] = True
THIRDS: Lenses = (("1/3", [3, 3], [3, 3]), ("1/4", [2, 2], [2, 2]))


def glow(radiance: object) -> str:
    return f'<emitter type="area"><float name="radiance" value="{radiance}"/></emitter>'


def rectangle(width: float, height: float, x: float, y: float, z: float, rest: str) -> str:
    """Return a rectangle that faces the camera; `rest` is its material."""
    return f"""<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/>
        <scale x="{width / 2}" y="{height / 2}"/><translate x="{x}" y="{y}" z="{z}"/></transform>{rest}</shape>"""


def world(
    folder: Path, content: str, lenses: Lenses = THIRDS, target: dict[str, Any] | None = None, **more: Any
) -> tuple[Scene, Camera]:
    """Return a scene of 12 x 12 pixels of 1 mm at 1 m in front of a world of this content, and its camera."""
    path = folder / "world.xml"
    path.write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    data = flat_scene((12, 12), lenses, render={"variant": more.pop("variant", FAST), "samples": 256}).plain()
    data["world"] = {"file": str(path), "white": more.pop("white", 1.0)}
    data["target"] |= target or {}
    if target is None:
        del data["target"]["image"], data["target"]["origin"]
    for name, table in more.items():
        data[name] = {**data[name], **table}
    described = parse(data, Path("test.toml"))
    return described, derive(described)


def floored(rendering: Rendering) -> Any:
    samples = rendering.record["samples"] // rendering.passes
    return np.maximum(rendering.variance, rounding_variance(rendering.mean, samples))


def assert_rendered(setup: Setup) -> Rendering:
    """Assert that rendered readings are those of the closed form, and return them."""
    rendering = light(setup)
    exact = ideal_matrix(setup.world.camera) @ setup.world.image.ravel()
    assert_student(rendering.mean - exact, floored(rendering), rendering.passes)
    return rendering


def distance_to_target(renderer: Renderer) -> Distance:
    """Return the distance of the flat target as lenses find that of a world's surfaces."""
    from ommatid.simulate.renderer.world import StagedWorld
    from ommatid.simulate.renderer.worlds.placement import MILLIMETRES_AT_ORIGIN

    scene, integrator = renderer._scene, renderer._integrator  # pyright: ignore[reportPrivateUsage]
    staged = StagedWorld(scene, integrator, MILLIMETRES_AT_ORIGIN, 0)
    return partial(staged.distance, far=2 * renderer.camera.distance)
