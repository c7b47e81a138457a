"""H on the world's grid as a model of f: the best linear description of the measurements by f's pixels.

Let the world w have mean w0 and covariance P on a grid F times finer than f, f = A w, and g = Hf w + v. Then

    g = G f + (Hf w0 - G f0) + e + v,   G = Hf P A^T (A P A^T)^-1,   cov e = Hf P Hf^T - G (A P A^T) G^T,

where e, the detail that f does not hold, is not correlated with f: Eq. 4 and 5 of Wood et al. with G in place of H and
Rv + cov e in place of Rv give the best linear estimate of f. A prior of independent pixels says nothing of detail: the
world is then taken as made of f's pixels, and e is zero.

Where these moments are too large, the world itself is estimated as a frame, and f as its averages.

The dense method of few pixels takes the covariance of detail as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.fitted.fitted_matrix import Directions
from ommatid.scenes.model import Model
from ommatid.scenes.observation import Observation
from ommatid.scenes.tables.estimation import PriorTable

from ..expected_error import CorrelatedNoise, Interval, interval, squared_error
from ..methods.dense_method import DRAWS, DenseMethod, residuals
from ..methods.method import total_variance
from ..problem import Whitening
from ..verdict.residual import ResidualInputs, ResidualPower
from .world_prior import WorldPrior, averaging, repetition

NEEDS_NOISE = (
    "detail finer than f needs noise in every measurement, got some without; set noise.variance or"
    " estimator.noise_variance to a number above 0, or target.detail to 1"
)
MAX_WORLD = 32_000  # pixels of the world, and
MAX_MEASUREMENTS = 1_500  # measurements, up to which the exact moments take seconds
CAUSE = "detail"  # in the error budget
WORLDS = 4  # random worlds by which the uncertainty of H acts on detail


@dataclass(frozen=True)
class DetailedModel(Model):
    """G as `matrix`, on f's grid, with the moments of the detail that f does not hold.

    fine : the model on the world's grid;  interpolation : B, (pixels of the world, N);  prior_mean : of every pixel
    offset : (M,) Hf w0 - G f0
    unresolved : variance of every pixel of the world given f, (pixels of the world,);  world : its prior, or None
    detail_covariance : cov e, (M, M), None where the world is made of f's pixels
    coarse : G by boxes and kernels where it has no entries
    """

    fine: Model
    interpolation: sparse.csr_array | FloatArray
    prior_mean: float
    offset: FloatArray
    unresolved: FloatArray
    world: WorldPrior | None
    detail_covariance: FloatArray | None
    coarse: Observation | None = None

    @property
    def is_exact(self) -> bool:
        """False: G has no box footprints."""
        return False

    @property
    def detail_variance(self) -> FloatArray:
        """The diagonal of cov e: (M,)."""
        covariance = self.detail_covariance
        return np.zeros(self.measurements) if covariance is None else np.maximum(np.diagonal(covariance), 0.0)

    @cached_property
    def structure(self) -> Observation | None:
        """G by boxes and kernels where it has no entries."""
        return self.coarse

    def light(self, image: FloatArray) -> FloatArray:
        """Return the expected light on every sensor pixel given f: (N,) to (M,)."""
        return self.forward(image) + self.offset

    def world_given(self, image: FloatArray) -> FloatArray:
        """Return the expected world given f: (N,) to (pixels of the world,)."""
        return self.prior_mean + self.interpolation @ (np.asarray(image).ravel() - self.prior_mean)

    def variance_from_model(self, image: FloatArray, noise: Sequence[FloatArray] = ()) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement of `image` and of the detail it leaves open."""
        worlds = [self.interpolation @ image for image in noise]
        return self.fine.variance_from_model(self.world_given(image), worlds) + self._variance_from_detail

    @cached_property
    def _variance_from_detail(self) -> FloatArray:
        """Variance that the uncertainty of H adds for the detail that f leaves open: (M,).

        Errors of neighbouring entries cancel where detail is smooth; random detail of the prior shows by how much.
        """
        variance = self.fine.prior_variance_from_model(self.unresolved)
        total = float(variance.sum())
        if self.world is None or len(self.fine.batches) < 2 or not total:
            return variance
        rng, scatter, power = probe(Purpose.DETAIL_SCATTER), 0.0, 0.0
        average = averaging(self.camera.shape, self.camera.detail)
        for _ in range(WORLDS):
            world = self.world.draw(rng)
            detail = world - self.interpolation @ (average @ world)
            scatter += float(self.fine.scatter(detail).sum())
            power += float(detail @ detail)
        return variance * (scatter / power * float(self.unresolved.sum()) / total)

    def prior_variance_from_model(self, prior_variance: FloatArray, prior_mean: float = 0.0) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement under the prior: (M,)."""
        world = repetition(self.camera.shape, self.camera.detail) @ prior_variance
        return self.fine.prior_variance_from_model(world, prior_mean)

    def errors(self, image: FloatArray) -> Directions | None:
        """Return what errors of few numbers of H add to the measurements of f."""
        return self.fine.errors(self._world_with_detail(image))

    def _world_with_detail(self, image: FloatArray) -> FloatArray:
        """Return a world, (pixels of the world,), that averages to f, (N,), with random detail of the prior.

        Errors of few numbers act on the detail that f leaves open, too. A world stays as it is.
        """
        if image.size == self.fine.unknowns:
            return image
        return self.world_given(image) + self._random_detail

    @cached_property
    def _random_detail(self) -> FloatArray:
        """A draw of what the prior leaves open given f: (pixels of the world,)."""
        if self.world is None:
            return np.zeros(self.fine.unknowns)
        world = self.world.draw(probe(Purpose.DETAIL))
        return world - self.interpolation @ (averaging(self.camera.shape, self.camera.detail) @ world)

    @property
    def has_error_halves(self) -> bool:
        """True if each half of the batches of H has a variance of its own."""
        return self.fine.has_error_halves

    @property
    def error_halves(self) -> tuple[list[sparse.csr_array], list[sparse.csr_array]]:
        """Errors of G by either half of the batches, (M, N) each."""
        first, second = (
            [sparse.csr_array(error @ self.interpolation) for error in errors] for errors in self.fine.error_halves
        )
        return first, second


def detailed(model: Model) -> DetailedModel:
    """Return a model whose world is known to be finer than f as what it is. Raises TypeError for others."""
    if not isinstance(model, DetailedModel):
        raise TypeError("expected a model of a world finer than f")
    return model


def detail_memory(camera: Camera) -> int:
    """Return the bytes of the exact moments: B, P A^T and P Hf^T, R_detail, its sum with the noise, and its factor."""
    world, measurements = camera.world.unknowns, camera.measurements
    return 8 * (world * (2 * camera.unknowns + measurements) + 4 * measurements**2)


def model_of_f(model: Model, camera: Camera, prior: PriorTable) -> Model:
    """Return the model of f from one whose H may be on the grid of a world finer than f.

    Where the exact moments are too large, it is the model itself: the unknowns are then those of the world.

    camera : of the stack, on f's grid;  prior : "fit" counts as independent pixels
    """
    if not camera.has_detail:
        return model if camera.detail == model.camera.detail else replace(model, camera=camera)
    if prior.kind == "independent":
        return _without_detail(model, camera, prior.mean)
    return _exact(model, camera, prior) if has_moments(camera) else model


def has_moments(camera: Camera) -> bool:
    """Return True if the moments of a world finer than f are computed as matrices."""
    return camera.world.unknowns <= MAX_WORLD and camera.measurements <= MAX_MEASUREMENTS


def _without_detail(model: Model, camera: Camera, mean: float) -> DetailedModel:
    """Return the model of a world that is made of f's pixels."""
    expansion = repetition(camera.shape, camera.detail)
    if model.stored is None:
        coarse = model.observation.coarser(camera, camera.detail)
        gain = coarse.to_sparse() if camera.unknowns <= MOST_DENSE else coarse
    else:
        gain = sparse.csr_array(model.stored @ expansion)
    return _detailed(model, camera, mean, gain, expansion, np.zeros(model.unknowns), None, None)


