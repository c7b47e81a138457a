"""H of a world finer than f as the estimator takes it: on the world's grid, or on f's for a world made of f's pixels.

Let the world w be finer than f = A w. With correlated pixels the unknowns are those of the world, whose averages are
the estimate. Independent pixels say nothing of detail that f does not hold: the world is then made of f's pixels, each
repeated, w = R f, and the measurements are Hf R f + v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.fitted.fitted_matrix import Directions
from ommatid.scenes.model import Model
from ommatid.scenes.observation import Observation
from ommatid.scenes.observation import repetition as repeated
from ommatid.scenes.tables.estimation import PriorTable

from .prior import averaged_spectrum

CAUSE = "detail"  # in the error budget


@dataclass(frozen=True)
class CoarseModel(Model):
    """Hf R as `matrix`, on f's grid.

    fine : the model on the world's grid;  repetition : R, (pixels of the world, N)
    coarse : Hf R by boxes and kernels where it has no entries
    """

    fine: Model
    repetition: sparse.csr_array
    coarse: Observation | None = None

    @property
    def is_exact(self) -> bool:
        """False: Hf R has no box footprints."""
        return False

    @cached_property
    def structure(self) -> Observation | None:
        """Hf R by boxes and kernels where it has no entries."""
        return self.coarse

    def variance_from_model(self, image: FloatArray, noise: Sequence[FloatArray] = ()) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement of `image`: (M,)."""
        return self.fine.variance_from_model(self.repetition @ image, [self.repetition @ each for each in noise])

    def prior_variance_from_model(self, prior_variance: FloatArray, prior_mean: float = 0.0) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement under the prior: (M,)."""
        return self.fine.prior_variance_from_model(self.repetition @ prior_variance, prior_mean)

    def errors(self, image: FloatArray) -> Directions | None:
        """Return what errors of few numbers of H add to the measurements of f, (N,), or of a world."""
        return self.fine.errors(image if image.size == self.fine.unknowns else self.repetition @ image)

    @property
    def has_error_halves(self) -> bool:
        """True if each half of the batches of H has a variance of its own."""
        return self.fine.has_error_halves

    @property
    def error_halves(self) -> tuple[list[sparse.csr_array], list[sparse.csr_array]]:
        """Errors of Hf R by either half of the batches, (M, N) each."""
        first, second = (
            [sparse.csr_array(error @ self.repetition) for error in errors] for errors in self.fine.error_halves
        )
        return first, second


def model_of_f(model: Model, camera: Camera, prior: PriorTable) -> Model:
    """Return the model that the estimator takes, from one whose H may be on the grid of a world finer than f.

    camera : of the stack, on f's grid;  prior : "fit" counts as correlated pixels
    """
    if not camera.has_detail:
        return model if camera.detail == model.camera.detail else replace(model, camera=camera)
    return _made_of_pixels(model, camera) if prior.kind == "independent" else model


def _made_of_pixels(model: Model, camera: Camera) -> CoarseModel:
    """Return the model of a world that is made of f's pixels."""
    expansion = repetition(camera.shape, camera.detail)
    coarse: Observation | None = model.observation.coarser(camera, camera.detail)
    stored = None
    if model.stored is not None or camera.unknowns <= MOST_DENSE:
        stored, coarse = coarse.to_sparse(), None
    count = 0 if stored is None else int(stored.nnz)
    variance = np.zeros(count)
    if stored is not None and model.variance.any():
        variance = _entry_variance(model, stored, expansion)
    return CoarseModel(
        scene=model.scene,
        camera=camera,
        stored=stored,
        variance=variance,
        batches=np.zeros((0, count), np.float32),
        record=model.record,
        fine=model,
        repetition=expansion,
        coarse=coarse,
    )


def _entry_variance(model: Model, matrix: sparse.csr_array, expansion: sparse.csr_array) -> FloatArray:
    """Return the variance of every entry of Hf R, (nnz,), as if the errors of H's entries were independent."""
    fine = model.matrix
    variance = sparse.csr_array((model.variance, fine.indices, fine.indptr), shape=fine.shape) @ expansion
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(sparse.csr_array(variance)[rows, matrix.indices], dtype=np.float64).ravel()


def repetition(shape: tuple[int, int], detail: int) -> sparse.csr_array:
    """Return R, the world made of f's pixels, each repeated detail x detail times: (pixels of the world, N)."""
    return sparse.csr_array(sparse.kron(*(repeated(size, detail) for size in shape), format="csr"))


def world_of(image: FloatArray, spectrum: FloatArray, detail: int) -> FloatArray:
    """Return the likeliest world less its mean, P A^T (A P A^T)^-1 f, of an image, (rows, columns), less its mean.

    spectrum : of the world's prior covariance P under the DCT-II
    """
    waves = np.asarray(fft.dctn(image, 2, norm="ortho")) / averaged_spectrum(spectrum, detail)
    averages = np.kron(np.asarray(fft.idctn(waves, 2, norm="ortho")), np.full((detail, detail), detail**-2.0))
    spread = np.asarray(fft.dctn(averages, 2, norm="ortho")) * spectrum
    return np.asarray(fft.idctn(spread, 2, norm="ortho")).ravel()
