"""Point-spread function of one sub-imager per lens type: a column of H at its pixels, beside the ideal one.

The source is a pixel of f of value 1, so that the response is the fraction of it that each sensor pixel records.
Sub-images are upright here, as H orders them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.model import Model, designed_observation
from ommatid.scenes.observation import Observation

from .maps import ColourScale, Panel, value_words

IdealMatrix = Callable[[SubImager], sparse.csr_array]

MARGIN = 2  # sensor pixels around the response
SMALLEST_LIMIT = 3.0  # standard errors: smallest end of the colour scale of a difference
TITLES = {"measured": "Calibrated", "ideal": "Ideal", "difference": "Difference"}


@dataclass(frozen=True)
class PointResponse:
    """Response of the central sub-imager of a lens type to the source in the centre of its field of view.

    source : row and column of f;  corner : row and column of the sub-image at which the maps begin
    maps : "measured" and, if known, "ideal" fractions, (rows, columns), and their "difference" in standard errors,
        NaN where there is no standard error
    is_exact : True if H is the ideal one
    """

    lens: str
    k: int
    l: int  # noqa: E741  (the paper's letter)
    source: tuple[int, int]
    corner: tuple[int, int]
    maps: dict[str, FloatArray]
    is_exact: bool


def responses(model: Model, ideal: IdealMatrix | None) -> list[PointResponse]:
    """Return a response per lens type.

    ideal : H of one sub-imager as designed, (its pixels, N); raises InputError if there is no closed form
    """
    return [_response(model, index, ideal) for index in range(len(model.camera.types))]


def _response(model: Model, index: int, ideal: IdealMatrix | None) -> PointResponse:
    camera, lens_type = model.camera, model.camera.types[index]
    sub = camera.sub_imager(index, lens_type.array[0] // 2, lens_type.array[1] // 2)
    row, column = (int(center) for center in lens_type.middle(sub.window))
    unknown = row * camera.columns + column
    maps: dict[str, FloatArray] = {}
    error = None
    pixels = lens_type.pixels[0] * lens_type.pixels[1]
    start = camera.type_slices()[index].start + (sub.k * lens_type.array[1] + sub.l) * pixels
    rows = slice(start, start + pixels)
    if model.stored is None:
        maps["measured"] = _applied_response(model.observation, rows, unknown).reshape(lens_type.pixels)
    else:
        maps["measured"], error = _stored_response(model, rows, unknown, lens_type.pixels)
    ideal_map = None
    if ideal is not None and not model.is_exact:
        designed = designed_observation(camera) if model.stored is None else None
        if designed is not None:
            ideal_map = _applied_response(designed, rows, unknown).reshape(lens_type.pixels)
        elif model.stored is not None:
            ideal_map = _ideal_response(ideal, sub, unknown)
    if ideal_map is not None:
        maps["ideal"] = ideal_map
        if error is not None:
            maps["difference"] = _in_standard_errors(maps["measured"] - ideal_map, error)
    shown, columns = _bounds(maps["measured"] if ideal_map is None else np.abs(maps["measured"]) + np.abs(ideal_map))
    return PointResponse(
        lens=lens_type.name,
        k=sub.k,
        l=sub.l,
        source=(row, column),
        corner=(shown.start, columns.start),
        maps={name: image[shown, columns] for name, image in maps.items()},
        is_exact=model.is_exact,
    )


def _applied_response(observation: Observation, rows: slice, column: int) -> FloatArray:
    """Return some rows of a column of H that is not stored."""
    source = np.zeros(observation.unknowns)
    source[column] = 1.0
    return observation.forward(source)[rows]


def _stored_response(model: Model, rows: slice, column: int, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return some rows of a column of H, and the standard errors of these entries."""
    matrix = model.matrix
    variances = sparse.csr_array((model.variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    shown = (each[rows][:, [column]].toarray() for each in (matrix, variances))
    response, variance = (np.asarray(each, dtype=np.float64).reshape(shape) for each in shown)
    return response, np.sqrt(variance)


def _ideal_response(ideal: IdealMatrix, sub: SubImager, column: int) -> FloatArray | None:
    try:
        matrix = ideal(sub)
    except InputError:  # no closed form
        return None
    return np.asarray(matrix[:, [column]].toarray(), dtype=np.float64).reshape(sub.type.pixels)


def _in_standard_errors(difference: FloatArray, error: FloatArray) -> FloatArray:
    """Return NaN where a difference has no standard error: entries without rays are not known to the last digit."""
    score = np.where(difference == 0, 0.0, np.nan)
    np.divide(difference, error, out=score, where=error > 0)
    return score


def _bounds(response: FloatArray) -> tuple[slice, slice]:
    """Return the rows and columns of a response with a margin; all of them if it is zero."""
    lit = response > 1e-4 * response.max(initial=0.0)
    if not lit.any():
        return slice(0, response.shape[0]), slice(0, response.shape[1])
    bounds: list[slice] = []
    for axis, size in enumerate(response.shape):
        indices = np.flatnonzero(lit.any(axis=1 - axis))
        bounds.append(slice(max(0, int(indices[0]) - MARGIN), min(size, int(indices[-1]) + 1 + MARGIN)))
    return bounds[0], bounds[1]


def titles(response: PointResponse) -> dict[str, str]:
    """Return the titles of the maps by name; an ideal H was not calibrated."""
    return {name: TITLES[name] for name in response.maps} | ({"measured": "Response"} if response.is_exact else {})


def panels(response: PointResponse) -> list[Panel]:
    """Return a panel per map: calibrated and ideal with the same colours, the difference in standard errors."""
    maps, names = response.maps, titles(response)
    high = max(float(maps[name].max()) for name in ("measured", "ideal") if name in maps) or 1.0
    shown: list[Panel] = []
    for name, image in maps.items():
        colours = ColourScale("sequential", 0.0, high, "fraction of the source")
        if name == "difference":
            limit = max(SMALLEST_LIMIT, float(np.nanmax(np.abs(image), initial=0.0)))
            colours = ColourScale("diverging", -limit, limit, "standard errors")
        values = image.astype(np.float32)
        shown.append(Panel(f"response-{response.lens}-{name}", names[name], values, colours, "", value_words(image)))
    return shown


def words(response: PointResponse) -> str:
    """Return sub-imager and source, the total and the maximum of the response, and the largest difference in words."""
    (row, column), measured = response.source, response.maps["measured"]
    words = (
        f"Sub-imager ({response.k}, {response.l}) of lens type {response.lens}, point source at row {row}, column"
        f" {column} of the target. The sub-imager records {measured.sum():.4g} of the source, its brightest pixel"
        f" {measured.max():.4g}"
    )
    ideal, difference = response.maps.get("ideal"), response.maps.get("difference")
    if ideal is not None:
        words += f"; the ideal values are {ideal.sum():.4g} and {ideal.max():.4g}"
    if difference is not None and np.isfinite(difference).any():
        most = float(np.nanmax(np.abs(difference)))
        most_words = f"differ by at most {most:.2g} standard errors" if most else "are equal"
        words += f". Calibrated and ideal values {most_words}"
    return words + "."
