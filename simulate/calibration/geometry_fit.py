"""H from six fitted parameters per sub-imager instead of its noisy entries: `calibration.fit = "geometry"`.

The parameters of `geometry_model` are fitted to each sub-imager's entries. Their weights are the model's own, as if
rays were independent: the scatter of 16 passes determines the variance of each entry poorly, and its errors would enter
the fit. Stratified rays scatter less, and unevenly. The fit remains unbiased, and its covariance follows from the
batches, which go through the same linear map, pooled over a lens type. A sub-imager is accepted if the weighted sum of
squares of its residuals is not above that of the batches, by an F test with their effective degrees of freedom; the
others keep their measured entries.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse, special

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.processors import processors
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager

from ..sampling.passes import rounding_variance
from .geometry_deviance import Deviance, entry_table, with_outside
from .geometry_model import UNITS
from .geometry_start import starts
from .point_sources import Responses

SIGNIFICANCE = 0.01  # at which a correct model is rejected, for all sub-imagers together


@dataclass(frozen=True)
class GeometryFit:
    """Fit of one sub-imager; its cells are all that the measurement or the model has.

    numbers, free : (6,) parameters of `geometry_model`, and which of them were fitted
    keys, model : (cells,);  jacobian : (cells, free numbers);  information : jacobian^T weights jacobian
    deviations : (batches, free numbers), of each batch's parameters
    left, expected : weighted sum of squared residuals, and its expectation from the batches
    freedom : degrees of freedom of the sums;  accepted : True if the F test accepts the model
    covariance : (free, free) of the parameters; `pooled` adds the scatter of the batches for accepted fits
    """

    sub: SubImager
    numbers: FloatArray
    free: BoolArray
    keys: IntArray
    model: FloatArray
    jacobian: FloatArray
    information: FloatArray
    deviations: FloatArray
    left: float
    expected: float
    freedom: float
    covariance: FloatArray
    accepted: bool = False

    @property
    def chance(self) -> float:
        """Probability of a sum of squares at least as large if the model is correct."""
        ratio = self.left / self.expected
        return float(special.fdtrc(self.freedom, self.freedom * (len(self.deviations) - 1), ratio))

    @property
    def deviation(self) -> FloatArray:
        """Standard deviations of the parameters: (6,), 0 where they were not fitted."""
        deviation = np.zeros(self.free.size)
        deviation[self.free] = np.sqrt(np.diagonal(self.covariance))
        return deviation


def fit_geometry(
    responses: Responses, variance: FloatArray, camera: Camera
) -> tuple[Responses, FloatArray, dict[str, Any]]:
    """Return H with the fitted entries of all accepted sub-imagers, their variance, and the record of the fits.

    variance : (nnz,) of the entries of `responses`, kept where the fit is rejected
    """
    fits = {fit.sub.name: fit for fit in fit_all(responses, camera)}
    parts: list[tuple[sparse.csr_array, FloatArray, Float32Array]] = []
    for sub, rows in zip(camera.sub_imagers, camera.slices(), strict=True):
        fit = fits.get(sub.name)
        if fit is not None and fit.accepted:
            parts.append(_modelled(fit, camera, responses.samples))
        else:
            parts.append(_measured(responses, variance, rows))
    matrices, variances, batches = zip(*parts, strict=True)
    matrix = sparse.csr_array(sparse.vstack(matrices, format="csr"))
    fitted = replace(
        responses, matrix=matrix, variance=np.concatenate(variances), batches=np.concatenate(batches, axis=1)
    )
    return fitted, fitted.variance, describe(camera, list(fits.values()))


def describe(camera: Camera, fits: list[GeometryFit]) -> dict[str, Any]:
    """Return the entry of a model's record: accepted and rejected fits, statistics of the parameters by lens type."""
    good = {fit.sub.name: fit for fit in fits if fit.accepted}
    expected = sum(fit.expected for fit in good.values())
    types: dict[str, list[FloatArray]] = {}
    for fit in good.values():
        types.setdefault(fit.sub.type.name, []).append(fit.numbers)
    return {
        "kind": "geometry",
        "accepted": len(good),
        "refused": [sub.name for sub in camera.sub_imagers if sub.name not in good],
        "parameters": {name: _statistics(np.array(numbers)) for name, numbers in types.items()},
        "units": UNITS,
        "chi_squared": sum(fit.left for fit in good.values()) / expected if good else None,
    }


def _statistics(numbers: FloatArray) -> dict[str, dict[str, float]]:
    mean, rms = numbers.mean(axis=0), np.sqrt(np.square(numbers).mean(axis=0))
    return {name: {"mean": float(mean[at]), "rms": float(rms[at])} for at, name in enumerate(UNITS)}


def fit_all(responses: Responses, camera: Camera) -> list[GeometryFit]:
    """Fit all sub-imagers but those that diffract, which no disk describes, in the order of measurements."""
    slices = {
        sub: rows
        for sub, rows in zip(camera.sub_imagers, camera.slices(), strict=True)
        if camera.wavelength is None or sub.type.optics.aperture is None
    }
    with ThreadPoolExecutor(processors()) as threads:
        fits = list(threads.map(partial(fit_one, responses, camera), slices, slices.values()))
    single = -np.expm1(np.log1p(-SIGNIFICANCE) / max(len(fits), 1))
    return pooled([replace(fit, accepted=fit.chance >= single) for fit in fits])


