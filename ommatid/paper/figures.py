"""The figures of the paper (Wood, Rajan and Christensen) as plots, and two of this program: distortion, size of tiles.

Every figure comes with the rows of its table, from which its curves are drawn. Errors and noise are in squared units of
f, 0 to 255. Maps are upright, with pixels of the target along both axes. Coinciding lines are distinguished by their
markers, which are at different positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.curves import Style, draw_curve, label, legend
from ommatid.figures.panels import FigurePanel, FigureScale, draw_panel, show_map
from ommatid.figures.saving import log_ticks, new_figure, own_style
from ommatid.reconstruct.measured_error import TRIM
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.runtime.study import Row
from ommatid.scenes.constants import WHITE

from .photographs import Photograph, TileCrops
from .tile_errors import ACTUAL, COMBINATIONS, EXPECTED, SIDES, SIZES, THREE, PaperTile, Tiles, sweep

Shown = tuple[Any, list[Row]]  # a figure, and the rows of its table

LENS_COLOURS = ("tab:blue", "tab:orange", "tab:green")  # of lens types
MARKERS = ("o", "s", "^", "D")  # of expected noise variances
NOISE_COLOURS = ("#1b9e77", "#d95f02", "#7570b3", "#a6761d")  # the same
TILE_COLOURS = ("#1b9e77", "#d95f02", "#7570b3", "#e7298a", "#66a61e", "#a6761d")  # of tiles of a photograph
MARKER_STEP = 8  # actual noise variances from marker to marker
ERROR = "average expected squared error per pixel (grey levels squared)"
NOISE = "actual noise variance (grey levels squared)"
GREY = FigureScale(0.0, WHITE, "gray", "grey level (0 to 255)")
RECONSTRUCTION_NOISE = 1e-2  # variance, of Fig. 6
EXPECTED_NOISE = "noise variance that\nthe estimator expects"
ACROSS, ASIDE = "actual_noise_variance", "expected_noise_variance"  # columns
MEAN: Style = {"color": "black", "linewidth": 1.6, "marker": "o", "markersize": 4}


def groups(rows: Sequence[Row], column: str) -> dict[Any, list[Row]]:
    """Return rows by their value of a column, in their order."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(row[column], []).append(row)
    return found


