"""The drawing of a camera as SVG text, which pages of equal cameras share."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import lru_cache

from markupsafe import Markup

from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene

TABLES = ("target", "camera", "world", "light")  # of the scene file, which the drawing shows
KEPT = 8  # drawings


@dataclass(frozen=True)
class DrawnCamera:
    """A camera and its scene, equal to another one that is drawn alike: one with the same `key`."""

    key: str
    scene: Scene = field(compare=False)
    camera: Camera = field(compare=False)


def drawing_of(scene: Scene, camera: Camera) -> Markup:
    """Return the drawing of a camera without title and table."""
    tables = scene.plain()
    key = json.dumps({name: tables[name] for name in TABLES if name in tables}, sort_keys=True, default=str)
    return _drawn(DrawnCamera(key, scene, camera))


@lru_cache(maxsize=KEPT)
def _drawn(drawn: DrawnCamera) -> Markup:
    from ommatid.figures.camera_drawing import camera_drawing
    from ommatid.figures.saving import svg_text

    return Markup(svg_text(camera_drawing(drawn.scene, drawn.camera, described=False)))
