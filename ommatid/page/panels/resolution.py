"""Resolution of an estimate beside the best single sub-image: radial spectrum, transfer function, edge response."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from ommatid.analysis import resolution
from ommatid.analysis.averaging_kernel import ErrorWindow, why_none
from ommatid.analysis.resolution import EdgeResponse, Transfer
from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.scenes.model import Model

from ..data import Run, ShownSubImage
from .charts import ChartAxis, ChartSeries, chart

LARGEST_SIDE = 1024  # of the part of an image whose spectrum is computed, in pixels
FREQUENCY = ChartAxis("cycles per pixel", low=0.0, high=0.5)

Image = FloatArray | Float32Array


def content(run: Run, model: Model, window: ErrorWindow | None, single: ShownSubImage) -> dict[str, Any]:
    """Return the charts with their titles and sentences, those that the run has, and what is left out.

    model : of f;  window : of the estimate's errors;  single : the sub-image that is shown
    """
    charts: list[tuple[str, Markup, str]] = []
    pitch = run.stack.camera.target_pitch
    if window is not None:
        sharpness, edge = resolution.of_window(window)
        sub = resolution.of_sub_image(model, window, single.name)
        charts.append(("Modulation transfer function", _transfer(sharpness, sub), transfer_words(sharpness, pitch)))
        charts.append(("Response to an edge", _edge(edge, sub), edge_words(edge, sub)))
    if run.truth is not None:
        charts.append(("Radial spectrum of the error", *_spectrum(run.truth, run.estimate, single.image)))
    return {"resolution": charts, "left_out": why_none(run.stack.scene)}


def _transfer(estimate: Transfer, sub: tuple[Transfer, EdgeResponse] | None) -> Markup:
    series = [
        ChartSeries("estimate, along rows", list(estimate.frequencies), list(estimate.horizontal), "line", 1),
        ChartSeries("along columns", list(estimate.frequencies), list(estimate.vertical), "dashed", 1),
    ]
    if sub is not None:
        values = list(sub[0].horizontal)
        series.append(ChartSeries("a pixel of the single sub-image", list(sub[0].frequencies), values, "line", 2))
    words = "contrast of waves in the estimate, by frequency"
    return chart("transfer", FREQUENCY, ChartAxis("contrast kept", low=0.0, high=1.1), series, words)


def transfer_words(transfer: Transfer, pitch: float) -> str:
    """Return where the contrast falls to half, in cycles per pixel and in line pairs per mm on the target."""
    half = transfer.half
    if half is None:
        least = min(float(transfer.horizontal[-1]), float(transfer.vertical[-1]))
        return (
            f"At the finest wave of the pixel grid, 0.5 cycles per pixel, {100 * least:.0f} % of the contrast is kept."
        )
    if half == 0:
        return "Less than half of any contrast is kept."
    on_target = f"{half / pitch:.3g} line pairs per mm on the target"
    return f"Half of the contrast is kept at {half:.2g} cycles per pixel, {on_target}."


def _edge(estimate: EdgeResponse, sub: tuple[Transfer, EdgeResponse] | None) -> Markup:
    series = [ChartSeries("estimate", list(estimate.distances), list(estimate.values), "line", 1)]
    if sub is not None:
        series.append(
            ChartSeries("a pixel of the single sub-image", list(sub[1].distances), list(sub[1].values), "line", 2)
        )
    axes = ChartAxis("distance from the edge (pixels)", low=-8, high=8), ChartAxis("mean of the pixel")
    return chart("edge", *axes, series, "mean value of pixels beside an edge from 0 to 1, by distance")


def edge_words(estimate: EdgeResponse, sub: tuple[Transfer, EdgeResponse] | None) -> str:
    """Return the distances from 10 % to 90 % of an edge."""
    if estimate.width is None:
        return "The estimate does not follow an edge."
    words = f"An edge rises from 10 % to 90 % within {estimate.width:.2g} pixels"
    if sub is None or sub[1].width is None:
        return f"{words}."
    return f"{words}, and within {sub[1].width:.2g} pixels in the single sub-image."


def _spectrum(truth: Image, estimate: Image, single: Image) -> tuple[Markup, str]:
    truth = _central(truth)
    signal, error = resolution.radial_spectrum(truth), resolution.radial_spectrum(_central(estimate) - truth)
    series = [
        ChartSeries("truth", list(signal.frequencies), list(signal.powers), "dashed", 0),
        ChartSeries("error of the estimate", list(error.frequencies), list(error.powers), "line", 1),
    ]
    other = resolution.radial_spectrum(_central(single) - truth)
    series.append(ChartSeries("error of the single sub-image", list(other.frequencies), list(other.powers), "line", 2))
    limit = resolution.crossing(signal, error)
    words = "The error is weaker than the image at all frequencies."
    if limit is not None:
        words = f"The error is as strong as the image from {limit:.2g} cycles per pixel on."
    return chart("spectrum", FREQUENCY, ChartAxis("power (squared pixel values)", True), series, words), words


def _central(image: Image) -> FloatArray:
    rows, columns = (
        slice((size - shown) // 2, (size - shown) // 2 + shown)
        for size, shown in ((size, min(size, LARGEST_SIDE)) for size in image.shape)
    )
    return np.asarray(image[rows, columns], dtype=np.float64)