@own_style()
def sweeps(tiles: Tiles, side: int) -> Shown:
    """Draw Fig. 2 or 4: mean error against actual noise, whole and trimmed, one line per estimator and combination."""
    figure = new_figure(12.0, 6.0, layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    by_lenses = {tile.name: sweep(tile) for tile in (tiles[side, lenses] for lenses in COMBINATIONS)}
    columns = {"mse": "full tile", "trimmed_mse": f"trimmed by {TRIM} pixels"}
    for axes, (column, within) in zip(panels, columns.items(), strict=True):
        label(axes, f"{side} x {side}, {within}", NOISE, ERROR, "xy")
        for colour, of_lenses in zip(LENS_COLOURS, by_lenses.values(), strict=True):
            for number, curve in enumerate(groups(of_lenses, ASIDE).values()):
                draw_curve(axes, curve, ACROSS, column, color=colour, **_marker(number))
    colours = [({"color": colour}, name) for colour, name in zip(LENS_COLOURS, by_lenses, strict=True)]
    legend(panels[0], colours, title="lens types", loc="lower right")
    shown = zip(MARKERS, EXPECTED, strict=True)
    markers = [({"color": "black", "marker": marker}, _power(expected)) for marker, expected in shown]
    legend(panels[1], markers, title=EXPECTED_NOISE, loc="lower right")
    figure.suptitle(f"Error of the {side} x {side} tile against noise, by lens types and by what the estimator expects")
    return figure, [{"lenses": name} | row for name, rows in by_lenses.items() for row in rows]


@own_style()
def maps(shown: list[PaperTile], noise: float) -> Shown:
    """Draw Fig. 3: the error within the tile for each combination of lens types, and below it without the border.

    Every map has its own scale, from 0 to its maximum.
    """
    figure = new_figure(14.5, 8.8, layout="constrained")
    figure.get_layout_engine().set(wspace=0.08, hspace=0.06)
    side = shown[0].side
    for panels, trim in zip(figure.subplots(2, len(shown)), (0, TRIM), strict=True):
        for axes, tile in zip(panels, shown, strict=True):
            _error_map(axes, tile, noise, trim)
    figure.suptitle(f"Error within the {side} x {side} tile; noise variance {_power(noise)}, as the estimator expects")
    return figure, [
        {"lenses": tile.name, "row": row, "column": column, "expected_squared_error": float(error)}
        for tile in shown
        for (row, column), error in np.ndenumerate(tile.matched(noise).reshape(tile.side, tile.side))
    ]


def _error_map(axes: Any, tile: PaperTile, noise: float, trim: int) -> None:
    """Draw the error within a tile without its border of `trim` pixels, on its own scale."""
    first, last = trim, tile.side - trim
    error = tile.matched(noise).reshape(tile.side, tile.side)[first:last, first:last]
    seen = tile.camera.types_seeing()[first:last, first:last]
    where = "" if seen.all() else " where no lens sees it"
    within = f", trimmed by {trim} pixels" if trim else ""
    title = f"{tile.name}{within}\nmaximum {error.max():.4g}{where}, average {error.mean():.4g}"
    scale = FigureScale.positive(float(error.max()), "expected squared error (grey levels squared)")
    draw_panel(axes, FigurePanel(title, error, scale, place=(float(trim), float(trim), 1.0)))


@own_style()
def sides(tiles: Tiles) -> Shown:
    """Draw Fig. 5: tiles of several sizes with three lens types, on the same axes."""
    figure, rows = new_figure(15.0, 5.8, layout="constrained"), list[Row]()
    panels = figure.subplots(1, len(SIDES), sharey=True)
    for axes, tile in zip(panels, (tiles[side, THREE] for side in SIDES), strict=True):
        fixed = [{name: row[name] for name in (ASIDE, ACROSS, "mse")} for row in sweep(tile)]
        best = [{ASIDE: actual, ACROSS: actual, "mse": tile.mse(actual)} for actual in map(float, ACTUAL)]
        rows += [{"side": tile.side} | row for row in (*fixed, *best)]
        lenses = ", ".join(f"1/{lens_type.ratio}" for lens_type in tile.camera.types)
        label(axes, f"{tile.side} x {tile.side}, lenses {lenses}", NOISE, ERROR, "xy")
        curves = groups(fixed, ASIDE)
        for number, (expected, colour) in enumerate(zip(EXPECTED, NOISE_COLOURS, strict=True)):
            draw_curve(axes, curves[expected], ACROSS, "mse", color=colour, label=_power(expected), **_marker(number))
        draw_curve(axes, best, ACROSS, "mse", linestyle="--", color="black", linewidth=1.4, label="the actual noise")
        _error_of_one(axes, best)
    panels[0].legend(title=EXPECTED_NOISE, fontsize=9, title_fontsize=9, loc="upper left")
    figure.suptitle(f"Error of tiles of three sizes with three lens types ({'+'.join(THREE)})")
    return figure, rows


def _error_of_one(axes: Any, best: Sequence[Row]) -> None:
    """Mark the noise at which the best estimator's error is 1, so that tiles can be compared."""
    errors, noises = (np.log(sorted(row[column] for row in best)) for column in ("mse", ACROSS))
    noise = float(np.exp(np.interp(0.0, errors, noises)))
    axes.axhline(1.0, color="0.5", lw=1.0, ls=":")
    axes.plot([noise], [1.0], "*", color="black", ms=12)
    place: Style = {"xytext": (14, -16), "textcoords": "offset points", "fontsize": 10}
    axes.annotate(f"error 1 at noise {noise:.2g}", (noise, 1.0), **place)


@own_style()
def distortion(shown: list[PaperTile], noise: float) -> Shown:
    """Draw error against noise of one lens type with and without distortion and of three types, and maps of it."""
    figure = new_figure(14.5, 5.2, layout="constrained")
    axes, *panels = figure.subplots(1, 1 + len(shown), width_ratios=(1.9, *(1.0 for _ in shown)))
    label(axes, "the estimator expects the actual noise", NOISE, ERROR, "xy")
    rows: list[Row] = []
    for colour, tile in zip(LENS_COLOURS, shown, strict=True):
        count = tile.camera.measurements
        curve = [{"noise_variance": actual, "mse": tile.mse(actual)} for actual in map(float, ACTUAL)]
        draw_curve(axes, curve, "noise_variance", "mse", color=colour, label=f"{tile.name}: {count} measurements")
        rows += [{"lenses": tile.name, "measurements": count} | row for row in curve]
    axes.axvline(noise, color="0.5", lw=1.0, ls=":")
    axes.legend(fontsize=9, loc="lower right")
    errors = [tile.matched(noise) for tile in shown]
    most = max(error.max() for error in errors if error.max() < 100 * errors[0].max())  # common, where comparable
    for panel, tile, error in zip(panels, shown, errors, strict=True):
        scale = FigureScale.positive(float(max(most, error.max())), "grey levels squared")
        title = f"{tile.name}\naverage {error.mean():.4g}"
        draw_panel(panel, FigurePanel(title, error.reshape(tile.side, tile.side), scale))
    figure.suptitle(f"Distortion as lens diversity; maps: expected squared error at noise variance {_power(noise)}")
    return figure, rows


@own_style()
def reconstructions(picture: FloatArray, name: str, crops: TileCrops, estimates: dict[str, FloatArray]) -> Shown:
    """Draw Fig. 6: a photograph with the places of its tiles, and each tile above its estimates by name, (T, N)."""
    from matplotlib.patches import Rectangle

    figure = new_figure(14.5, 6.6, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.5))
    images = {"tile": crops.images, **estimates}
    side = round(crops.images.shape[1] ** 0.5)
    whole = left.subplots()
    show_map(whole, FigurePanel("", picture, GREY))
    _without_ticks(whole, "0.5")
    left.suptitle(printable_label(f"{Path(name).name}, and six tiles of {side} x {side} pixels"))
    for (row, column), colour in zip(crops.corners, TILE_COLOURS, strict=True):
        style: Style = {"fill": False, "edgecolor": colour, "linewidth": 3}
        whole.add_patch(Rectangle((column - 0.5, row - 0.5), side, side, **style))
    right.suptitle(f"each tile, and its estimates at noise variance {_power(RECONSTRUCTION_NOISE)}; below: their MSE")
    rows: list[Row] = []
    for panels, (lenses, shown) in zip(right.subplots(len(images), len(crops.corners)), images.items(), strict=True):
        panels[0].set_ylabel(lenses)
        errors = np.mean((shown - crops.images) ** 2, axis=1)
        for axes, image, error, colour in zip(panels, shown, errors, TILE_COLOURS, strict=True):
            show_map(axes, FigurePanel("", image.reshape(side, side), GREY))
            _without_ticks(axes, colour)
            if lenses in estimates:
                axes.set_xlabel(f"{error:.3g}", fontsize=9)
        if lenses in estimates:
            rows.append({"lenses": lenses, **crops.named(errors)})
    return figure, rows


