"""The figures of the paper (Wood, Rajan and Christensen) as plots, and two of this program: distortion, size of tiles.

Errors and noise are in squared units of f, 0 to 255. Maps are upright, with pixels of the target along both axes.
Coinciding lines are distinguished by their markers, which are at different positions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.panels import FigurePanel, FigureScale, draw_panel, show_map
from ommatid.figures.saving import SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.reconstruct.measured_error import TRIM
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.scenes.constants import WHITE

from .photographs import Photograph, TileCrops, Trials
from .tile_errors import ACTUAL, COMBINATIONS, EXPECTED, SIZES, THREE, PaperTile, TileError, Tiles, inner

LENS_COLOURS = ("tab:blue", "tab:orange", "tab:green")  # of lens types
MARKERS = ("o", "s", "^", "D")  # of expected noise variances
NOISE_COLOURS = ("#1b9e77", "#d95f02", "#7570b3", "#a6761d")  # the same
TILE_COLOURS = ("#1b9e77", "#d95f02", "#7570b3", "#e7298a", "#66a61e", "#a6761d")  # of tiles of a photograph
MARKER_STEP = 8  # actual noise variances from marker to marker
ERROR = "expected squared error per pixel (grey levels squared)"
NOISE = "actual noise variance (grey levels squared)"
GREY = FigureScale(0.0, WHITE, "gray", "grey level (0 to 255)")
RECONSTRUCTION_NOISE = 1e-2  # variance, of Fig. 6
EXPECTED_NOISE = "noise variance that\nthe estimator expects"


@own_style()
def draw_sweeps(path: Path, shown: list[PaperTile], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw Fig. 2 or 4: mean error against actual noise, whole and trimmed, one line per estimator and combination."""
    figure = new_figure(12.0, 6.0, layout="constrained")
    side = shown[0].side
    panels = figure.subplots(1, 2, sharey=True)
    for axes, trim in zip(panels, (0, TRIM), strict=True):
        for tile, colour in zip(shown, LENS_COLOURS, strict=True):
            for number, expected in enumerate(EXPECTED):
                axes.loglog(ACTUAL, _means(tile.line(expected), side, trim), color=colour, **_marker(number))
        within = f"trimmed by {trim} pixels" if trim else "full tile"
        _axes(axes, f"{side} x {side}, {within}", NOISE, f"average {ERROR}")
    colours = [({"color": colour}, tile.name) for colour, tile in zip(LENS_COLOURS, shown, strict=True)]
    _legend(panels[0], "lens types", colours)
    markers = zip(MARKERS, EXPECTED, strict=True)
    _legend(
        panels[1],
        EXPECTED_NOISE,
        [({"color": "black", "marker": marker}, _power(value)) for marker, value in markers],
    )
    figure.suptitle(f"Error of the {side} x {side} tile against noise, by lens types and by what the estimator expects")
    files.replace(figure, path)


