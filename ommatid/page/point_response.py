"""What one sub-imager sees of a point source: a column of H at its pixels, beside the ideal one.

A source is a pixel of f of value 1, so that the response is the share of it that each sensor pixel reads. Sub-images
are upright here, as H orders them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType, SubImager
from ommatid.scenes.model import Model
from ommatid.scenes.optics.boxes import overlap

from . import plots
from .plots import Colours

Ideal = Callable[[SubImager], sparse.csr_array]
Grid = NDArray[np.float64]

MARGIN = 2  # sensor pixels around what responds
SMALLEST = 3.0  # standard errors at which the colours of a difference end, at least
KINDS = ("measured", "ideal", "difference")
TITLES = {"measured": "Measured response", "ideal": "Ideal response", "difference": "Their difference"}


@dataclass(frozen=True)
class PointResponse:
    """The middle sub-imager of a lens type and the source in the middle of its view.

    source : row and column of f;  corner : row and column of the sub-image where the maps begin
    measured, ideal : shares, (rows, columns);  difference : of the two in standard errors, NaN where there is none
    exact : whether H is the ideal one
    """

    lens: str
    k: int
    l: int  # noqa: E741  (the paper's letter)
    source: tuple[int, int]
    corner: tuple[int, int]
    measured: Grid
    ideal: Grid | None
    difference: Grid | None
    exact: bool


def responses(model: Model, ideal: Ideal | None) -> list[PointResponse]:
    """One a lens type.

    ideal : H of one sub-imager as designed, (its pixels, N);  raises InputError where there is no closed form
    """
    return [_response(model, place, kind, ideal) for place, kind in enumerate(model.camera.types)]


def _response(model: Model, place: int, kind: LensType, ideal: Ideal | None) -> PointResponse:
    camera = model.camera
    sub = camera.sub_imager(place, kind.array[0] // 2, kind.array[1] // 2)
    row, column = (int(middle) for middle in kind.middle(sub.window))
    target = row * camera.columns + column
    if model.stored is None:  # of boxes: their product
        measured, error = _of_boxes(camera, sub, row, column), None
    else:
        start = camera.type_slices()[place].start + (sub.k * kind.array[1] + sub.l) * kind.pixels[0] * kind.pixels[1]
        measured, error = _stored(model, slice(start, start + kind.pixels[0] * kind.pixels[1]), target, kind.pixels)
    perfect = None if ideal is None or model.is_exact else _perfect(ideal, sub, target)
    difference = None if perfect is None or error is None else _in_errors(measured - perfect, error)
    rows, columns = _around(measured if perfect is None else np.abs(measured) + np.abs(perfect))
    cut = np.s_[rows, columns]
    return PointResponse(
        lens=kind.name,
        k=sub.k,
        l=sub.l,
        source=(row, column),
        corner=(rows.start, columns.start),
        measured=measured[cut],
        ideal=None if perfect is None else perfect[cut],
        difference=None if difference is None else difference[cut],
        exact=model.is_exact,
    )


def _of_boxes(camera: Camera, sub: SubImager, row: int, column: int) -> Grid:
    down = overlap(sub.type.ratio, sub.type.pixels[0], sub.window[0], camera.rows)[:, [row]].toarray()
    across = overlap(sub.type.ratio, sub.type.pixels[1], sub.window[1], camera.columns)[:, [column]].toarray()
    return np.asarray(down @ across.T, dtype=np.float64)


def _stored(model: Model, rows: slice, column: int, shape: tuple[int, int]) -> tuple[Grid, Grid]:
    """A column of H at some measurements, and the standard errors of its entries."""
    matrix = model.matrix
    entries = slice(int(matrix.indptr[rows.start]), int(matrix.indptr[rows.stop]))
    chosen = np.flatnonzero(matrix.indices[entries] == column)
    pointers: NDArray[np.int64] = matrix.indptr[rows.start : rows.stop + 1].astype(np.int64)
    numbers: NDArray[np.int64] = np.arange(rows.stop - rows.start, dtype=np.int64)
    place: NDArray[np.int64] = np.repeat(numbers, np.diff(pointers))[chosen]
    found, variance = np.zeros(numbers.size), np.zeros(numbers.size)
    np.add.at(found, place, matrix.data[entries][chosen])
    np.add.at(variance, place, model.variance[entries][chosen])
    return found.reshape(shape), np.sqrt(variance).reshape(shape)


def _perfect(ideal: Ideal, sub: SubImager, column: int) -> Grid | None:
    try:
        matrix = ideal(sub)
    except InputError:  # it has no closed form
        return None
    return np.asarray(matrix[:, [column]].toarray(), dtype=np.float64).reshape(sub.type.pixels)


def _in_errors(difference: Grid, error: Grid) -> Grid:
    """NaN where an entry has no error but differs: what was never lit is not known to the last digit."""
    found = np.where(difference == 0, 0.0, np.nan)
    np.divide(difference, error, out=found, where=error > 0)
    return found


def _around(response: Grid) -> tuple[slice, slice]:
    """What responds, with a margin; all where nothing does."""
    lit = response > 1e-4 * response.max(initial=0.0)
    if not lit.any():
        return slice(0, response.shape[0]), slice(0, response.shape[1])
    found: list[slice] = []
    for axis, size in enumerate(response.shape):
        places = np.flatnonzero(lit.any(axis=1 - axis))
        found.append(slice(max(0, int(places[0]) - MARGIN), min(size, int(places[-1]) + 1 + MARGIN)))
    return found[0], found[1]


def shown(response: PointResponse) -> list[tuple[str, Grid]]:
    """The maps that there are, by kind."""
    maps = zip(KINDS, (response.measured, response.ideal, response.difference), strict=True)
    return [(kind, image) for kind, image in maps if image is not None]


def figures(response: PointResponse) -> list[Any]:
    """A figure a map: measured and ideal with the same colours, the difference in standard errors."""
    maps = dict(shown(response))
    high = max(float(maps[kind].max()) for kind in ("measured", "ideal") if kind in maps) or 1.0
    (top, left), (rows, columns) = response.corner, response.measured.shape
    view = plots.view(left, left + columns, top, top + rows)
    data = plots.source({kind: [np.ascontiguousarray(image.astype(np.float32))] for kind, image in maps.items()}, "")
    tips = [("row of the sub-image", "$y{0}"), ("column", "$x{0}")]
    tips += [(SAID[kind], f"@{kind}{{%.4g}}") for kind in maps]
    made: list[Any] = []
    for kind, image in maps.items():
        colours = Colours(plots.SEQUENTIAL, 0.0, high, "share of the source")
        if kind == "difference":
            size = max(SMALLEST, float(np.nanmax(np.abs(image), initial=0.0)))
            colours = Colours(plots.DIVERGING, -size, size, "standard errors")
        name = f"response-{response.lens}-{kind}"
        formatters = {f"@{other}": "printf" for other in maps}
        places = left, top, columns, rows
        made.append(plots.map_figure(name, data, kind, colours, view, tips, places=places, formatters=formatters))
    return made


SAID = {"measured": "measured", "ideal": "ideal", "difference": "difference in standard errors"}


def words(response: PointResponse) -> str:
    """What is shown, and how far measured and ideal go apart."""
    row, column = response.source
    told = (
        f"Sub-imager ({response.k}, {response.l}) of lens type {response.lens} and a point source at row {row}, column"
        f" {column} of the target: its pixels read {response.measured.sum():.4g} of the source all together, the"
        f" brightest {response.measured.max():.4g}"
    )
    if response.ideal is not None:
        told += f"; ideal are {response.ideal.sum():.4g} and {response.ideal.max():.4g}"
    if response.difference is not None and np.isfinite(response.difference).any():
        largest = float(np.nanmax(np.abs(response.difference)))
        told += f". Measured and ideal differ by up to {largest:.2g} standard errors in a pixel"
    return told + "."
