"""Electrons that the light of the target frees in each pixel, whatever the lenses are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.setup import Setup


def response(setup: Setup) -> NDArray[np.float64]:
    """For each unit of f: (M,). Raises ValueError without a [sensor], InputError where surfaces show no image."""
    scene, camera = setup.scene, setup.camera
    if all(kind.optics.surfaces is None for kind in camera.types):
        return electrons(scene, camera)
    from ..lenses.etendue import relative_illumination, solid_angles

    return electrons(scene, camera, solid_angles(camera), relative_illumination(camera))