@own_style()
def draw_maps(path: Path, shown: list[PaperTile], noise: float, files: FigureFiles = SCREEN_PNG) -> None:
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
    files.replace(figure, path)


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
def draw_sides(path: Path, shown: list[PaperTile], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw Fig. 5: tiles of several sizes with three lens types, on the same axes."""
    figure = new_figure(15.0, 5.8, layout="constrained")
    panels = figure.subplots(1, len(shown), sharey=True)
    for axes, tile in zip(panels, shown, strict=True):
        for number, (expected, colour) in enumerate(zip(EXPECTED, NOISE_COLOURS, strict=True)):
            errors = _means(tile.line(expected), tile.side, 0)
            axes.loglog(ACTUAL, errors, color=colour, label=_power(expected), **_marker(number))
        best = np.array([tile.mse(noise) for noise in map(float, ACTUAL)])
        axes.loglog(ACTUAL, best, "--", color="black", lw=1.4, label="the actual noise")
        _error_of_one(axes, best)
        lenses = ", ".join(f"1/{lens_type.ratio}" for lens_type in tile.camera.types)
        _axes(axes, f"{tile.side} x {tile.side}, lenses {lenses}", NOISE, f"average {ERROR}")
    panels[0].legend(title=EXPECTED_NOISE, fontsize=9, title_fontsize=9, loc="upper left")
    figure.suptitle(f"Error of tiles of three sizes with three lens types ({'+'.join(THREE)})")
    files.replace(figure, path)


def _error_of_one(axes: Any, best: FloatArray) -> None:
    """Mark the noise at which the best estimator's error is 1, so that tiles can be compared."""
    noise = float(np.exp(np.interp(0.0, np.log(best), np.log(ACTUAL))))
    axes.axhline(1.0, color="0.5", lw=1.0, ls=":")
    axes.plot([noise], [1.0], "*", color="black", ms=12)
    axes.annotate(
        f"error 1 at noise {noise:.2g}", (noise, 1.0), xytext=(14, -16), textcoords="offset points", fontsize=10
    )


@own_style()
def draw_distortion(path: Path, shown: list[PaperTile], noise: float, files: FigureFiles = SCREEN_PNG) -> None:
    """Draw error against noise of one lens type with and without distortion and of three types, and maps of it."""
    figure = new_figure(14.5, 5.2, layout="constrained")
    axes, *panels = figure.subplots(1, 1 + len(shown), width_ratios=(1.9, *(1.0 for _ in shown)))
    for tile, colour in zip(shown, LENS_COLOURS, strict=True):
        label = f"{tile.name}: {tile.camera.measurements} measurements"
        axes.loglog(ACTUAL, [tile.mse(float(actual)) for actual in ACTUAL], color=colour, label=label)
    axes.axvline(noise, color="0.5", lw=1.0, ls=":")
    _axes(axes, "the estimator expects the actual noise", NOISE, f"average {ERROR}")
    axes.legend(fontsize=9, loc="lower right")
    maps = [tile.matched(noise) for tile in shown]
    most = max(error.max() for error in maps if error.max() < 100 * maps[0].max())  # common, where comparable
    for panel, tile, error in zip(panels, shown, maps, strict=True):
        scale = FigureScale.positive(float(max(most, error.max())), "grey levels squared")
        title = f"{tile.name}\naverage {error.mean():.4g}"
        draw_panel(panel, FigurePanel(title, error.reshape(tile.side, tile.side), scale))
    figure.suptitle(f"Distortion as lens diversity; maps: expected squared error at noise variance {_power(noise)}")
    files.replace(figure, path)


@own_style()
def draw_reconstructions(
    path: Path,
    picture: FloatArray,
    photograph: Photograph,
    estimates: dict[str, FloatArray],
    files: FigureFiles = SCREEN_PNG,
) -> None:
    """Draw Fig. 6: a photograph with the places of its tiles, and each tile above its estimates by name, (T, N)."""
    from matplotlib.patches import Rectangle

    figure = new_figure(14.5, 6.6, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.5))
    crops, rows = photograph.crops, {"tile": photograph.crops.images, **estimates}
    side = round(crops.images.shape[1] ** 0.5)
    whole = left.subplots()
    show_map(whole, FigurePanel("", picture, GREY))
    _without_ticks(whole, "0.5")
    left.suptitle(printable_label(f"{Path(photograph.name).name}, and six tiles of {side} x {side} pixels"))
    for (row, column), colour in zip(crops.corners, TILE_COLOURS, strict=True):
        style: dict[str, Any] = {"fill": False, "edgecolor": colour, "linewidth": 3}
        whole.add_patch(Rectangle((column - 0.5, row - 0.5), side, side, **style))
    right.suptitle(f"each tile, and its estimates at noise variance {_power(RECONSTRUCTION_NOISE)}; below: their MSE")
    for panels, (name, images) in zip(right.subplots(len(rows), len(crops.corners)), rows.items(), strict=True):
        panels[0].set_ylabel(name)
        for axes, image, truth, colour in zip(panels, images, crops.images, TILE_COLOURS, strict=True):
            show_map(axes, FigurePanel("", image.reshape(side, side), GREY))
            _without_ticks(axes, colour)
            if name in estimates:
                axes.set_xlabel(f"{np.mean((image - truth) ** 2):.3g}", fontsize=9)
    files.replace(figure, path)


