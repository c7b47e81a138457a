"""Panels of a result for a slide or a publication: chosen, cropped, with a scale bar, on light or dark ground.

All panels show the same part of the target. Those of grey levels have one scale; below each row of panels of one scale
stands its bar. The scale bar is a length on the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from math import floor, log10
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.panels import FigurePanel, FigureScale, show_map
from ommatid.figures.saving import SLIDE, figure_format, new_figure, own_style, save_figure
from ommatid.figures.sensor_drawing import length_words, write_beside
from ommatid.runtime.errors import InputError, naming_source, shortened
from ommatid.runtime.outputs.kinds import check_output
from ommatid.runtime.printable import printable_label
from ommatid.scenes import stack as stack_file

from ..restore import check_region
from . import run_json
from .overview import placed_sub_image, result_panels
from .result_files import ESTIMATE, STACK, Region, check_run_folder, read_estimate

PANELS = ("truth", "sub-image", "estimate", "error", "deviation")
SIDE, GAP, EDGE = 3.0, 0.3, 0.25  # inches: widest and tallest panel, between panels, around all
TITLE, FOOT = 0.65, 0.75  # inches above the panels and below them
BAR, INSET, LENGTH = 0.13, 0.1, 0.06  # inches: height of a bar, what it is shorter at either end, height of a scale bar
MOST_OF_WIDTH = 0.35  # that the scale bar may take
MOST_SHOWN = 1000  # rows and columns of a map: a panel at 300 dots per inch has 900
FRAME: dict[str, Any] = {"color": "#808080", "linewidth": 0.5}
LIGHT, DARK = ("#ffffff", "#000000"), ("#14181c", "#f2f2f2")  # ground, ink


def write_slide(
    folder: Path,
    path: Path,
    names: Sequence[str] = (),
    crop: Region | None = None,
    dark: bool = False,
) -> tuple[str, ...]:
    """Draw panels of the run in a folder into a file of the format of its suffix, and return their names.

    names : some of PANELS, none for all that the run has;  crop : the part of the target, None for all of it
    Raises InputError for a folder without a run, unknown panels, or a part outside, and MachineError.
    """
    chosen, kind = _known(names), figure_format(path)
    check_output(path, *check_run_folder(folder))
    stack = stack_file.read(folder / STACK)
    panels = result_panels(read_estimate(folder / ESTIMATE).channels)
    best = run_json.read(folder).single
    panels["sub-image"] = placed_sub_image(stack, best and best.sub_imager, panels["estimate"].scale)
    missing = [name for name in chosen if name not in panels]
    if missing:
        rest = ", ".join(name for name in PANELS if name in panels)
        raise InputError(f"--panels {missing[0]}: {folder}: the true image is not known; choose some of {rest}")
    region = crop or ((0, 0), stack.camera.shape)
    with naming_source(Path("--crop")):
        check_region(*region, stack.camera.shape)
    names = chosen or tuple(name for name in PANELS if name in panels)
    figure = slide([_cropped(panels[name], region) for name in names], region, stack.camera.target_pitch, dark)
    save_figure(figure, path, (kind,), SLIDE)
    return names


def _known(names: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in PANELS:
            raise InputError(f"--panels: expected some of {', '.join(PANELS)}, got '{shortened(name)}'")
    return tuple(dict.fromkeys(names))


def _cropped(panel: FigurePanel, region: Region) -> FigurePanel:
    """Return a panel of the part that is shown, with a scale of its own unless it is grey, and its RMS below its title.

    A sub-image stays whole, as the edges of its pixels need not be those of the part.
    """
    if panel.place != (0.0, 0.0, 1.0):
        return panel
    (row, column), (rows, columns) = region
    part = panel.image[row : row + rows, column : column + columns]
    shown = replace(panel, image=part, place=(float(row), float(column), 1.0))
    if panel.scale.colours == "gray":
        return shown
    signed = panel.scale.low < 0
    scale = FigureScale.signed(part) if signed else FigureScale.positive(float(part.max()), panel.scale.label)
    title = f"{panel.title.partition(':')[0]}\nRMS {float(np.sqrt(np.mean(part**2))):.3g} grey levels"
    return replace(shown, scale=scale, title=title)


@own_style()
def slide(panels: Sequence[FigurePanel], region: Region, pitch: float, dark: bool) -> Any:
    """Draw panels of one part of the target side by side, as a Matplotlib figure; pitch : of its pixels, mm."""
    (row, column), (rows, columns) = region
    ground, ink = DARK if dark else LIGHT
    scale = SIDE / max(rows, columns)
    wide, tall = max(columns * scale, SIDE / 2), max(rows * scale, SIDE / 4)
    width, height = 2 * EDGE + len(panels) * (wide + GAP) - GAP, TITLE + tall + FOOT
    figure = new_figure(width, height, facecolor=ground)
    lefts = [EDGE + number * (wide + GAP) for number in range(len(panels))]
    for number, (left, panel) in enumerate(zip(lefts, panels, strict=True)):
        axes = figure.add_axes((left / width, FOOT / height, wide / width, tall / height), facecolor=ground)
        show_map(axes, panel, MOST_SHOWN)
        axes.set(xlim=(column - 0.5, column + columns - 0.5), ylim=(row + rows - 0.5, row - 0.5), xticks=[], yticks=[])
        axes.spines[:].set(**FRAME)
        if number == 0:
            _draw_scale_bar(axes, region, pitch, LENGTH * rows / tall)
        for offset, size, words in zip((0.36, 0.12), (13, 10), panel.title.split("\n"), strict=False):
            place = (left + wide / 2) / width, (FOOT + tall + offset) / height
            figure.text(*place, printable_label(words), ha="center", va="center", fontsize=size, color=ink)
    for scale_of, run in groupby(zip(lefts, panels, strict=True), key=lambda pair: pair[1].scale):
        places = [left for left, _ in run]
        across = places[-1] + wide - places[0] - 2 * INSET
        _draw_bar(figure, ((places[0] + INSET) / width, across / width), height, scale_of, ink)
    return figure


def _draw_bar(figure: Any, place: tuple[float, float], height: float, scale: FigureScale, ink: str) -> None:
    """Draw the bar of a scale below its panels; place : left end and width, as shares of the figure's."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes((place[0], (FOOT - 0.12 - BAR) / height, place[1], BAR / height))
    colours = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
    bar = figure.colorbar(colours, cax=axes, orientation="horizontal")
    bar.set_label(scale.label, fontsize=9, color=ink, labelpad=1)
    bar.outline.set(**FRAME)
    axes.tick_params(labelsize=9, colors=ink, length=2, pad=1)
    axes.xaxis.get_major_locator().set_params(nbins=5)


def _draw_scale_bar(axes: Any, region: Region, pitch: float, thick: float) -> None:
    """Draw a round length on the target at the bottom left, legible on every grey; thick : in pixels of the target."""
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    (row, column), (rows, columns) = region
    length = round_length(MOST_OF_WIDTH * columns * pitch)
    corner = column - 0.5 + 2 * thick, row - 0.5 + rows - 3 * thick
    style: dict[str, Any] = {"facecolor": "white", "edgecolor": "black", "linewidth": 0.8}
    axes.add_patch(Rectangle(corner, length / pitch, thick, **style))
    outline = [withStroke(linewidth=2.5, foreground="black")]
    words = length_words(length)
    write_beside(axes, words, corner, (0.5, 3), color="white", fontsize=10, va="bottom", path_effects=outline)


def round_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above `most`."""
    power = 10.0 ** floor(log10(most))
    return max(step * power for step in (1, 2, 5) if step * power <= most * (1 + 1e-9))
