"""Electrons that the light of the target frees in each pixel, for every kind of lens."""

from __future__ import annotations

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.setup import Setup


def response(setup: Setup) -> FloatArray:
    """Return the electrons per unit of f, (M,).

    Raises ValueError without a [sensor], InputError for a lens whose surfaces form no image.
    """
    scene, camera = setup.scene, setup.camera
    if all(lens_type.optics.surfaces is None for lens_type in camera.types):
        return electrons(scene, camera)
    from ..lenses.etendue import relative_illumination, solid_angles, transmissions

    passed = transmissions(camera)
    transmitted = {name: angle * passed[name] for name, angle in solid_angles(camera).items()}
    return electrons(scene, camera, transmitted, relative_illumination(camera))
