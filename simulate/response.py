"""Electrons that the light of the target frees in each pixel, whatever the lenses are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scenes.camera import Camera
from scenes.photons import electrons
from scenes.scene import Scene


def response(scene: Scene, camera: Camera) -> NDArray[np.float64]:
    """For each unit of f: (M,). Raises ValueError without a [sensor], InputError where surfaces show no image."""
    if all(kind.glass.surfaces is None for kind in camera.types):
        return electrons(scene, camera)
    from .etendue import relative_illumination, solid_angles

    return electrons(scene, camera, solid_angles(camera), relative_illumination(camera))
