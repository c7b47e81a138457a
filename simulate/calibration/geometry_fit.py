"""H of few numbers a sub-imager instead of the noise of its every entry: `calibration.fit = "geometry"`.

The numbers of `geometry_model` are fitted to each sub-imager's entries. Their weights are the model's own, as if rays
were independent: the scatter of 16 passes says too little of each entry, and its errors would go into the fit.
Stratified rays scatter less, and not alike everywhere. That makes the fit no less right, and what it is worth the
batches tell, which go through the same linear map: the covariance of the numbers is theirs, pooled over a lens type. A
sub-imager is accepted where the weighted sum of squares that the fit leaves is not above what it leaves of the
batches, by an F test with the degrees of freedom that these show; any other keeps its entries as they were measured.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

from ommatid.runtime.processors import processors
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager

from ..sampling.passes import rounding_variance
from .geometry_deviance import Deviance, entry_table, with_outside
from .geometry_model import UNITS
from .geometry_start import starts
from .point_sources import Responses

Vector = NDArray[np.float64]
Whole = NDArray[np.int64]

SIGNIFICANCE = 0.01  # at which a right model is refused, of all sub-imagers together


@dataclass(frozen=True)
class GeometryFit:
    """What was found of one sub-imager; places are those of its cells, all that it or its model has.

    numbers, free : (6,) as `geometry_model` names them, and which were fitted
    keys, model : (cells,);  jacobian : (cells, free numbers);  information : jacobian^T weights jacobian
    deviations : (batches, free numbers), of each batch's numbers
    left, expected : weighted sum of squares between H and model, and what the batches say it should be
    freedom : degrees of freedom of the sums;  accepted : whether all sub-imagers' sums allow this one
    covariance : (free, free) of the numbers; `pooled` adds what the batches say, where the fit is accepted
    """

    sub: SubImager
    numbers: Vector
    free: NDArray[np.bool_]
    keys: Whole
    model: Vector
    jacobian: Vector
    information: Vector
    deviations: Vector
    left: float
    expected: float
    freedom: float
    covariance: Vector
    accepted: bool = False

    @property
    def chance(self) -> float:
        """Of a sum of squares as large as this if the model is right."""
        ratio = self.left / self.expected
        return float(stats.f.sf(ratio, self.freedom, self.freedom * (len(self.deviations) - 1)))

    @property
    def deviation(self) -> Vector:
        """Standard deviations of the numbers: (6,), 0 where they were not fitted."""
        found = np.zeros(self.free.size)
        found[self.free] = np.sqrt(np.diagonal(self.covariance))
        return found


def fit_geometry(responses: Responses, variance: Vector, camera: Camera) -> tuple[Responses, Vector, dict[str, Any]]:
    """H with the model's entries wherever the model holds, their variance, and the record of the fits.

    variance : (nnz,) of the entries of `responses`, kept where the model is refused
    """
    fits = {fit.sub.name: fit for fit in fit_all(responses, camera)}
    parts: list[tuple[sparse.csr_array, Vector, NDArray[np.float32]]] = []
    for sub, place in zip(camera.sub_imagers, camera.slices(), strict=True):
        fit = fits.get(sub.name)
        if fit is not None and fit.accepted:
            parts.append(_modelled(fit, camera, responses.samples))
        else:
            parts.append(_raw(responses, variance, place))
    matrices, variances, batches = zip(*parts, strict=True)
    matrix = sparse.csr_array(sparse.vstack(matrices, format="csr"))
    found = replace(
        responses, matrix=matrix, variance=np.concatenate(variances), batches=np.concatenate(batches, axis=1)
    )
    return found, found.variance, describe(camera, list(fits.values()))


def describe(camera: Camera, fits: list[GeometryFit]) -> dict[str, Any]:
    """What a model's record says: how many were accepted, which not, and the numbers of each lens type's accepted."""
    good = {fit.sub.name: fit for fit in fits if fit.accepted}
    expected = sum(fit.expected for fit in good.values())
    types: dict[str, list[Vector]] = {}
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


def _statistics(numbers: Vector) -> dict[str, dict[str, float]]:
    mean, rms = numbers.mean(axis=0), np.sqrt(np.square(numbers).mean(axis=0))
    return {name: {"mean": float(mean[at]), "rms": float(rms[at])} for at, name in enumerate(UNITS)}


def fit_all(responses: Responses, camera: Camera) -> list[GeometryFit]:
    """The fits of all sub-imagers but those that diffract, which no disk describes, in the order of measurements."""
    places = {
        sub: place
        for sub, place in zip(camera.sub_imagers, camera.slices(), strict=True)
        if camera.wavelength is None or sub.type.optics.aperture is None
    }
    with ThreadPoolExecutor(processors()) as threads:
        found = list(threads.map(partial(fit_one, responses, camera), places, places.values()))
    single = -np.expm1(np.log1p(-SIGNIFICANCE) / max(len(found), 1))
    return pooled([replace(fit, accepted=fit.chance >= single) for fit in found])


def fit_one(responses: Responses, camera: Camera, sub: SubImager, place: slice) -> GeometryFit:
    """Fit one sub-imager, whose pixels stand at `place` among the measurements."""
    rows = responses.matrix[place]
    measured, rays = entry_table(rows), responses.passes * responses.samples
    problem = Deviance(camera, sub, measured, rays)
    at, free, derivatives = problem.solve(starts(camera, sub, rows))
    model = problem.model(at)
    keys = np.union1d(np.union1d(derivatives.keys, measured.keys), model.keys)
    jacobian = derivatives.at(keys)
    p = model.at(keys)
    weights = rays / (p + problem.least)
    information = (jacobian.T * weights) @ jacobian + problem.ridge(free)
    batches = _batches(responses, place, keys)
    gain = np.linalg.solve(information, jacobian.T * weights)
    deviations = batches @ gain.T
    # Where no ray is expected there is no scatter to learn from either: half a ray may be missing there.
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
    """The same with covariances: the scatter of the batches of a type's accepted sub-imagers with the same numbers.

    In units in which independent rays would make it 1 the scatter is alike all over a type. It is drawn towards a
    multiple of 1, with the weight of as many batches as there are numbers and one.
    """
    groups: dict[tuple[str, bytes], list[int]] = {}
    for number, fit in enumerate(fits):
        if fit.accepted:
            groups.setdefault((fit.sub.type.name, fit.free.tobytes()), []).append(number)
    found = list(fits)
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
            found[number] = replace(fits[number], covariance=fits[number].covariance + back.T @ scatter @ back)
    return found


def _batches(responses: Responses, place: slice, keys: Whole) -> Vector:
    """Deviations of the batches at these places: (batches, cells)."""
    rows, stored = responses.matrix[place], _stored(responses, place)
    each = (
        sparse.csr_array((batch, rows.indices, rows.indptr), shape=rows.shape)
        for batch in responses.batches[:, stored].astype(np.float64)
    )
    return np.array([with_outside(batch, 0.0).at(keys) for batch in each])


def _stored(responses: Responses, place: slice) -> slice:
    pointers = responses.matrix.indptr
    return slice(int(pointers[place.start]), int(pointers[place.stop]))


def _freedom(gram: Vector) -> float:
    """(tr S)^2 / tr S^2 of the covariance S of what batches of Gram matrix `gram` are draws of.

    tr S^2 without bias from few draws: Bai and Saranadasa 1996, Statistica Sinica 6, 311.
    """
    free = len(gram) - 1
    trace, square = float(np.trace(gram)) / free, float(np.square(gram).sum()) / free**2
    squares = free**2 / ((free - 1) * (free + 2)) * (square - trace**2 / free)
    if trace == 0:
        return 1.0
    return max(1.0, trace**2 / max(squares, trace**2 * 1e-9))


def _raw(responses: Responses, variance: Vector, place: slice) -> tuple[sparse.csr_array, Vector, NDArray[np.float32]]:
    stored = _stored(responses, place)
    return responses.matrix[place], variance[stored], responses.batches[:, stored]


def _modelled(fit: GeometryFit, camera: Camera, samples: int) -> tuple[sparse.csr_array, Vector, NDArray[np.float32]]:
    """The model's entries, J C J^T for their variances, and J times each batch's numbers."""
    pixel, texel = np.divmod(fit.keys, camera.unknowns + 1)
    kept = (fit.model > 0) & (texel < camera.unknowns)
    rows, jacobian, values = pixel[kept], fit.jacobian[kept], fit.model[kept]
    count = fit.sub.type.pixels[0] * fit.sub.type.pixels[1]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))])
    matrix = sparse.csr_array((values, texel[kept], pointers), shape=(count, camera.unknowns))
    variance = np.einsum("ci,ij,cj->c", jacobian, fit.covariance, jacobian)
    batches = (fit.deviations @ jacobian.T).astype(np.float32)
    return matrix, np.maximum(variance, rounding_variance(values, samples)), batches
