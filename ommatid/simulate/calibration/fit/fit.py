"""Calibration by few numbers: a chart of sensor pixels is measured, and H follows from what explains its rows.

Sub-imagers with sharp footprints are explained by their views, lens types with blur by kernels. An F test says whether
the numbers of a view explain the measured rows of a sub-imager: the weighted sum of squares of the residuals of all
entries, those that are zero included, is compared with that of the batches, whose rays scatter as those of the mean do.
The weights are those of independent rays, but where cells hold few of them. What the tests leave unexplained is
measured entry by entry, pixel by pixel, and named in the record.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, Views, designed_views, views_as_designed
from ommatid.scenes.fitted.view import UNITS, designed
from ommatid.scenes.lens_type import LensType, SubImager
from ommatid.scenes.model import MeasuredRows

from ..responses import Responses, Subsets
from .chart import SIDE, ChartRows, Explanation, chart_of, chart_rows, side_for_kernels
from .view_fit import SIGNIFICANCE, fit_views, predicted

if TYPE_CHECKING:
    from .kernel_fit import KernelFit

FEW = 8  # rays of a cell, below which its weight hardly grows: single rays there would decide
STRAY = 0.5  # rays that each cell may miss or have in excess, by rounding of positions to float32
Measure = Callable[[Subsets], Responses]
Variances = Callable[[Responses], FloatArray]
Rays = dict[str, int]


def explanation(chart: ChartRows, model: FloatArray, rays: int, recorded: bool = False) -> Explanation:
    """Compare measured rows with those of a model, (pixels, W, V).

    rays : per pixel, of all passes;  recorded : True for entries with about the same noise, of which some are missing
    """
    weights = chart.known.astype(np.float64) if recorded else rays / (model + FEW / rays)
    floor = float(weights[(model > 0) | (chart.values > 0)].sum()) * (STRAY / rays) ** 2
    root = np.sqrt(weights)
    return Explanation.of([root * each for each in (chart.values - model, *chart.batches)], floor)


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
    chances: dict[str, float] = field(default_factory=dict[str, float])
    explanations: list[Explanation] = field(default_factory=list[Explanation])
    kernels: KernelFit | None = None


def is_sharp(camera: Camera, lens_type: LensType) -> bool:
    """Return True if the footprints of a lens type are sharp as designed, so that views describe them."""
    return camera.walls and not camera.is_blurred(lens_type)


def has_chart(camera: Camera, lens_type: LensType, with_kernels: bool = True) -> bool:
    """Return True if few numbers may explain a lens type, so that a chart of its pixels is measured first."""
    if is_sharp(camera, lens_type) or not with_kernels:
        return is_sharp(camera, lens_type)
    from .kernel_fit import refusal

    return not refusal(camera, lens_type)


def calibrate_by_fit(
    camera: Camera,
    measure: Measure,
    variances: Variances,
    rays: Rays,
    with_kernels: bool = True,
    recorded: bool = False,
) -> FittedCalibration:
    """Measure a chart and fit it; then measure all pixels of what it does not explain.

    measure : yields the responses of some pixels of each lens type;  variances : of their entries
    rays : per pixel of each lens type, of all passes;  recorded : as of `explanation`
    with_kernels : True if kernels may explain blur
    """
    subsets = first_measured(camera, with_kernels)
    responses = measure(subsets)
    fits = {
        lens.name: _fit_type(camera, lens, subs, responses, rows, rays[lens.name], subsets[lens.name], recorded)
        for lens, subs, rows in zip(camera.types, _by_type(camera), camera.type_slices(), strict=True)
    }
    counts = {lens.name: lens.measurements for lens in camera.types}
    charted = {name: chart is not None and chart.size < counts[name] for name, chart in subsets.items()}
    unexplained: Subsets = {
        lens.name: chart_of(lens, ~fits[lens.name].views.explained)
        for lens in camera.types
        if charted[lens.name] and not fits[lens.name].views.explained.all()
    }
    rest = None
    if not all(each.views.explained.all() for each in fits.values()):
        more = measure(unexplained) if unexplained else None
        rest = _rest(camera, fits, charted, (responses, more), variances)
    kernels = {name: each.kernels.footprints for name, each in fits.items() if each.kernels is not None}
    fitted = FittedMatrix(
        camera,
        {name: each.views for name, each in fits.items()},
        {name: each for name, each in kernels.items() if each is not None},
    )
    record = {"kind": "auto" if with_kernels else "geometry", **_record(camera, fits, subsets)}
    return FittedCalibration(fitted, rest, responses, record)


def first_measured(camera: Camera, with_kernels: bool = True) -> Subsets:
    """Return the pixels of each lens type that are measured first, None for all."""
    found: Subsets = dict.fromkeys(lens.name for lens in camera.types)
    for lens in (lens for lens in camera.types if has_chart(camera, lens, with_kernels)):
        found[lens.name] = chart_of(lens, side=SIDE if is_sharp(camera, lens) else side_for_kernels(lens))
    return found


def _by_type(camera: Camera) -> list[list[SubImager]]:
    subs = iter(camera.sub_imagers)
    return [[next(subs) for _ in range(lens.count)] for lens in camera.types]


def _fit_type(
    camera: Camera,
    lens: LensType,
    subs: list[SubImager],
    responses: Responses,
    rows: slice,
    rays: int,
    chart: IntArray | None,
    recorded: bool,
) -> _TypeFit:
    if chart is None:
        return _TypeFit(views_as_designed(subs, explained=False))
    if not is_sharp(camera, lens):
        from .kernel_fit import fit_kernels

        kernels = fit_kernels(responses, camera, lens, chart)
        return _TypeFit(views_as_designed(subs, kernels.accepted), kernels=kernels)
    pointers = responses.matrix.indptr
    batches = responses.batches[:, int(pointers[rows.start]) : int(pointers[rows.stop])]
    charts = chart_rows(camera, lens, responses.matrix[rows], batches)
    try:
        views, chances = fit_views(camera, subs, charts, rays, matched=recorded)
    except InputError:  # rows that no view has led to a distortion that folds the image
        return _TypeFit(views_as_designed(subs, explained=False))
    models = [predicted(camera, sub, views.numbers[n], charts[n]) for n, sub in enumerate(subs)]
    explanations = [explanation(chart, model, rays, recorded) for chart, model in zip(charts, models, strict=True)]
    single = -np.expm1(np.log1p(-SIGNIFICANCE) / len(camera.sub_imagers))
    explained = np.array([each.chance >= single for each in explanations])
    numbers = np.where(explained[:, None], views.numbers, designed_views(subs))
    own, shared = (np.where(explained[:, None, None], each, 0.0) for each in (views.own, views.shared))
    return _TypeFit(Views(numbers, explained, own, shared, views.structure), chances, explanations)


def _rest(
    camera: Camera,
    fits: dict[str, _TypeFit],
    charted: dict[str, bool],
    measured: tuple[Responses, Responses | None],
    variances: Variances,
) -> MeasuredRows:
    """Return the rows of H that are measured entry by entry.

    charted : lens types of which the first responses hold but a part;  measured : these, and those of all pixels of
        what they do not explain
    """
    sizes = [place.stop - place.start for place in camera.slices()]
    explained = np.repeat(np.concatenate([fits[lens.name].views.explained for lens in camera.types]), sizes)
    in_part = np.repeat([charted[lens.name] for lens in camera.types], [lens.measurements for lens in camera.types])
    first, *more = (MeasuredRows(each.matrix, variances(each), each.batches) for each in measured if each is not None)
    rest = first.only(~explained & ~in_part)
    return rest.joined(more[0].only(~explained & in_part)) if more else rest


def _record(camera: Camera, fits: dict[str, _TypeFit], subsets: Subsets) -> dict[str, Any]:
    """Return the entry of a model's record."""
    explained = np.concatenate([each.views.explained for each in fits.values()])
    names = [sub.name for sub in camera.sub_imagers]
    left, expected = (
        sum(getattr(each, name) for fit in fits.values() for each in fit.explanations) for name in ("left", "expected")
    )
    return {
        "accepted": int(explained.sum()),
        "refused": [name for name, good in zip(names, explained.tolist(), strict=True) if not good],
        "structure": {name: dict(zip(UNITS, fit.views.structure, strict=True)) for name, fit in fits.items()},
        "chances": {name: fit.chances for name, fit in fits.items() if fit.chances},
        "parameters": {
            name: _statistics(fit, subs)
            for (name, fit), subs in zip(fits.items(), _by_type(camera), strict=True)
            if fit.chances and fit.views.explained.any()
        },
        "kernels": {name: fit.kernels.record() for name, fit in fits.items() if fit.kernels is not None},
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