def _exact(model: Model, camera: Camera, prior: PriorTable) -> DetailedModel:
    """Return the best linear description of the measurements by f's pixels."""
    world = WorldPrior.of(prior, camera.shape, camera.target_pitch, camera.detail)
    fine = model.to_sparse()
    gain: FloatArray = fine @ world.interpolation
    spread = world.apply(np.asarray(fine.T.toarray(), dtype=np.float64))
    left: FloatArray = fine @ spread - gain @ (averaging(camera.shape, camera.detail) @ spread)
    matrix, covariance = sparse.csr_array(gain), (left + left.T) / 2
    return _detailed(model, camera, prior.mean, matrix, world.interpolation, world.unresolved, world, covariance)


def _detailed(
    model: Model,
    camera: Camera,
    mean: float,
    gain: sparse.csr_array | Observation,
    interpolation: sparse.csr_array | FloatArray,
    unresolved: FloatArray,
    world: WorldPrior | None,
    covariance: FloatArray | None,
) -> DetailedModel:
    coarse, matrix = (gain, None) if isinstance(gain, Observation) else (None, gain)
    of_mean = gain.forward if isinstance(gain, Observation) else gain.__matmul__
    offset = model.forward(np.full(model.unknowns, mean)) - of_mean(np.full(camera.unknowns, mean))
    count = 0 if matrix is None else int(matrix.nnz)
    variance = np.zeros(count)
    if matrix is not None and model.variance.any():
        variance = _entry_variance(model, matrix, interpolation)
    return DetailedModel(
        scene=model.scene,
        camera=camera,
        stored=matrix,
        variance=variance,
        batches=np.zeros((0, count), np.float32),
        record=model.record,
        fine=model,
        interpolation=interpolation,
        prior_mean=mean,
        offset=offset,
        unresolved=unresolved,
        world=world,
        detail_covariance=covariance,
        coarse=coarse,
    )


