"""The results of commands that write no file: a scene's plan, the backends."""

from __future__ import annotations

import os
from typing import Any

from ommatid.analysis import summary
from ommatid.analysis.predict import electrons, optics
from ommatid.reconstruct.method_choice import choose_method
from ommatid.runtime.errors import naming_source
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import ThroughFocus
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.renderer import variant
from ommatid.simulate.world_view import check_world


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe the geometry and the plan of a scene in JSON's types. Raises InputError that names the scene file."""
    setup = Setup.from_scene(scene)
    choice = choose_method(scene, setup.camera, setup.is_applied)
    with naming_source(scene.source):
        lens_optics, light = optics(setup.camera), electrons(setup)
        world = {} if scene.world is None else {"world": check_world(setup).describe()}
    return summary.describe(setup, variant.choose(scene.render.variant), choice, lens_optics, light) | world


def focus_curves(scene: Scene) -> list[ThroughFocus]:
    """Return the contrast of lens types through focus. Raises InputError that names the scene file."""
    camera = derive(scene)
    if not camera.has_width:
        return []
    from ommatid.scenes.optics.sharpness import through_focus

    with naming_source(scene.source):
        return through_focus(camera)


def describe_backends() -> dict[str, Any]:
    """Render a small image on each backend in a separate process, and describe the backends in JSON's types."""
    probes = [variant.probe(name) for name in variant.PREFERENCE]
    backends = [
        {"variant": status.variant, "reason": status.reason, "samples_per_second": status.speed} for status in probes
    ]
    return {
        "backends": backends,
        "advice": variant.diagnosis(probes),
        "versions": versions("mitsuba", "drjit", "OpenEXR", "scipy", "scikit-image"),
        "cores": os.cpu_count(),
    }
