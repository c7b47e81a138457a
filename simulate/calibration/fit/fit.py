"""Calibration by few numbers: a chart of sensor pixels is measured, and H follows from what explains its rows.

Sub-imagers with sharp footprints are explained by their views. What an F test leaves unexplained is measured entry by
entry, pixel by pixel, and named in the record.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, Views, designed_views
from ommatid.scenes.fitted.fitted_model import MeasuredRows
from ommatid.scenes.fitted.view import COUNT, UNITS, designed
from ommatid.scenes.lens_type import LensType, SubImager

from ..point_sources import Responses, Subsets
from .chart import chart_of, chart_rows
from .explanation import Explanation, explanation
from .view_fit import SIGNIFICANCE, ViewFit, fit_views
from .view_model import predicted

Measure = Callable[[Subsets], Responses]
Variances = Callable[[Responses], FloatArray]
Rays = dict[str, int]


@dataclass(frozen=True)
class FittedCalibration:
    """H by few numbers, the rows that they do not explain, and the record of the fit."""

    matrix: FittedMatrix
    rest: MeasuredRows | None
    responses: Responses
    record: dict[str, Any]


@dataclass(frozen=True)
class _TypeFit:
    views: Views
    fit: ViewFit | None
    explanations: list[Explanation]


def is_sharp(camera: Camera, lens_type: LensType) -> bool:
    """Return True if the footprints of a lens type are sharp as designed, so that views describe them."""
    return camera.walls and not camera.is_blurred(lens_type)


def calibrate_by_fit(camera: Camera, measure: Measure, variances: Variances, rays: Rays) -> FittedCalibration:
    """Measure a chart and fit it; then measure all pixels of what it does not explain.

    measure : yields the responses of some pixels of each lens type;  variances : of their entries
    rays : per pixel of each lens type, of all passes
    """
    subsets: Subsets = {lens.name: chart_of(lens) if is_sharp(camera, lens) else None for lens in camera.types}
    responses = measure(subsets)
    fits = {
        lens.name: _fit_type(camera, lens, subs, responses, rows, rays[lens.name])
        for lens, subs, rows in zip(camera.types, _by_type(camera), camera.type_slices(), strict=True)
    }
    unexplained: Subsets = {
        lens.name: chart_of(lens, ~fits[lens.name].views.explained)
        for lens in camera.types
        if is_sharp(camera, lens) and not fits[lens.name].views.explained.all()
    }
    rest = None
    if unexplained or not all(is_sharp(camera, lens) for lens in camera.types):
        rest = _rest(camera, fits, responses, measure(unexplained) if unexplained else None, variances)
    fitted = FittedMatrix(camera, {name: each.views for name, each in fits.items()})
    return FittedCalibration(fitted, rest, responses, _record(camera, fits, subsets))


def _by_type(camera: Camera) -> list[list[SubImager]]:
    subs = iter(camera.sub_imagers)
    return [[next(subs) for _ in range(lens.count)] for lens in camera.types]


def _fit_type(
    camera: Camera, lens: LensType, subs: list[SubImager], responses: Responses, rows: slice, rays: int
) -> _TypeFit:
    if not is_sharp(camera, lens):
        return _TypeFit(_unexplained(subs), None, [])
    pointers = responses.matrix.indptr
    batches = responses.batches[:, int(pointers[rows.start]) : int(pointers[rows.stop])]
    charts = chart_rows(camera, lens, responses.matrix[rows], batches)
    try:
        fit = fit_views(camera, subs, charts, rays)
    except InputError:  # rows that no view has led to a distortion that folds the image
        return _TypeFit(_unexplained(subs), None, [])
    models = [predicted(camera, sub, fit.numbers[n], charts[n]) for n, sub in enumerate(subs)]
    explanations = [explanation(chart, model, rays) for chart, model in zip(charts, models, strict=True)]
    single = -np.expm1(np.log1p(-SIGNIFICANCE) / len(camera.sub_imagers))
    explained = np.array([each.chance >= single for each in explanations])
    numbers = np.where(explained[:, None], fit.numbers, designed_views(subs))
    return _TypeFit(Views(numbers, explained, fit.own, fit.shared, fit.structure), fit, explanations)


def _unexplained(subs: list[SubImager]) -> Views:
    nothing = np.zeros((len(subs), COUNT, 0))
    explained = np.zeros(len(subs), dtype=np.bool_)
    return Views(designed_views(subs), explained, nothing, nothing, ("designed",) * COUNT)


def _rest(
    camera: Camera,
    fits: dict[str, _TypeFit],
    chart: Responses,
    more: Responses | None,
    variances: Variances,
) -> MeasuredRows:
    """Return the rows of H that are measured entry by entry, from the responses that hold all of them."""
    import scipy.sparse as sparse

    matrices: list[sparse.csr_array] = []
    kept_variances: list[FloatArray] = []
    kept_batches: list[FloatArray] = []
    sources = [(each, variances(each)) for each in (chart, more) if each is not None]
    for lens, rows in zip(camera.types, camera.type_slices(), strict=True):
        responses, variance = sources[-1] if is_sharp(camera, lens) else sources[0]
        pointers = responses.matrix.indptr
        stored = slice(int(pointers[rows.start]), int(pointers[rows.stop]))
        if fits[lens.name].views.explained.all():
            matrices.append(sparse.csr_array((lens.measurements, camera.unknowns)))
            continue
        matrices.append(responses.matrix[rows])
        kept_variances.append(variance[stored])
        kept_batches.append(responses.batches[:, stored])
    matrix = sparse.csr_array(sparse.vstack(matrices, format="csr"))
    return MeasuredRows(matrix, np.concatenate(kept_variances), np.concatenate(kept_batches, axis=1))


def _record(camera: Camera, fits: dict[str, _TypeFit], subsets: Subsets) -> dict[str, Any]:
    """Return the entry of a model's record."""
    explained = np.concatenate([each.views.explained for each in fits.values()])
    names = [sub.name for sub in camera.sub_imagers]
    left, expected = (
        sum(getattr(each, name) for fit in fits.values() for each in fit.explanations) for name in ("left", "expected")
    )
    return {
        "kind": "auto",
        "accepted": int(explained.sum()),
        "refused": [name for name, good in zip(names, explained.tolist(), strict=True) if not good],
        "structure": {name: dict(zip(UNITS, fit.views.structure, strict=True)) for name, fit in fits.items()},
        "chances": {name: fit.fit.chances for name, fit in fits.items() if fit.fit is not None},
        "parameters": {
            name: _statistics(fit, subs)
            for (name, fit), subs in zip(fits.items(), _by_type(camera), strict=True)
            if fit.views.explained.any()
        },
        "units": UNITS,
        "chart": {name: int(pixels.size) for name, pixels in subsets.items() if pixels is not None},
        "chi_squared": left / expected if expected else None,
    }


def _statistics(fit: _TypeFit, subs: list[SubImager]) -> dict[str, dict[str, float]]:
    """Return the deviations of the numbers from the design and their standard errors, over the sub-imagers."""
    views = fit.views
    moved = (views.numbers - np.array([designed(sub) for sub in subs]))[views.explained]
    variance = (np.square(views.own).sum(axis=2) + np.square(views.shared).sum(axis=2))[views.explained]
    return {
        name: {
            "mean": float(moved[:, at].mean()),
            "rms": float(np.sqrt(np.square(moved[:, at]).mean())),
            "standard_error": float(np.sqrt(variance[:, at].mean())),
        }
        for at, name in enumerate(UNITS)
    }
