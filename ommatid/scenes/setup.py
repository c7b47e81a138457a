"""A scene with its camera and its image, and the quantities derived from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import naming_source

from .camera import Camera, derive
from .formats import picture
from .optics.negligible import SkippedEffect, skipped_effects, without_negligible_effects
from .scene import Scene, resolved


@dataclass(frozen=True, eq=False)
class Setup:
    """A scene and its camera; derived quantities are computed when they are first used, and once.

    given_image : used instead of the picture that the scene names, of the same shape; None: load that one
    coarse_shape : rows and columns of f, where `camera` is on another grid; None: those of `camera`
    """

    scene: Scene
    camera: Camera
    given_image: FloatArray | None = None
    coarse_shape: tuple[int, int] | None = None

    @classmethod
    def from_scene(cls, scene: Scene) -> Setup:
        """Derive the camera of a scene. Raises InputError, which names the scene file."""
        with naming_source(scene.source, scene.changes):
            return cls(scene, derive(scene))

    @cached_property
    def picture(self) -> FloatArray:
        """Picture on the target, on the world's grid. Raises InputError if the scene's picture cannot be loaded."""
        return picture.load(self.scene) if self.given_image is None else self.given_image

    @cached_property
    def image(self) -> FloatArray:
        """Image on the target, (rows, columns), on the camera's grid. Raises InputError as `picture` does."""
        return picture.averaged(self.picture, self.picture.shape[0] // self.camera.rows)

    @cached_property
    def world(self) -> Setup:
        """The setup on the grid of the world, which is rendered."""
        return self if self.camera.detail == 1 else self._on_grid(self.camera.world)

    @cached_property
    def calibrated(self) -> Setup:
        """The setup on the grid of H's columns, which is calibrated."""
        return self if self.camera.detail == 1 else self._on_grid(self.camera.with_grid_of_matrix)

    def _on_grid(self, camera: Camera) -> Setup:
        return Setup(self.scene, camera, self.given_image, self.camera.shape)

    @cached_property
    def _reduced(self) -> tuple[Camera, tuple[SkippedEffect, ...]]:
        return without_negligible_effects(self.scene, self.camera)

    @property
    def simulated(self) -> Camera:
        """The camera that is rendered, without negligible effects."""
        return self._reduced[0]

    @cached_property
    def skipped(self) -> tuple[SkippedEffect, ...]:
        """Effects that this scene does not need, each with the reason and a bound on the change."""
        return skipped_effects(self.scene, self.camera)

    @cached_property
    def resolved(self) -> Scene:
        """The scene as a run's folder stores it, with truth.exr as its picture."""
        return resolved(self.scene, self.coarse_shape or self.camera.shape)

    @property
    def is_applied(self) -> bool:
        """True if boxes and kernels apply the estimator's H: it is ideal, or may follow from views and kernels."""
        camera, calibration = self.camera, self.scene.calibration
        if calibration.method != "ideal" and not camera.has_box_footprints:
            steered = any(lens_type.steered for lens_type in camera.types)
            if calibration.fit == "geometry" or camera.tolerance is not None or steered:
                return False
        return (calibration.method == "ideal" or calibration.fit != "none") and camera.is_applied

    @property
    def renders_points(self) -> bool:
        """True if point sources are rendered to calibrate H: of pinholes, all other lenses take the same rays.

        Point sources behind those need as many renderings as the widest footprint has pixels.
        """
        return self.scene.calibration.method == "points" and self.calibrated.simulated.is_ideal_pinhole

    @property
    def has_closed_form(self) -> bool:
        """True if H of the simulated camera with its misalignments has a closed form."""
        camera = self.simulated
        if not camera.walls:
            return False
        for lens_type in camera.types:
            if (lens_type.optics.distortion is not None or lens_type.is_rotated) and camera.is_blurred(lens_type):
                return False
        return camera.tolerance is None or camera.has_sharp_footprints
