"""H in closed form: the share of a sensor pixel's footprint that each pixel of f covers.

Through a pinhole a footprint is a rectangle of m x m pixels of f, so H is a Kronecker product of two overlaps along one
axis for every sub-imager (Wood et al., section 2). Distorted and misaligned footprints follow by exact area overlap,
those of lenses from their waves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, views_as_designed
from ommatid.scenes.fitted.kernel_shapes import KernelShapes
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.model import Model, designed_observation, fitted_model, is_stored
from ommatid.scenes.optics.boxes import designed_box
from ommatid.scenes.pose import pose_of, poses
from ommatid.scenes.scene import Scene


def ideal_matrix(camera: Camera) -> sparse.csr_array:
    """Return H of all sub-imagers as designed: (M, N).

    Raises InputError for a lens type that is blurred and distorted or rotated, and for a camera without walls, which
    have no closed form, and for surfaces that form no image.
    """
    if not camera.walls:
        raise InputError(
            "camera.walls = false: light through several lenses has no closed form; run with calibration.method"
            " 'transport', or keep the walls"
        )
    grids = camera.on_grids
    return sparse.csr_array(sparse.vstack([_type_matrix(grids, lens) for lens in grids.types], format="csr"))


def _type_matrix(camera: Camera, lens_type: LensType) -> sparse.csr_array:
    if lens_type.optics.distortion is not None or lens_type.is_rotated:
        from ommatid.scenes.optics import footprints

        if camera.is_blurred(lens_type):
            raise InputError(
                f"camera.lens.{lens_type.name}: distortion or a rotated sub-imager with defocus, diffraction or"
                " pixel_blur has no closed form; run with calibration.method 'transport', or remove one of them"
            )
        subs = [sub for sub in camera.sub_imagers if sub.type == lens_type]
        parts = [footprints.sub_matrix(camera, sub, pose_of(sub)) for sub in subs]
        return sparse.csr_array(sparse.vstack(parts, format="csr"))
    if not camera.is_blurred(lens_type):
        return designed_box(camera.shape, lens_type).to_sparse()
    from ommatid.scenes.optics.lens_kernels import blurred_matrix

    return blurred_matrix(camera, lens_type)


def true_matrix(camera: Camera) -> sparse.csr_array:
    """Return H of all sub-imagers misaligned as the camera's tolerance draws them: (M, N).

    Raises InputError for blurred lenses, whose misaligned H has no closed form.
    """
    if camera.tolerance is None:
        return ideal_matrix(camera)
    if not camera.has_sharp_footprints:
        raise InputError(
            "misaligned lenses with surfaces, defocus, diffraction or pixel_blur have no closed form; calibrate them"
        )
    from ommatid.scenes.optics import footprints

    return footprints.matrix(camera, poses(camera))


def ideal_model(scene: Scene, camera: Camera) -> Model:
    """Return the ideal H as a model without uncertainty; by boxes and kernels it is stored only while it is small.

    Raises InputError for a large H of surfaces that kernels do not hold, nor memory.
    """
    if not (camera.has_surfaces and camera.is_applied):
        stored = is_stored(designed_observation(camera))
        return exact_model(scene, camera, ideal_matrix(camera) if stored else None, "ideal")
    try:
        return fitted_model(scene, camera, _designed_by_kernels(camera), None, {"method": "ideal"})
    except InputError as obstacle:
        try:
            return exact_model(scene, camera, ideal_matrix(camera), "ideal")
        except InputError as error:
            raise InputError(f"{obstacle}; {error}") from error


def true_model(scene: Scene, camera: Camera) -> Model:
    """Return H of all sub-imagers misaligned as the camera's tolerance draws them. Raises as `true_matrix` does."""
    if camera.tolerance is None and camera.unknowns > MOST_DENSE:
        return ideal_model(scene, camera)
    return exact_model(scene, camera, true_matrix(camera), "true")


def designed_kernels(camera: Camera, lens_type: LensType) -> KernelFootprints:
    """Return H of a blurred lens type as designed by kernels that a file holds.

    Expects a lens type for which `Camera.has_kernel` is true. Raises InputError if kernels do not hold it.
    """
    if lens_type.steered:
        raise InputError(f"camera.lens.{lens_type.name}: sub-imagers off the grid have kernels of their own")
    from ommatid.scenes.optics.lens_kernels import kernels

    exact = kernels(camera, lens_type)
    return replace(exact, shapes=KernelShapes.low_rank(exact.shapes.kernels, exact.places.width))


def _designed_by_kernels(camera: Camera) -> FittedMatrix:
    by_type = ((lens, [sub for sub in camera.sub_imagers if sub.type == lens]) for lens in camera.types)
    views = {lens.name: views_as_designed(subs) for lens, subs in by_type}
    blurred = (lens_type for lens_type in camera.types if not camera.has_boxes(lens_type))
    return FittedMatrix(camera, views, {each.name: designed_kernels(camera, each) for each in blurred})


def exact_model(scene: Scene, camera: Camera, matrix: sparse.csr_array | None, method: str) -> Model:
    """Return a model without uncertainty."""
    entries = 0 if matrix is None else int(matrix.nnz)
    batches: Float32Array = np.zeros((0, entries), dtype=np.float32)
    return Model(scene, camera, matrix, np.zeros(entries), batches, {"method": method})
