"""Maps of truth, best single sub-image, estimate, error and error bar, which move together.

Their arrays stand in the page compressed, as text, with the palettes by which the page's program draws them.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ommatid.figures.panels import FigureScale
from ommatid.runtime.arrays import Float32Array

LEVEL = 6  # of the compression: 9 takes twice the time for a hundredth of the size
# Colours of Matplotlib's scales at equal distances, between which the program interpolates.
PALETTES: dict[str, tuple[str, ...]] = {
    "gray": ("#000000", "#ffffff"),
    "viridis": (
        "#440154", "#48186a", "#472d7b", "#424086", "#3b528b", "#33638d", "#2c728e", "#26828e", "#21918c",
        "#1fa088", "#28ae80", "#3fbc73", "#5ec962", "#84d44b", "#addc30", "#d8e219", "#fde725",
    ),
    "RdBu_r": (
        "#053061", "#15508d", "#2870b1", "#3e8cbf", "#68abd0", "#98c8e0", "#c0dceb", "#deebf2", "#f6f7f7",
        "#fbe6da", "#fbceb7", "#f5ac8b", "#e58368", "#d25849", "#bb2a34", "#960f27", "#67001f",
    ),
}  # fmt: skip
MISSING_COLOUR = "#d81b60"  # of pixels without a value: in none of the palettes
UNSHOWN = 0.5  # per cent of the pixels that a colour scale does not distinguish
TALLEST, WIDEST = 1.1, 0.4  # height over width of a picture's box, beyond which the image gets margins


@dataclass(frozen=True)
class Panel:
    """A map with its colour scale, a figure that belongs to it, and its description in words.

    difference : names of two maps, of which this one is the difference; the page computes it
    """

    name: str
    title: str
    image: NDArray[Any]
    scale: FigureScale
    number: str
    words: str
    difference: tuple[str, str] | None = None

    @property
    def gradient(self) -> str:
        """The palette as a CSS gradient, for the legend of the map."""
        return f"linear-gradient(90deg, {', '.join(PALETTES[self.scale.colours])})"

    @property
    def short(self) -> str:
        """The title without what stands in brackets."""
        return self.title.partition(" (")[0]


TITLES = {"truth": "Truth", "estimate": "Estimate", "error": "Error", "deviation": "Error bar"}


def scales_of(runs: Sequence[Mapping[str, Float32Array]]) -> dict[str, FigureScale]:
    """Return the scales of errors and deviations of one or several runs, and under "grey" that of all other maps.

    A few outliers would take all of a scale: it leaves out UNSHOWN per cent of the values, and none of a truth.
    """
    truths = [maps["truth"] for maps in runs if "truth" in maps]
    estimates = [maps["estimate"] for maps in runs]
    return {
        "grey": FigureScale.grey(*truths) if truths else FigureScale.grey(*estimates, aside=UNSHOWN / 2),
        "error": FigureScale.signed(*(maps["error"] for maps in runs if "error" in maps), aside=UNSHOWN),
        "deviation": FigureScale.deviation(*(maps["deviation"] for maps in runs), aside=UNSHOWN),
    }


def panels(
    maps: Mapping[str, Float32Array],
    titles: Mapping[str, str],
    numbers: Mapping[str, str],
    scales: Mapping[str, FigureScale],
) -> list[Panel]:
    """Return the panels of the maps of a run, of those with a title.

    numbers : figures beside the titles, by name;  scales : as `scales_of` returns them
    """
    shown: list[Panel] = []
    for name, image in maps.items():
        scale = scales.get(name, scales["grey"])
        words = _error_words(image, scale.high) if name == "error" else value_words(image)
        difference = ("estimate", "truth") if name == "error" else None
        if name in titles:
            shown.append(Panel(name, titles[name], image, scale, numbers.get(name, ""), words, difference))
    return shown


def group(name: str, shown: list[Panel], block: int, size: tuple[int, int]) -> dict[str, Any]:
    """Return the maps of panels for the page's program.

    block : side of the pixels of a map in pixels of the image of `size`
    """
    return {
        "name": name,
        "block": block,
        "rows": size[0],
        "columns": size[1],
        "maps": [
            {
                "name": panel.name,
                "title": panel.short,
                "scale": {"palette": panel.scale.colours, "low": panel.scale.low, "high": panel.scale.high},
                "number": panel.number,
                **({} if panel.difference is not None else {"values": encoded(np.asarray(panel.image))}),
                **({} if panel.difference is None else {"difference": list(panel.difference)}),
            }
            for panel in shown
        ],
    }


def ratio(rows: int, columns: int) -> float:
    """Return height over width of the box of a picture."""
    return min(max(rows / columns, WIDEST), TALLEST)


def value_words(image: NDArray[Any]) -> str:
    """Return smallest, largest and mean value, and the number of missing values, in words."""
    known = image[np.isfinite(image)]
    if not known.size:
        return "no value is known"
    missing = image.size - known.size
    words = f"range {known.min():.4g} to {known.max():.4g}, mean {known.mean(dtype=np.float64):.4g}"
    return words + (f"; {missing} of {image.size} are missing" if missing else "")


def _error_words(error: Float32Array, limit: float) -> str:
    squares = np.square(error, dtype=np.float64)
    outside = int(np.sum(np.abs(error) > limit))
    words = f"RMS {float(np.sqrt(np.nanmean(squares))):.3g}, largest {float(np.nanmax(np.abs(error))):.3g}"
    return words + (f"; {outside} outside the colour scale, which ends at ±{limit:.3g}" if outside else "")


def encoded(values: NDArray[Any]) -> dict[str, Any]:
    """Return type and shape of an array, and its little-endian bytes, compressed by gzip, as base64 text."""
    array = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    compressed = gzip.compress(array.tobytes(), LEVEL, mtime=0)
    return {"dtype": values.dtype.name, "shape": list(values.shape), "data": base64.b64encode(compressed).decode()}


def document(groups: Sequence[Mapping[str, Any]]) -> Markup:
    """Return groups of maps that move together as JSON that can stand in HTML, with the palettes."""
    content = {"palettes": PALETTES, "missing": MISSING_COLOUR, "groups": list(groups)}
    return Markup(json.dumps(content, allow_nan=False).replace("<", "\\u003c"))
