"""Larger cameras for the tests, their recordings of an image, and the dense solution for comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.reconstruct.frame.bands import bands_of
from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.model import Model, designed_observation
from ommatid.scenes.observation import Observation
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from .examples import Lenses, not_none, scene, with_keys

FITTED: Lenses = (("1/3", [3, 3], "fit"), ("1/5", [5, 5], "fit"), ("1/4", [4, 4], "fit"))
P0 = 5461.25


def wide(shape: tuple[int, int], lenses: Lenses = FITTED, **tables: Any) -> Scene:
    """A scene with a lens pitch that leaves room for large sub-images."""
    return with_keys(scene(shape, lenses, **tables), camera={"lens_pitch": 50.0})


def frame_camera(shape: tuple[int, int], lenses: Lenses = FITTED) -> Camera:
    """The camera of such a scene."""
    return derive(wide(shape, lenses))


def with_apertures(described: Scene, aperture: float = 1.0) -> Scene:
    """The same scene with thin lenses of an aperture in mm, which diffract."""
    lenses = [lens.model_copy(update={"aperture": aperture}) for lens in described.camera.lens]
    return with_keys(described, camera={"lens": tuple(lenses)})


def diffracting(shape: tuple[int, int], lenses: Lenses = FITTED, aperture: float = 1.0) -> Camera:
    """A camera of thin lenses in focus, which diffract."""
    return derive(with_apertures(wide(shape, lenses), aperture))


def observed(camera: Camera) -> Observation:
    """H as designed, by boxes and kernels."""
    return not_none(designed_observation(camera))


def assert_acts_as(observation: Observation, matrix: Any, atol: float = 1e-13) -> None:
    """Forwards, backwards and by its entries an observation is this matrix."""
    rng = np.random.default_rng(0)
    image, readings = rng.normal(size=observation.unknowns), rng.normal(size=observation.measurements)
    np.testing.assert_allclose(observation.forward(image), matrix @ image, atol=atol)
    np.testing.assert_allclose(observation.adjoint(readings), matrix.T @ readings, atol=atol)
    assert abs(observation.to_sparse() - matrix).max() < atol


def assert_window(observation: Observation, matrix: Any, rows: slice, columns: slice) -> list[int]:
    """Measurements inside a window have no light beside it, and in it the entries of this matrix; returns them."""
    inside, part = observation.measurements_inside(rows, columns), np.zeros(observation.shape, dtype=np.bool_)
    part[rows, columns] = True
    entries = sparse.csc_array(sparse.csr_array(matrix)[inside])
    assert abs(observation.submatrix(rows, columns) - entries[:, part.ravel()]).sum() < 1e-9
    assert abs(entries[:, ~part.ravel()]).sum() < 1e-9
    return sorted(inside.tolist())


def frame_system(
    camera: Camera, weights: FloatArray, prior: float | FloatArray = P0, observation: Observation | None = None
) -> FrameSystem:
    """K of a frame and its preconditioner; prior : variance of independent pixels, or a spectrum of this shape."""
    seen, precision = observation or observed(camera), 1 / prior
    spectrum = np.broadcast_to(prior, camera.shape)
    bands = bands_of(camera, 1, spectrum, weights, seen)
    return FrameSystem(seen, weights, precision, bands, tuple(camera.type_slices()))


def precision(matrix: sparse.csr_array, weights: FloatArray, prior: float) -> FloatArray:
    """K = H^T Rv^-1 H + 1 / P0 as a dense matrix: (N, N)."""
    return (matrix.T @ (matrix.multiply(weights[:, None]))).toarray() + prior * np.eye(matrix.shape[1])


def drawn(shape: tuple[int, int], seed: int = 0) -> FloatArray:
    """An image of independent pixels drawn from the prior: (N,)."""
    return 127.5 + np.random.default_rng(seed).normal(0, P0**0.5, shape[0] * shape[1])


def recorded(
    described: Scene, truth: FloatArray, variance: float | FloatArray, seed: int = 0, matrix: Any = None
) -> Stack:
    """The stack of an ideal camera, or of one with another H, with noise of a seed and no rendering variance."""
    camera = derive(described)
    rng = np.random.default_rng(seed)
    light = (ideal_matrix(camera) if matrix is None else matrix) @ truth
    values = light + rng.normal(size=light.size) * np.sqrt(variance)
    return Stack(described, camera, values, np.zeros(light.size), {"seed": seed, "first_seed": seed})


def assert_methods_agree(described: Callable[[str], Scene], methods: Sequence[str], tolerance: float) -> None:
    """Estimates and error bars by each method are those of the dense one; described : the scene with a method.

    Tiles take the level for known, and so do all.
    """

    def estimated(method: str) -> tuple[FloatArray, FloatArray]:
        chosen = with_keys(described(method), prior={"level": "known"})
        camera = derive(chosen)
        image = 127.5 + np.random.default_rng(0).normal(0, 70, camera.unknowns)
        done = restore(recorded(chosen, image, 1e-2), ideal_model(chosen, camera), image)
        return done.estimate, done.expected.variance

    dense, variance = estimated("auto")
    for method in methods:
        image, error = estimated(method)
        np.testing.assert_allclose(error, variance, rtol=1e-4)
        np.testing.assert_allclose(image, dense, atol=tolerance)


def blurred(described: Scene, spread: float, seed: int = 5) -> tuple[Model, sparse.csr_array]:
    """A model with errors of standard deviation `spread` that cancel in the sum of each row, and the true H."""
    camera = derive(described)
    true = ideal_matrix(camera)
    model = ideal_model(described, camera)
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.arange(true.shape[0]), np.diff(true.indptr))
    noise = rng.normal(0, spread, true.nnz)
    noise -= (np.bincount(rows, noise) / np.diff(true.indptr))[rows]
    noisy = sparse.csr_array((true.data + noise, true.indices, true.indptr), shape=true.shape)
    record = {"method": "points", "versions": {}}
    return replace(model, stored=noisy, variance=np.full(true.nnz, spread**2), record=record), true