def _without_ticks(axes: Any, colour: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(color=colour, linewidth=2)


@own_style()
def draw_tile_sizes(
    path: Path, tiles: Tiles, frames: dict[str, float], noise: float, files: FigureFiles = SCREEN_PNG
) -> None:
    """Draw error and time against the side of a tile; frames : error of a whole frame by lens types."""
    figure = new_figure(12.0, 5.4, layout="constrained")
    errors, seconds = figure.subplots(1, 2)
    for lenses, colour in zip(COMBINATIONS, LENS_COLOURS, strict=True):
        shown = [tiles[side, lenses] for side in SIZES]
        name, style = shown[0].name, {"color": colour, "marker": "o", "ms": 5}
        errors.semilogy(SIZES, [tile.mse(noise) for tile in shown], **style)
        errors.axhline(frames[name], color=colour, ls=":")
        seconds.loglog(SIZES, [tile.seconds for tile in shown], label=name, **style)
    side = "side of the tile (target pixels)"
    title = f"noise variance {_power(noise)}; dotted: a whole frame far from its edges"
    _axes(errors, title, side, f"average {ERROR}")
    _axes(seconds, "time of the estimator, once per camera", side, "seconds of a processor")
    for axis in (seconds.xaxis, seconds.yaxis):
        log_ticks(axis)
    seconds.legend(title="lens types", fontsize=9, title_fontsize=9)
    figure.suptitle("Error and time against the size of the tile, where three lens types leave no null space")
    files.replace(figure, path)


@own_style()
def draw_photograph(path: Path, photograph: Photograph, side: int, files: FigureFiles = SCREEN_PNG) -> None:
    """Draw Fig. 7: measured and predicted errors of six tiles against noise and bits."""
    figure = new_figure(13.0, 8.0, layout="constrained")
    name = f"Six tiles of {Path(photograph.name).name}, {side} x {side} pixels each, from three lens types"
    figure.suptitle(printable_label(name))
    panels = figure.subplots(2, 2, sharex="col", sharey="row", height_ratios=(2.4, 1.0))
    experiments = (
        (
            photograph.noisy,
            [noise.variance for noise in photograph.noisy.noises],
            "Gaussian noise, as the estimator expects",
        ),
        (
            photograph.quantised,
            [float(noise.bits or 0) for noise in photograph.quantised.noises],
            r"Quantisation in steps of 256/$2^\mathrm{bits}$; the estimator expects noise of step$^2$/12",
        ),
    )
    labels = ("noise variance (grey levels squared)", "bits per measurement")
    for (errors, ratios), (trials, levels, title), label in zip(panels.T, experiments, labels, strict=True):
        _trials(errors, trials, levels, photograph.crops)
        _axes(errors, title, label, "mean squared error per pixel (grey levels squared)")
        _ratios(ratios, trials, levels)
        _axes(ratios, "", label, "measured over predicted")
    panels[0, 0].set_xscale("log")
    panels[0, 1].xaxis.get_major_locator().set_params(integer=True)
    panels[0, 0].legend(fontsize=9, loc="upper left")
    files.replace(figure, path)


def _trials(axes: Any, trials: Trials, levels: list[float], crops: TileCrops) -> None:
    for number, (colour, (row, column)) in enumerate(zip(TILE_COLOURS, crops.corners, strict=True)):
        label = f"tile at row {row}, column {column}"
        axes.semilogy(levels, trials.measured[:, number], color=colour, lw=0.9, label=label)
    axes.semilogy(levels, trials.mean, color="black", lw=1.6, marker="o", ms=4, label="mean of the six")
    axes.semilogy(levels, trials.predicted, "--", color="red", lw=2.0, label="predicted (Eq. 5)")


def _ratios(axes: Any, trials: Trials, levels: list[float]) -> None:
    for number, colour in enumerate(TILE_COLOURS):
        axes.plot(levels, trials.measured[:, number] / trials.predicted, color=colour, lw=0.9)
    axes.plot(levels, trials.mean / trials.predicted, color="black", lw=1.6, marker="o", ms=4)
    axes.axhline(1.0, color="red", ls="--", lw=2.0)
    axes.set_ylim(bottom=0.0)


def _means(line: TileError, side: int, trim: int) -> FloatArray:
    return np.array([inner(line.at(actual), side, trim) for actual in map(float, ACTUAL)])


def _marker(number: int) -> dict[str, Any]:
    start = number * MARKER_STEP // len(MARKERS)
    return {"lw": 1.3, "marker": MARKERS[number], "ms": 6, "markevery": (start, MARKER_STEP)}


def _power(value: float) -> str:
    exponent = round(np.log10(value))
    return f"$10^{{{exponent}}}$" if exponent else "1"


def _axes(axes: Any, title: str, across: str, up: str) -> None:
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.tick_params(labelleft=True, labelbottom=True)
    axes.grid(True, which="major", color="0.85", lw=0.7)


def _legend(axes: Any, title: str, entries: list[tuple[dict[str, Any], str]]) -> None:
    from matplotlib.lines import Line2D

    handles: list[Any] = [Line2D([], [], lw=1.8, **style) for style, _ in entries]
    axes.legend(handles, [name for _, name in entries], title=title, loc="lower right", fontsize=9, title_fontsize=9)
