"""H on the world's grid as a model of f: the best linear description of the measurements by f's pixels.

Let the world w have mean w0 and covariance P on a grid F times finer than f, f = A w, and g = Hf w + v. Then

    g = G f + (Hf w0 - G f0) + e + v,   G = Hf P A^T (A P A^T)^-1,   cov e = Hf P Hf^T - G (A P A^T) G^T,

where e, the detail that f does not hold, is not correlated with f: Eq. 4 and 5 of Wood et al. with G in place of H and
Rv + cov e in place of Rv give the best linear estimate of f. A prior of independent pixels says nothing of detail: the
world is then taken as made of f's pixels, and e is zero.

Where these moments are too large, each pixel's world is predicted from its neighbourhood: B of `world_prior` decays
within a few pixels of f, and a pixel of the world is predicted from a window of NEIGHBOURS x NEIGHBOURS pixels of f
around it, moved inwards at the edges of the image; B of an image of that size serves them all. What a measurement
leaves unexplained has the variance z^T P z with z = h - A^T g, h its row of H and g that of G: for any prediction, the
best or not, this is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import fft, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.processors import processors
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import PriorTable

from .world_prior import WorldPrior, averaging, repetition

NEIGHBOURS = 5  # pixels of f, odd
VALUES = 2**24  # of the patches that are transformed at once
MAX_WORLD = 32_000  # pixels of the world, and
MAX_MEASUREMENTS = 1_500  # measurements, up to which the exact moments take seconds
CAUSE = "detail"  # in the error budget
DRAWS = 4


def local_interpolation(prior: WorldPrior, window: WorldPrior) -> sparse.csr_array:
    """Return B, (pixels of the world, N), each row from the neighbourhood of its pixel.

    window : the same prior for an image of at most NEIGHBOURS x NEIGHBOURS pixels
    """
    detail, weights = prior.detail, window.interpolation
    fine, sides = prior.fine_shape, window.shape
    starts = [np.clip(np.arange(n) - side // 2, 0, n - side) for n, side in zip(prior.shape, sides, strict=True)]
    pixels = [np.arange(size) // detail for size in fine]
    first = [start[pixel] for start, pixel in zip(starts, pixels, strict=True)]
    inside = [np.arange(size) - detail * start for size, start in zip(fine, first, strict=True)]
    row = inside[0][:, None] * (sides[1] * detail) + inside[1][None, :]  # of `weights`
    down, across = np.divmod(np.arange(sides[0] * sides[1]), sides[1])
    corner = first[0][:, None] * prior.shape[1] + first[1][None, :]
    columns = corner.ravel()[:, None] + (down * prior.shape[1] + across)[None, :]
    indptr = np.arange(fine[0] * fine[1] + 1) * weights.shape[1]
    shape = fine[0] * fine[1], prior.shape[0] * prior.shape[1]
    matrix = sparse.csr_array((weights[row.ravel()].ravel(), columns.ravel(), indptr), shape=shape)
    matrix.sum_duplicates()
    return matrix


def unexplained_variance(prior: WorldPrior, fine: sparse.csr_array, coarse: sparse.csr_array) -> FloatArray:
    """Return z^T P z with z = h - A^T g of every measurement, as if P were the same everywhere: (M,).

    fine : rows h of H on the world's grid;  coarse : rows g of G on f's
    """
    left = sparse.csr_array(fine - coarse @ averaging(prior.shape, prior.detail))
    left.eliminate_zeros()
    variance = np.zeros(fine.shape[0])
    for batch in _batches(left, prior.fine_shape):
        shape = batch.rows * 2, batch.columns * 2
        places = (np.minimum(np.arange(size), size - np.arange(size)) for size in shape)
        spectrum = fft.rfft2(prior.lags((batch.rows + 1, batch.columns + 1))[np.ix_(*places)]).real
        patches = np.zeros((batch.measurements.size, *shape))
        patches[batch.number, batch.row, batch.column] = batch.values
        power = np.square(np.abs(fft.rfft2(patches, workers=processors())))
        weight = np.full(power.shape[-1], 2.0)
        weight[0] = weight[-1] = 1.0  # their waves have no partner of negative frequency
        variance[batch.measurements] = np.einsum("nij,ij,j->n", power, spectrum, weight) / (shape[0] * shape[1])
    return np.maximum(variance, 0.0)


@dataclass(frozen=True)
class _Batch:
    """Rows of a matrix on patches of one size: the number of each entry's patch, its place there, and its value."""

    measurements: IntArray
    rows: int
    columns: int
    number: IntArray
    row: IntArray
    column: IntArray
    values: FloatArray


