"""What cannot be rendered or calibrated here, said before anything is: lenses, backends, and how they go together."""

from __future__ import annotations

from scenes.camera import Camera
from scenes.errors import naming
from scenes.needs import needed
from scenes.scene import Scene

from .variant import choose, refuse_slow, refuse_slow_transport


def refuse(scene: Scene, camera: Camera, calibrates: bool = True) -> None:
    """Raise InputError, which names the scene file, for what would fail only after some work.

    calibrates : whether H is to be found, not the light alone
    """
    with naming(scene.source):
        variant = choose(scene.render.variant)
        refuse_lenses(camera)
        refuse_slow(needed(scene, camera)[0], variant)
        if calibrates and scene.calibration.method == "transport":
            refuse_slow_transport(variant)


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
