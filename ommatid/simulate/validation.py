"""Checks, before any work is done, that a scene can be rendered and calibrated here."""

from __future__ import annotations

from ommatid.runtime.errors import naming_source
from ommatid.runtime.memory import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.setup import Setup

from .adaptive_render import check_noise_target
from .entry_memory import check_entries
from .renderer.variant import check_fast_variant, check_transport_variant, choose
from .world_view import check_world

SENSOR, TARGET = 12 * 8, 6 * 8  # bytes that a rendering takes per measurement and per pixel of f


def check_scene(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError, which names the scene file, for errors that would otherwise appear after some work.

    calibrates : True if H is to be determined as well as the light
    """
    scene = setup.scene
    with naming_source(scene.source):
        check_scene_memory(setup, calibrates)
        variant = choose(scene.render.variant)
        check_lenses(setup.camera)
        check_fast_variant(setup.world.simulated, variant)
        if scene.render.samples == "auto":
            check_noise_target(scene)
        if calibrates and scene.calibration.method == "transport":
            check_transport_variant(variant)
        if scene.world is not None:
            check_world(setup)


def check_scene_memory(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError if memory does not hold a rendering or, if it `calibrates`, H with its uncertainty."""
    scene, camera, world = setup.scene, setup.calibrated.camera, setup.world.camera
    rendering = SENSOR * camera.measurements + TARGET * world.unknowns
    check_memory(rendering, "rendering", "make target.shape or the lens arrays smaller")
    if not calibrates or setup.is_applied:
        return
    check_entries(camera, camera.types, scene.calibration.method)


def check_lenses(camera: Camera) -> None:
    """Raise InputError for surfaces that form no image, and for distortion that folds the image."""
    for lens_type in camera.types:
        if lens_type.optics.surfaces is not None:
            from .lenses.prescription import prescription_of

            prescription_of(camera, lens_type)
        if lens_type.optics.distortion is not None:
            from ommatid.scenes.optics.distortion import field
            from ommatid.scenes.pose import poses

            for sub, pose in zip(camera.sub_imagers, poses(camera), strict=True):
                if sub.type == lens_type:
                    field(camera, sub, pose)