def _entry_variance(model: Model, matrix: sparse.csr_array, interpolation: sparse.csr_array | FloatArray) -> FloatArray:
    """Return the variance of every entry of G, (nnz,), as if the errors of H's entries were independent."""
    fine = model.matrix
    variance = sparse.csr_array((model.variance, fine.indices, fine.indptr), shape=fine.shape)
    squares = interpolation.power(2) if isinstance(interpolation, sparse.csr_array) else np.square(interpolation)
    spread: Any = variance @ squares
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(sparse.csr_array(spread)[rows, matrix.indices], dtype=np.float64).ravel()


class DetailMethod(DenseMethod):
    """Rv holds the covariance of the detail finer than f, which is common to measurements of the same place."""

    @property
    def _model(self) -> DetailedModel:
        return detailed(self.task.model)

    @cached_property
    def observation(self) -> tuple[sparse.csr_array, CorrelatedNoise]:
        """H of the measurements used, and their noise with that of detail."""
        task, model = self.task, self._model
        white = Whitening.of(_of_used(model, task.used), task.expected_noise, NEEDS_NOISE)
        # Errors that measurements share are whitened as independent ones, but the actual noise is without them.
        return model.matrix[task.used], CorrelatedNoise(white, CAUSE, task.shared_variance)

    def _noise_given(self, truth: FloatArray, noise: dict[str, FloatArray]) -> FloatArray:
        """Return the noise, (measurements used,), with what the uncertainty of H adds for a world of known detail."""
        if "calibration" in noise:
            noise = noise | {"calibration": self._model.fine.variance_from_model(truth)[self.task.used]}
        return total_variance(noise)

    def residual_power(
        self, truth: FloatArray | None, noise: dict[str, FloatArray], leverage: FloatArray | None
    ) -> ResidualPower | None:
        """Return the expected squares of the whitened residual; where its world is known, its detail is no noise."""
        model, form = self._model, self.estimate.form
        if truth is None or truth.size == form.problem.unknowns:
            return super().residual_power(truth, noise, leverage)
        inputs = ResidualInputs(
            observe=lambda world: self.white(model.fine.forward(world)[self.task.used]),
            draw_image=lambda _: np.zeros(truth.size),
            actual=self._noise_given(truth, noise),
            deviation=truth - model.prior_mean,
            draws=DRAWS,
            leverage=leverage,
            whiten=self.white,
        )
        return inputs.power(residuals(form, inputs.block()), form.problem.noise_variance)

    def interval(self, truth: FloatArray, noise: dict[str, FloatArray]) -> Interval:
        """Return the expected error of one image; where its world is known, its detail is no noise."""
        model, form, white = self._model, self.estimate.form, self.observation[1].white
        if truth.size == form.problem.unknowns:
            return super().interval(truth, noise)
        deviation = truth - model.prior_mean
        light = (model.fine.forward(deviation))[self.task.used]
        bias: FloatArray = averaging(self.task.shape, model.camera.detail) @ deviation - form.gain(self.white(light))
        pixels, given = np.arange(bias.size), self._noise_given(truth, noise)
        mean, variance = squared_error(form, bias[:, None], given, pixels, white)
        return interval(float(mean[0]), float(variance[0]), bias.size)


def _of_used(model: DetailedModel, used: BoolArray) -> FloatArray:
    covariance = model.detail_covariance
    if covariance is None:
        return np.diag(model.detail_variance[used])
    return np.array(covariance) if used.all() else covariance[np.ix_(used, used)]
