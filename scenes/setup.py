"""A scene together with the camera and the picture that it describes, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ommatid.runtime.arrays import FloatArray

from .camera import Camera, derive
from .formats import picture
from .optics.negligible import SkippedEffect, without_negligible_effects
from .scene import Scene, resolved
from .skipped import skipped_effects


@dataclass(frozen=True)
class Setup:
    """A scene, its camera and the picture on its target, (rows, columns), None where no stage needs the picture.

    Derived quantities are computed when they are first asked for, and once.
    """

    scene: Scene
    camera: Camera
    image: FloatArray | None = None

    @classmethod
    def from_scene(cls, scene: Scene, *, with_image: bool = True) -> Setup:
        """Derive the camera and load the picture. Raises InputError, which names the scene file."""
        camera = derive(scene)  # first: it is cheap, and refuses most of what is wrong
        return cls(scene, camera, picture.load(scene) if with_image else None)

    @cached_property
    def _reduced(self) -> tuple[Camera, tuple[SkippedEffect, ...]]:
        return without_negligible_effects(self.scene, self.camera)

    @property
    def simulated(self) -> Camera:
        """The camera without the effects that are too small to matter: the one that is rendered."""
        return self._reduced[0]

    @cached_property
    def skipped(self) -> tuple[SkippedEffect, ...]:
        """Effects that this scene does not need, each with the reason and the size of the change."""
        return skipped_effects(self.scene, self.camera)

    @cached_property
    def resolved(self) -> Scene:
        """The scene as a run's folder holds it, which names truth.exr as its picture."""
        return resolved(self.scene, self.camera.shape)

    @property
    def has_structured_matrix(self) -> bool:
        """Whether the estimator's H is ideal with box footprints, so that no matrix needs to be stored."""
        return self.scene.calibration.method == "ideal" and self.camera.has_box_footprints

    @cached_property
    def has_closed_form(self) -> bool:
        """Whether the H of the simulated camera, misaligned as it is, has a closed form."""
        camera = self.simulated
        for lens_type in camera.types:
            if lens_type.optics.surfaces is not None:
                return False
            if lens_type.optics.distortion is not None and camera.is_blurred(lens_type):
                return False
        return camera.tolerance is None or camera.has_sharp_footprints