def _batches(matrix: sparse.csr_array, shape: tuple[int, int]) -> Iterator[_Batch]:
    """Yield the rows of a matrix that have entries, in patches as large as the largest among some of similar size."""
    row, column = np.divmod(matrix.indices.astype(np.int64), shape[1])
    filled = np.flatnonzero(np.diff(matrix.indptr))
    starts = matrix.indptr[filled].astype(np.int64)
    if not filled.size:
        return
    extents: list[IntArray] = []
    for index in (row, column):
        first, last = np.minimum.reduceat(index, starts), np.maximum.reduceat(index, starts)
        extents += [first, last - first + 1]
    top, height, left, width = extents
    order = np.argsort(height * width, kind="stable")
    while order.size:
        # The largest of a batch comes last; it grows until the patches fill the memory allowed for it.
        area = np.maximum.accumulate(height[order]) * np.maximum.accumulate(width[order]) * 4
        count = max(1, int(np.searchsorted(area * np.arange(1, order.size + 1), VALUES)))
        chosen, order = order[:count], order[count:]
        sizes = np.diff(matrix.indptr)[filled[chosen]].astype(np.int64)
        before = np.repeat(np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
        entries: IntArray = np.repeat(starts[chosen], sizes) + np.arange(int(sizes.sum())) - before
        number = np.repeat(np.arange(chosen.size), sizes)
        yield _Batch(
            filled[chosen],
            int(fft.next_fast_len(int(height[chosen].max()), real=True)),
            int(fft.next_fast_len(int(width[chosen].max()), real=True)),
            number,
            row[entries] - np.repeat(top[chosen], sizes),
            column[entries] - np.repeat(left[chosen], sizes),
            matrix.data[entries],
        )


@dataclass(frozen=True)
class DetailedModel(Model):
    """G as `matrix`, on f's grid, with the moments of the detail that f does not hold.

    fine : the model on the world's grid;  interpolation : B, (pixels of the world, N);  prior_mean : of every pixel
    offset : (M,) Hf w0 - G f0
    unresolved : variance of every pixel of the world given f, (pixels of the world,);  world : its prior, or None
    detail_variance : (M,) the diagonal of cov e;  detail_covariance : (M, M), None where it is too large
    """

    fine: Model
    interpolation: sparse.csr_array | FloatArray
    prior_mean: float
    offset: FloatArray
    unresolved: FloatArray
    world: WorldPrior | None
    detail_variance: FloatArray
    detail_covariance: FloatArray | None

    @property
    def is_exact(self) -> bool:
        """False: G has no box footprints."""
        return False

    @cached_property
    def structure(self) -> None:
        """None: G has entries."""
        return None

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
        for _ in range(DRAWS):
            world = self.world.draw(rng)
            detail = world - self.interpolation @ (average @ world)
            scatter += float(self.fine.scatter(detail).sum())
            power += float(detail @ detail)
        return variance * (scatter / power * float(self.unresolved.sum()) / total)

    def prior_variance_from_model(self, prior_variance: FloatArray, prior_mean: float = 0.0) -> FloatArray:
        """Variance that the uncertainty of H adds to each measurement under the prior: (M,)."""
        world = repetition(self.camera.shape, self.camera.detail) @ prior_variance
        return self.fine.prior_variance_from_model(world, prior_mean)

    def error_directions(self, image: FloatArray) -> sparse.csc_array | None:
        """Return L, (M, q), such that the error of H by that of few numbers adds L xi to the measurements of f."""
        return self.fine.error_directions(self._world_with_detail(image))

    def error_variance(self, image: FloatArray) -> FloatArray | None:
        """Return the variance of each measurement by the errors of few numbers, (M,)."""
        return self.fine.error_variance(self._world_with_detail(image))

    def error_draw(self, image: FloatArray, rng: np.random.Generator) -> FloatArray | None:
        """Return a random error of the measurements of f by those of few numbers, (M,)."""
        return self.fine.error_draw(self._world_with_detail(image), rng)

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


def is_exact_for(scene: Scene, camera: Camera) -> bool:
    """Return True if the estimator counts with the exact covariance of detail finer than f, where there is any."""
    if not camera.has_detail or scene.prior.kind == "independent":
        return False
    return camera.unknowns * camera.detail**2 <= MAX_WORLD and camera.measurements <= MAX_MEASUREMENTS


def detail_memory(camera: Camera) -> int:
    """Return the bytes of the exact moments: B, P A^T and P Hf^T, R_detail, its sum with the noise, and its factor."""
    world, measurements = camera.world.unknowns, camera.measurements
    return 8 * (world * (2 * camera.unknowns + measurements) + 4 * measurements**2)


def independent_detail(model: Model, used: BoolArray) -> dict[str, FloatArray]:
    """Return the variance of detail by its cause, (measurements used,), where its covariance is not known."""
    if not isinstance(model, DetailedModel) or model.detail_covariance is not None or not model.detail_variance.any():
        return {}
    return {CAUSE: model.detail_variance[used]}


def model_of_f(model: Model, camera: Camera, prior: PriorTable) -> Model:
    """Return the model of f from one whose H may be on the grid of a world finer than f.

    camera : of the stack, on f's grid;  prior : "fit" counts as independent pixels
    """
    if not camera.has_detail:
        return model if camera.detail == model.camera.detail else replace(model, camera=camera)
    if prior.kind in ("independent", "fit"):
        return _without_detail(model, camera, prior.mean)
    world = WorldPrior.of(prior, camera.shape, camera.target_pitch, camera.detail)
    if model.unknowns <= MAX_WORLD and model.measurements <= MAX_MEASUREMENTS:
        return _exact(model, camera, prior.mean, world)
    sides = min(camera.rows, NEIGHBOURS), min(camera.columns, NEIGHBOURS)
    return _local(model, camera, prior, world, WorldPrior.of(prior, sides, camera.target_pitch, camera.detail))


def _without_detail(model: Model, camera: Camera, mean: float) -> DetailedModel:
    expansion = repetition(camera.shape, camera.detail)
    zeros = np.zeros(model.measurements)
    matrix = sparse.csr_array(model.to_sparse() @ expansion)
    return _detailed(model, camera, mean, matrix, expansion, np.zeros(model.unknowns), None, zeros, None)


def _exact(model: Model, camera: Camera, mean: float, world: WorldPrior) -> DetailedModel:
    fine = model.to_sparse()
    gain: FloatArray = fine @ world.interpolation
    spread = world.apply(np.asarray(fine.T.toarray(), dtype=np.float64))
    left: FloatArray = fine @ spread - gain @ (averaging(camera.shape, camera.detail) @ spread)
    covariance = (left + left.T) / 2
    variance = np.maximum(np.diagonal(covariance), 0.0)
    matrix = sparse.csr_array(gain)
    return _detailed(model, camera, mean, matrix, world.interpolation, world.unresolved, world, variance, covariance)


def _local(model: Model, camera: Camera, prior: PriorTable, world: WorldPrior, window: WorldPrior) -> DetailedModel:
    fine, interpolation = model.to_sparse(), local_interpolation(world, window)
    matrix = sparse.csr_array(fine @ interpolation)
    variance = unexplained_variance(world, fine, matrix)
    middle = tuple(slice(n // 2 * camera.detail, (n // 2 + 1) * camera.detail) for n in window.shape)
    phases = window.unresolved.reshape(window.fine_shape)[middle]
    unresolved = np.tile(phases, camera.shape).ravel()
    return _detailed(model, camera, prior.mean, matrix, interpolation, unresolved, world, variance, None)


def _detailed(
    model: Model,
    camera: Camera,
    mean: float,
    matrix: sparse.csr_array,
    interpolation: sparse.csr_array | FloatArray,
    unresolved: FloatArray,
    world: WorldPrior | None,
    variance: FloatArray,
    covariance: FloatArray | None,
) -> DetailedModel:
    fine = model.to_sparse()
    offset: FloatArray = fine @ np.full(fine.shape[1], mean) - matrix @ np.full(matrix.shape[1], mean)
    entries: dict[str, Any] = {"variance": np.zeros(matrix.nnz), "batches": np.zeros((0, matrix.nnz), np.float32)}
    if model.variance.any():
        entries["variance"] = _entry_variance(model, matrix, interpolation)
    return DetailedModel(
        scene=model.scene,
        camera=camera,
        stored=matrix,
        record=model.record,
        fine=model,
        interpolation=interpolation,
        prior_mean=mean,
        offset=offset,
        unresolved=unresolved,
        world=world,
        detail_variance=variance,
        detail_covariance=covariance,
        **entries,
    )


def _entry_variance(model: Model, matrix: sparse.csr_array, interpolation: sparse.csr_array | FloatArray) -> FloatArray:
    """Return the variance of every entry of G, (nnz,), as if the errors of H's entries were independent."""
    fine = model.matrix
    variance = sparse.csr_array((model.variance, fine.indices, fine.indptr), shape=fine.shape)
    squares = interpolation.power(2) if isinstance(interpolation, sparse.csr_array) else np.square(interpolation)
    spread: Any = variance @ squares
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(sparse.csr_array(spread)[rows, matrix.indices], dtype=np.float64).ravel()
