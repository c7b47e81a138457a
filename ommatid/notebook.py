"""Scenes, stacks, models and results as HTML with their pictures inline, for notebooks."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.output.facts import on_topic
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

WIDTH = 180  # CSS pixels of a picture
DISPLAY = "_repr_html_"  # the method that notebooks call
Rows = Sequence[tuple[str, str]]
Picture = tuple[str, NDArray[np.float64], tuple[float, float] | None]  # caption, image, range of values or its own


def show_in_notebooks() -> None:
    """Add the HTML display to the classes of `scenes`, which cannot import this module: imports run one way."""
    for shown, html in ((Scene, scene_html), (Stack, stack_html), (Model, model_html)):
        setattr(shown, DISPLAY, html)


def scene_html(scene: Scene) -> str:
    """Show the picture on the target and the geometry of the lens types."""
    try:
        setup = Setup.from_scene(scene)
        camera = setup.camera
        pictures = [] if scene.target.image is None else [("target", setup.image, (0.0, 255.0))]
    except InputError as error:  # of a picture that is gone
        return _html(scene.title, [], [("error", str(error))])
    rows = [
        ("target", f"{camera.rows} x {camera.columns} pixels of {camera.target_pitch:g} mm"),
        ("distance", f"{camera.distance:g} mm"),
        ("measurements", str(camera.measurements)),
        *((f"lens type {lens.name}", _lens_words(lens)) for lens in camera.types),
    ]
    return _html(scene.title, pictures, rows)


def stack_html(stack: Stack) -> str:
    """Show the middle sub-image of each lens type, and how the stack was made."""
    images, start, pictures = stack.images(), 0, list[Picture]()
    for lens in stack.camera.types:
        middle = lens.array[0] // 2 * lens.array[1] + lens.array[1] // 2
        pictures.append((f"lens type {lens.name}", images[start + middle], (0.0, 255.0)))
        start += lens.array[0] * lens.array[1]
    rows = [("sub-images", str(len(images))), ("measurements", str(stack.camera.measurements))]
    return _html(stack.scene.title, pictures, rows + _record_rows(stack.record))


def model_html(model: Model) -> str:
    """Show H^T 1, the weight of each pixel of f in all measurements, and how H was found."""
    weight = model.adjoint(np.ones(model.measurements)).reshape(model.camera.shape)
    rows = [("H", f"{model.measurements} x {model.unknowns}, {model.entries} entries")]
    return _html(model.scene.title, [("sum of each column of H", weight, None)], rows + _record_rows(model.record))


def result_html(
    title: str,
    image: NDArray[np.float64],
    deviation: NDArray[np.float64],
    truth: NDArray[np.float64] | None,
    summary: RunReport,
) -> str:
    """Show the image, its posterior standard deviation and, where the truth is known, its error: (rows, columns)."""
    values = 0.0, 255.0
    pictures: list[Picture] = [("image", image, values), ("posterior standard deviation", deviation, None)]
    rows = [fact.row for fact in on_topic(summary, "verdict", "error", "quality", "limit")]
    if truth is not None and summary.error.mse is not None:
        pictures = [("truth", truth, values), *pictures, ("error", image - truth, None)]
    return _html(title, pictures, rows)


def png_uri(image: NDArray[np.float64], limits: tuple[float, float] | None = None) -> str:
    """Encode an image, (rows, columns), as an 8-bit PNG data URI, grey from one limit to the other, NaN as black."""
    from PIL import Image

    finite = image[np.isfinite(image)]
    low, high = limits or (float(finite.min(initial=0.0)), float(finite.max(initial=0.0)))
    grey = np.nan_to_num(255 * (image - low) / ((high - low) or 1.0), nan=0.0, posinf=255.0, neginf=0.0)
    stream = io.BytesIO()
    Image.fromarray(np.clip(np.round(grey), 0, 255).astype(np.uint8)).save(stream, format="PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def _html(title: str, pictures: Sequence[Picture], rows: Rows) -> str:
    figures = "".join(
        f'<figure style="display:inline-block;margin:4px"><img src="{png_uri(image, limits)}" alt="{escape(caption)}"'
        f' style="width:{WIDTH}px;image-rendering:pixelated"><figcaption>{escape(caption)}'
        f"{'' if limits else f', {np.nanmin(image):.3g} to {np.nanmax(image):.3g}'}</figcaption></figure>"
        for caption, image, limits in pictures
    )
    table = "".join(f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows)
    return f"<div><strong>{_text(title)}</strong><div>{figures}</div><table>{table}</table></div>"


def _text(text: str) -> str:
    return escape(printable(text))


def _record_rows(record: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [(name, str(record[name])) for name in ("method", "samples", "variant") if name in record]
    return [*rows, ("seconds", f"{record['seconds']:.3g}")] if "seconds" in record else rows


def _lens_words(lens: Any) -> str:
    array, pixels = lens.array, lens.pixels
    return f"magnification {1 / lens.ratio}, {array[0]} x {array[1]} sub-imagers of {pixels[0]} x {pixels[1]} pixels"