def _without_ticks(axes: Any, colour: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(color=colour, linewidth=2)


@own_style()
def tile_sizes(tiles: Tiles, frames: dict[str, float], noise: float) -> Shown:
    """Draw error and time against the side of a tile; frames : error of a whole frame by lens types."""
    shown = [tiles[side, lenses] for side, lenses in product(SIZES, COMBINATIONS)]
    rows: list[Row] = [
        {"lenses": tile.name, "side": tile.side, "mse": tile.mse(noise), "mse_of_frame": frames[tile.name]}
        | {"seconds": tile.seconds}
        for tile in shown
    ]
    figure = new_figure(12.0, 5.4, layout="constrained")
    errors, seconds = figure.subplots(1, 2)
    side = "side of the tile (target pixels)"
    label(errors, f"noise variance {_power(noise)}; dotted: a whole frame far from its edges", side, ERROR, "y")
    label(seconds, "time of the estimator, once per camera", side, "seconds of a processor", "xy")
    for axis in (seconds.xaxis, seconds.yaxis):
        log_ticks(axis)
    for colour, (name, own) in zip(LENS_COLOURS, groups(rows, "lenses").items(), strict=True):
        style: Style = {"color": colour, "marker": "o", "markersize": 5, "label": name}
        draw_curve(errors, own, "side", "mse", **style)
        errors.axhline(own[0]["mse_of_frame"], color=colour, ls=":")
        draw_curve(seconds, own, "side", "seconds", **style)
    seconds.legend(title="lens types", fontsize=9, title_fontsize=9)
    figure.suptitle("Error and time against the size of the tile, where three lens types leave no null space")
    return figure, rows


@own_style()
def photograph(shown: Photograph, side: int) -> Shown:
    """Draw Fig. 7: measured and predicted errors of six tiles against noise and bits, and their ratios."""
    figure, rows = new_figure(13.0, 8.0, layout="constrained"), list[Row]()
    title = f"Six tiles of {Path(shown.name).name}, {side} x {side} pixels each, from three lens types"
    figure.suptitle(printable_label(title))
    panels = figure.subplots(2, 2, sharex="col", sharey="row", height_ratios=(2.4, 1.0))
    quantised = r"Quantisation in steps of 256/$2^\mathrm{bits}$; the estimator expects noise of step$^2$/12"
    for (errors, ratios), (x, words, title, log) in zip(
        panels.T,
        (
            ("noise_variance", "noise variance (grey levels squared)", "Gaussian noise, as the estimator expects", "x"),
            ("bits", "bits per measurement", quantised, ""),
        ),
        strict=True,
    ):
        own = (shown.quantised if x == "bits" else shown.noisy).rows(shown.crops)
        label(errors, title, words, "mean squared error per pixel (grey levels squared)", f"{log}y")
        label(ratios, "", words, "measured over predicted", log)
        rows += own
        looks: list[tuple[str, str, Style]] = []
        for column, (top, left), colour in zip(shown.crops.columns, shown.crops.corners, TILE_COLOURS, strict=True):
            looks.append((column, f"tile at row {top}, column {left}", {"color": colour, "linewidth": 0.9}))
        looks.append(("mean", "mean of the six", MEAN))
        relative = [row | {column: row[column] / row["predicted"] for column, _, _ in looks} for row in own]
        for column, name, style in looks:
            draw_curve(errors, own, x, column, label=name, **style)
            draw_curve(ratios, relative, x, column, **style)
        draw_curve(errors, own, x, "predicted", linestyle="--", color="red", linewidth=2.0, label="predicted (Eq. 5)")
        ratios.axhline(1.0, color="red", ls="--", lw=2.0)
        ratios.set_ylim(bottom=0.0)
    panels[0, 1].xaxis.get_major_locator().set_params(integer=True)
    panels[0, 0].legend(fontsize=9, loc="upper left")
    return figure, rows


def _marker(number: int) -> Style:
    start = number * MARKER_STEP // len(MARKERS)
    return {"linewidth": 1.3, "marker": MARKERS[number], "markersize": 6, "markevery": (start, MARKER_STEP)}


def _power(value: float) -> str:
    exponent = round(np.log10(value))
    return f"$10^{{{exponent}}}$" if exponent else "1"
