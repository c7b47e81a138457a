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

from ommatid.reconstruct.output.facts import METHODS
from ommatid.runtime.arrays import Float32Array
from ommatid.scenes.constants import WHITE

from ..data import ResultMaps

UNIT = "pixel value"
LEVEL = 6  # of the compression: 9 takes twice the time for a hundredth of the size
# Colours at equal distances, between which the program interpolates: viridis and the reversed RdBu of Matplotlib.
PALETTES: dict[str, tuple[str, ...]] = {
    "grey": ("#000000", "#ffffff"),
    "sequential": (
        "#440154", "#48186a", "#472d7b", "#424086", "#3b528b", "#33638d", "#2c728e", "#26828e", "#21918c",
        "#1fa088", "#28ae80", "#3fbc73", "#5ec962", "#84d44b", "#addc30", "#d8e219", "#fde725",
    ),
    "diverging": (
        "#053061", "#15508d", "#2870b1", "#3e8cbf", "#68abd0", "#98c8e0", "#c0dceb", "#deebf2", "#f6f7f7",
        "#fbe6da", "#fbceb7", "#f5ac8b", "#e58368", "#d25849", "#bb2a34", "#960f27", "#67001f",
    ),
}  # fmt: skip
MISSING_COLOUR = "#d81b60"  # of pixels without a value: in none of the palettes
SHOWN = 99.5  # per cent of the pixels that a colour scale distinguishes; a few outliers would take all of its range
TALLEST, WIDEST = 1.1, 0.4  # height over width of a picture's box, beyond which the image gets margins


@dataclass(frozen=True)
class ColourScale:
    """The name of a palette, the values at its ends, and the name of the quantity."""

    palette: str
    low: float
    high: float
    unit: str

    @property
    def gradient(self) -> str:
        """The palette as a CSS gradient, for the legend of a map."""
        return f"linear-gradient(90deg, {', '.join(PALETTES[self.palette])})"

    def plain(self) -> dict[str, Any]:
        """Return the scale in JSON's types."""
        return {"palette": self.palette, "low": self.low, "high": self.high, "unit": self.unit}


@dataclass(frozen=True)
class Panel:
    """A map with its colour scale, a figure that belongs to it, and its description in words.

    difference : names of two maps, of which this one is the difference; the page computes it
    """

    name: str
    title: str
    image: NDArray[Any]
    colours: ColourScale
    number: str
    words: str
    difference: tuple[str, str] | None = None

    @property
    def short(self) -> str:
        """The title without what stands in brackets."""
        return self.title.partition(" (")[0]


def panels(maps: ResultMaps, single: str, numbers: dict[str, str] | None = None) -> list[Panel]:
    """Return the panels in order; those that need the truth only if it is known.

    single : title of the sub-image;  numbers : figures beside the titles, by name
    The images of other methods come last.
    """
    beside = numbers or {}
    grey = grey_scale([maps.estimate], sure=False) if maps.truth is None else grey_scale([maps.truth])
    pictures = {"truth": maps.truth, "single": maps.single, "estimate": maps.estimate}
    titles = {"truth": "Truth", "single": single, "estimate": "Estimate"}
    shown = [
        Panel(name, titles[name], picture, grey, beside.get(name, ""), value_words(picture))
        for name, picture in pictures.items()
        if picture is not None
    ]
    if maps.error is not None:
        limit = largest([np.abs(maps.error)])
        colours = ColourScale("diverging", -limit, limit, "estimate minus truth")
        words = _error_words(maps.error, limit)
        shown.append(
            Panel("error", "Error", maps.error, colours, beside.get("error", ""), words, ("estimate", "truth"))
        )
    colours = ColourScale("sequential", 0.0, largest([maps.deviation]), "posterior standard deviation")
    words = value_words(maps.deviation)
    shown.append(Panel("deviation", "Error bar", maps.deviation, colours, beside.get("deviation", ""), words))
    for name, picture in maps.others.items():
        shown.append(Panel(name, _title(name), picture, grey, beside.get(name, ""), value_words(picture)))
    return shown


def _title(method: str) -> str:
    name = METHODS[method]
    return f"{name[:1].upper()}{name[1:]}"


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
                "scale": panel.colours.plain(),
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


def _range(image: Float32Array, aside: float) -> tuple[float, float]:
    """Return the range of an image without `aside` per cent of the values at either end."""
    known = image[np.isfinite(image)]
    if not known.size:
        return 0.0, WHITE
    low, high = (float(end) for end in np.percentile(known, [aside, 100 - aside]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def grey_scale(images: Sequence[Float32Array], sure: bool = True) -> ColourScale:
    """Return the grey scale of images of one target; `sure` False leaves out a few values at either end."""
    ends = [_range(image, 0.0 if sure else (100 - SHOWN) / 2) for image in images]
    return ColourScale("grey", min(low for low, _ in ends), max(high for _, high in ends), UNIT)


def largest(images: Sequence[Float32Array]) -> float:
    """Return the end of a scale of magnitudes: the largest of nearly all pixels of any of the images, 1 for zeros."""
    known = [image[np.isfinite(image)] for image in images]
    return max((float(np.percentile(values, SHOWN)) for values in known if values.size), default=0.0) or 1.0


def encoded(values: NDArray[Any]) -> dict[str, Any]:
    """Return type and shape of an array, and its little-endian bytes, compressed by gzip, as base64 text."""
    array = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    compressed = gzip.compress(array.tobytes(), LEVEL, mtime=0)
    return {"dtype": values.dtype.name, "shape": list(values.shape), "data": base64.b64encode(compressed).decode()}


def document(groups: Sequence[Mapping[str, Any]]) -> Markup:
    """Return groups of maps that move together as JSON that can stand in HTML, with the palettes."""
    content = {"palettes": PALETTES, "missing": MISSING_COLOUR, "groups": list(groups)}
    return Markup(json.dumps(content, allow_nan=False).replace("<", "\\u003c"))
