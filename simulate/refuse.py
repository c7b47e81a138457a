"""What cannot be rendered or calibrated here, said before anything is: lenses, backends, and how they go together."""

from __future__ import annotations

from math import ceil

from scenes.camera import Camera
from scenes.errors import naming
from scenes.lens_type import LensType
from scenes.memory import refuse_beyond
from scenes.needs import needed
from scenes.scene import Scene

from .goal import refuse_no_goal
from .variant import choose, refuse_slow, refuse_slow_transport

SENSOR, TARGET = 12 * 8, 6 * 8  # bytes a measurement and a pixel of f that a rendering takes
ENTRY = 12 + 8 + 8 * 4  # bytes an entry of H: itself, its variance, its batches
SWEPT = 3 * 8 + 8 * 4 + 10 * 8  # bytes a reading of a sensor pixel: tallies, batches, and sorting into entries
BESIDE = 2  # pixels of f around a footprint


def refuse(scene: Scene, camera: Camera, calibrates: bool = True) -> None:
    """Raise InputError, which names the scene file, for what would fail only after some work.

    calibrates : whether H is to be found, not the light alone
    """
    with naming(scene.source):
        refuse_memory(scene, camera, calibrates)
        variant = choose(scene.render.variant)
        refuse_lenses(camera)
        refuse_slow(needed(scene, camera)[0], variant)
        if scene.render.samples == "auto":
            refuse_no_goal(scene)
        if calibrates and scene.calibration.method == "transport":
            refuse_slow_transport(variant)


def refuse_memory(scene: Scene, camera: Camera, calibrates: bool = True) -> None:
    """Raise InputError where memory does not hold a rendering or, if it `calibrates`, H with its uncertainty."""
    rendering = SENSOR * camera.measurements + TARGET * camera.unknowns
    refuse_beyond(rendering, "rendering", "make target.shape or the lens arrays smaller")
    if not calibrates or (scene.calibration.method == "ideal" and camera.boxed):
        return
    seen = [kind.measurements * min(_seen(camera, kind), camera.unknowns) for kind in camera.types]
    needed = ENTRY * sum(seen) + (SWEPT * max(seen) if scene.calibration.method == "points" else 0)
    refuse_beyond(needed, f"H of {camera.measurements} x {camera.unknowns}", "crop the target or use fewer sub-imagers")


def _seen(camera: Camera, kind: LensType) -> int:
    """Pixels of f that a sensor pixel may see, about."""
    across = ceil(kind.ratio) + BESIDE
    if kind.glass.surfaces is None and camera.blurs(kind):
        from scenes.blur import blur_of

        across += 2 * ceil(blur_of(camera, kind).reach)
    return across**2


def refuse_lenses(camera: Camera) -> None:
    """Raise InputError for surfaces that show no image, and for distortion that folds the image."""
    for kind in camera.types:
        if kind.glass.surfaces is not None:
            from scenes.prescription import prescription_of

            prescription_of(camera, kind)
        if kind.glass.distortion is not None:
            from scenes.distortion import field
            from scenes.pose import poses

            for sub, pose in zip(camera.sub_imagers, poses(camera), strict=True):
                if sub.type == kind:
                    field(camera, sub, pose)
