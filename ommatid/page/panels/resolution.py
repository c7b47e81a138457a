"""Resolution of an estimate beside the best single sub-image: the modulation transfer functions of both."""

from __future__ import annotations

from typing import Any

from ommatid.analysis import resolution
from ommatid.analysis.averaging_kernel import ErrorWindow, why_none
from ommatid.analysis.resolution import Transfer
from ommatid.scenes.model import Model

from ..data import Run, ShownSubImage
from .charts import ChartAxis, ChartSeries, chart


def content(run: Run, model: Model, window: ErrorWindow | None, single: ShownSubImage) -> dict[str, Any]:
    """Return the chart and its sentence, where the run has them, and what is left out.

    model : of f;  window : of the estimate's errors;  single : the sub-image that is shown
    """
    left_out = why_none(run.stack.scene)
    if window is None:
        return {"transfer": "", "left_out": left_out}
    found, sub = resolution.of_window(window), resolution.of_sub_image(model, window, single.name)
    series = [
        ChartSeries("estimate, along rows", list(found.frequencies), list(found.horizontal), "line", 1),
        ChartSeries("along columns", list(found.frequencies), list(found.vertical), "dashed", 1),
    ]
    if sub is not None:
        name = "a pixel of the single sub-image"
        series.append(ChartSeries(name, list(sub.frequencies), list(sub.horizontal), "line", 2))
    axes = ChartAxis("cycles per pixel", ends=(0.0, 0.5)), ChartAxis("contrast kept", ends=(0.0, 1.1))
    drawn = chart("transfer", *axes, series, "contrast of waves in the estimate, by frequency")
    words = transfer_words(found, run.stack.camera.target_pitch)
    return {"transfer": drawn, "transfer_words": words, "left_out": left_out}


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