def fit_one(responses: Responses, camera: Camera, sub: SubImager, rows: slice) -> GeometryFit:
    """Fit one sub-imager, whose pixels are the given rows of H."""
    matrix = responses.matrix[rows]
    measured, rays = entry_table(matrix), responses.passes * responses.samples
    problem = Deviance(camera, sub, measured, rays)
    at, free, derivatives = problem.solve(starts(camera, sub, matrix))
    model = problem.model(at)
    keys = np.union1d(np.union1d(derivatives.keys, measured.keys), model.keys)
    jacobian = derivatives.at(keys)
    p = model.at(keys)
    weights = rays / (p + problem.least)
    information = (jacobian.T * weights) @ jacobian + problem.ridge(free)
    batches = _batches(responses, rows, keys)
    gain = np.linalg.solve(information, jacobian.T * weights)
    deviations = batches @ gain.T
    # Where no ray is expected there is no scatter either: half a ray may be missing there.
    unseen = gain[:, p < problem.least] * problem.least
    residuals = batches - deviations @ jacobian.T
    gram = (residuals * weights) @ residuals.T
    count = len(gram)
    floor = float(weights[p > 0] @ rounding_variance(p[p > 0], responses.samples))
    return GeometryFit(
        sub=sub,
        numbers=at,
        free=free,
        keys=keys,
        model=p,
        jacobian=jacobian,
        information=information,
        deviations=deviations,
        left=float(weights @ np.square(measured.at(keys) - p)),
        expected=float(np.trace(gram)) / (count * (count - 1)) + floor,
        freedom=min(_freedom(gram), float(keys.size)),
        covariance=unseen @ unseen.T,
    )


def pooled(fits: list[GeometryFit]) -> list[GeometryFit]:
    """Add covariances from the batches, pooled over accepted sub-imagers of a type with the same free parameters.

    Whitened by the information of independent rays, the scatter is alike over a type. It is shrunk towards a multiple
    of the identity, with the weight of as many batches as there are parameters, plus one.
    """
    groups: dict[tuple[str, bytes], list[int]] = {}
    for number, fit in enumerate(fits):
        if fit.accepted:
            groups.setdefault((fit.sub.type.name, fit.free.tobytes()), []).append(number)
    result = list(fits)
    for group in groups.values():
        factors = [np.linalg.cholesky(fits[number].information) for number in group]
        white = np.concatenate([fits[n].deviations @ factor for n, factor in zip(group, factors, strict=True)])
        size, count = white.shape[1], len(fits[group[0]].deviations)
        freedom = len(group) * (count - 1)
        scatter = white.T @ white / (freedom * count)
        typical = np.trace(scatter) / size * np.eye(size)
        scatter = (freedom * scatter + (size + 1) * typical) / (freedom + size + 1)
        for number, factor in zip(group, factors, strict=True):
            back = np.linalg.inv(factor)
            result[number] = replace(fits[number], covariance=fits[number].covariance + back.T @ scatter @ back)
    return result


def _batches(responses: Responses, rows: slice, keys: IntArray) -> FloatArray:
    """Return the deviations of the batches in some cells: (batches, cells)."""
    matrix, stored = responses.matrix[rows], _stored(responses, rows)
    each = (
        sparse.csr_array((batch, matrix.indices, matrix.indptr), shape=matrix.shape)
        for batch in responses.batches[:, stored].astype(np.float64)
    )
    return np.array([with_outside(batch, 0.0).at(keys) for batch in each])


def _stored(responses: Responses, rows: slice) -> slice:
    pointers = responses.matrix.indptr
    return slice(int(pointers[rows.start]), int(pointers[rows.stop]))


def _freedom(gram: FloatArray) -> float:
    """Return the effective degrees of freedom (tr S)^2 / tr S^2 of the covariance S, from the Gram matrix of draws.

    tr S^2 without bias from few draws: Bai and Saranadasa 1996, Statistica Sinica 6, 311.
    """
    free = len(gram) - 1
    trace, square = float(np.trace(gram)) / free, float(np.square(gram).sum()) / free**2
    squares = free**2 / ((free - 1) * (free + 2)) * (square - trace**2 / free)
    if trace == 0:
        return 1.0
    return max(1.0, trace**2 / max(squares, trace**2 * 1e-9))


def _measured(
    responses: Responses, variance: FloatArray, rows: slice
) -> tuple[sparse.csr_array, FloatArray, Float32Array]:
    stored = _stored(responses, rows)
    return responses.matrix[rows], variance[stored], responses.batches[:, stored]


def _modelled(fit: GeometryFit, camera: Camera, samples: int) -> tuple[sparse.csr_array, FloatArray, Float32Array]:
    """Return the fitted entries, their variances J C J^T, and J times each batch's parameters."""
    pixel, texel = np.divmod(fit.keys, camera.unknowns + 1)
    kept = (fit.model > 0) & (texel < camera.unknowns)
    rows, jacobian, values = pixel[kept], fit.jacobian[kept], fit.model[kept]
    count = fit.sub.type.pixels[0] * fit.sub.type.pixels[1]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))])
    matrix = sparse.csr_array((values, texel[kept], pointers), shape=(count, camera.unknowns))
    variance = np.einsum("ci,ij,cj->c", jacobian, fit.covariance, jacobian)
    batches = (fit.deviations @ jacobian.T).astype(np.float32)
    return matrix, np.maximum(variance, rounding_variance(values, samples)), batches
