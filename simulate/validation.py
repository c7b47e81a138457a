"""What cannot be rendered or calibrated here, said before anything is: lenses, backends, and how they go together."""

from __future__ import annotations

from math import ceil

from ommatid.runtime.errors import naming_source
from ommatid.runtime.memory import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.setup import Setup

from .noise_target import check_noise_target
from .renderer.variant import check_fast_variant, check_transport_variant, choose

SENSOR, TARGET = 12 * 8, 6 * 8  # bytes a measurement and a pixel of f that a rendering takes
ENTRY = 12 + 8 + 8 * 4  # bytes an entry of H: itself, its variance, its batches
SWEPT = 3 * 8 + 8 * 4 + 10 * 8  # bytes a reading of a sensor pixel: tallies, batches, and sorting into entries
BESIDE = 2  # pixels of f around a footprint


def check_scene(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError, which names the scene file, for what would fail only after some work.

    calibrates : whether H is to be found, not the light alone
    """
    scene = setup.scene
    with naming_source(scene.source):
        check_scene_memory(setup, calibrates)
        variant = choose(scene.render.variant)
        check_lenses(setup.camera)
        check_fast_variant(setup.simulated, variant)
        if scene.render.samples == "auto":
            check_noise_target(scene)
        if calibrates and scene.calibration.method == "transport":
            check_transport_variant(variant)


def check_scene_memory(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError where memory does not hold a rendering or, if it `calibrates`, H with its uncertainty."""
    scene, camera = setup.scene, setup.camera
    rendering = SENSOR * camera.measurements + TARGET * camera.unknowns
    check_memory(rendering, "rendering", "make target.shape or the lens arrays smaller")
    if not calibrates or setup.has_structured_matrix:
        return
    seen = [kind.measurements * min(_seen(camera, kind), camera.unknowns) for kind in camera.types]
    needed = ENTRY * sum(seen) + (SWEPT * max(seen) if scene.calibration.method == "points" else 0)
    check_memory(needed, f"H of {camera.measurements} x {camera.unknowns}", "crop the target or use fewer sub-imagers")


def _seen(camera: Camera, kind: LensType) -> int:
    """Pixels of f that a sensor pixel may see, about."""
    across = ceil(kind.ratio) + BESIDE
    if kind.optics.surfaces is None and camera.is_blurred(kind):
        from ommatid.scenes.optics.blur import blur_of

        across += 2 * ceil(blur_of(camera, kind).reach)
    return across**2


def check_lenses(camera: Camera) -> None:
    """Raise InputError for surfaces that show no image, and for distortion that folds the image."""
    for kind in camera.types:
        if kind.optics.surfaces is not None:
            from .lenses.prescription import prescription_of

            prescription_of(camera, kind)
        if kind.optics.distortion is not None:
            from ommatid.scenes.optics.distortion import field
            from ommatid.scenes.pose import poses

            for sub, pose in zip(camera.sub_imagers, poses(camera), strict=True):
                if sub.type == kind:
                    field(camera, sub, pose)
