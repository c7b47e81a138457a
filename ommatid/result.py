"""Results as the Python interface returns them, stacks of one camera reconstructed in turn, and what notebooks show.

Scenes, stacks, models and results are displayed as HTML with their pictures inline.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.methods.method import Prepared
from ommatid.reconstruct.output.facts import on_topic
from ommatid.reconstruct.output.report import report_of
from ommatid.reconstruct.output.result_files import ESTIMATOR_TABLES, fingerprint_of
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.restore import Reconstruction, check_camera, restore
from ommatid.runtime.arrays import FloatArray, as_numbers
from ommatid.runtime.errors import InputError, shortened, shortened_repr
from ommatid.runtime.printable import printable
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

if TYPE_CHECKING:
    import xarray

WIDTH = 180  # CSS pixels of a picture
DISPLAY = "_repr_html_"  # the method that notebooks call
Rows = Sequence[tuple[str, str]]
Picture = tuple[str, NDArray[np.float64], tuple[float, float] | None]  # caption, image, range of values or its own


@dataclass(frozen=True, eq=False)
class Result:
    """A reconstructed image with its posterior standard deviation.

    image, deviation : (rows, columns);  truth : (rows, columns), None where it is not known
    reconstruction : the estimator's own record, with its budget of errors and `region`; None for a run read from files
    stored : run.json of a run read from files
    """

    stack: Stack
    model: Model
    image: FloatArray
    deviation: FloatArray
    truth: FloatArray | None
    reconstruction: Reconstruction | None = None
    stored: RunReport | None = None

    def __repr__(self) -> str:
        """Return title, size and errors in one line."""
        rows, columns = self.image.shape
        error = f"expected error {self.expected_mse**0.5:.3g} rms"
        measured = "" if self.mse is None else f", measured {self.mse**0.5:.3g}"
        return f"<Result '{shortened(self.stack.scene.title)}': {rows} x {columns} pixels, {error}{measured}>"

    @cached_property
    def summary(self) -> RunReport:
        """The content of run.json, with the checks of the verdict, made when it is first used."""
        if self.stored is not None:
            return self.stored
        if self.reconstruction is None:
            raise TypeError("expected a reconstruction, or the report of a run")
        report = report_of(self.stack, self.model, self.reconstruction)
        return report.with_changes(fingerprint=fingerprint_of(self.stack, self.model, self.truth))

    @property
    def expected_mse(self) -> float:
        """Expected mean squared error per pixel (Wood et al. 2005, Eq. 5), in squared units of the target."""
        made = self.reconstruction
        return self.summary.error.predicted_mse if made is None else made.expected.mse

    @property
    def mse(self) -> float | None:
        """Measured mean squared error per pixel, None without the truth."""
        made = self.reconstruction
        if made is None:
            return self.summary.error.mse
        return None if made.error is None else made.error.mse

    @property
    def trusted(self) -> bool:
        """The verdict on the error bars, with reasons in `summary.verdict`."""
        return self.summary.verdict.trusted

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML page, and return its path. Raises InputError or MachineError."""
        from ommatid.page.data import Run
        from ommatid.page.sections import page
        from ommatid.runtime.files import write_text

        run = Run(
            folder=Path(path).parent,
            report=self.summary,
            stack=self.stack,
            model=self.model,
            estimate=self.image.astype(np.float32),
            variance=np.square(self.deviation).astype(np.float32),
            truth=None if self.truth is None else self.truth.astype(np.float32),
        )
        write_text(Path(path), page(run, None, self.summary.fingerprint))
        return Path(path)

    def to_xarray(self) -> xarray.Dataset:
        """Convert to an xarray.Dataset of image, deviation and, where it is known, truth, over (row, column).

        Coordinates are millimetres on the target: heights above the camera's axis, and distances to its right in the
        image. Raises ImportError if xarray is not installed.
        """
        try:
            import xarray
        except ImportError as error:
            raise ImportError(
                "to_xarray needs xarray, which is not installed; run: pip install 'ommatid[notebook]'"
            ) from error
        camera = self.stack.camera
        heights = [camera.position(row + 0.5, 0)[1] for row in range(camera.rows)]
        widths = [-camera.position(0, column + 0.5)[0] for column in range(camera.columns)]
        images = {"image": self.image, "deviation": self.deviation}
        images |= {} if self.truth is None else {"truth": self.truth}
        return xarray.Dataset(
            {name: (("row", "column"), image) for name, image in images.items()},
            coords={
                "row": ("row", heights, {"units": "mm", "long_name": "height above the axis"}),
                "column": ("column", widths, {"units": "mm", "long_name": "distance to the right of the axis"}),
            },
            attrs={"title": self.stack.scene.title, "expected_mse": self.expected_mse},
        )

    def _repr_html_(self) -> str:
        values = 0.0, 255.0
        pictures: list[Picture] = [
            ("image", self.image, values),
            ("posterior standard deviation", self.deviation, None),
        ]
        if self.truth is not None and self.summary.error.mse is not None:
            pictures = [("truth", self.truth, values), *pictures, ("error", self.image - self.truth, None)]
        facts = on_topic(self.summary, "verdict", "error", "quality", "limit")
        return _html(self.stack.scene.title, pictures, [fact.row for fact in facts])


def _result_of(stack: Stack, model: Model, outcome: Reconstruction) -> Result:
    image, deviation = outcome.estimate.reshape(outcome.shape), np.sqrt(outcome.expected.variance)
    truth = None if outcome.truth is None else outcome.truth.reshape(outcome.shape)
    return Result(stack, model, image, deviation.reshape(outcome.shape), truth, outcome)


def check_type(name: str, value: object, expected: type, reader: str) -> None:
    """Raise InputError for an argument of another type, such as a path."""
    if not isinstance(value, expected):
        raise InputError(
            f"{name}: expected a {expected.__name__}, got {shortened_repr(value)}; read files with ommatid.{reader}"
        )


def flat_truth(truth: FloatArray, camera: Camera) -> FloatArray:
    """Return the truth flattened. Raises InputError for another shape, and for values that are not finite numbers."""
    world, image = camera.world, as_numbers(truth, "truth")
    if image.shape not in (camera.shape, (camera.unknowns,), world.shape, (world.unknowns,)):
        raise InputError(f"truth: expected {camera.rows} x {camera.columns} pixels, got an array of {image.shape}")
    if not np.isfinite(image).all():
        raise InputError("truth: expected finite values, got NaN or infinity; leave out a truth that is not known")
    return image.ravel()


NAMES = Path("the stack"), Path("the model")


class Reconstructor:
    """Reconstructs stacks of one camera with one model, one at a time; `ommatid.prepare` creates it."""

    def __init__(self, model: Model, scene: Scene | None = None) -> None:
        """Take [prior], [estimator] and [tiles] from `scene`, without one from each stack's own scene.

        Raises InputError if scene and model are of different cameras.
        """
        if scene is not None:
            check_camera(derive(scene), model, (scene.source, NAMES[1]))
        self._model, self._scene = model, scene
        self._prepared = Prepared(model)

    def __repr__(self) -> str:
        """Return the size of H in one line."""
        return f"<Reconstructor of {self._model!r}>"

    def __call__(self, stack: Stack, truth: FloatArray | None = None) -> Result:
        """Reconstruct a stack, as `ommatid.reconstruct` does.

        The error bars are those of an earlier stack where the noise variances of both are alike to a hundredth;
        `summary.diagnostics.noise_difference` then holds by how much they differ. The estimate is the stack's own.

        truth : with which the estimate is compared, (rows, columns) or (N,), of f or of a world finer than f
        Raises InputError if the stack is of another camera, or if memory does not suffice.
        """
        check_type("stack", stack, Stack, "read_stack")
        stack = self._with_estimator(stack)
        flat = None if truth is None else flat_truth(truth, stack.camera)
        check_camera(stack.camera, self._model, NAMES)
        return _result_of(stack, self._model, restore(stack, self._model, flat, prepared=self._prepared))

    def _with_estimator(self, stack: Stack) -> Stack:
        if self._scene is None:
            return stack
        changes = {table: getattr(self._scene, table) for table in ESTIMATOR_TABLES}
        return replace(stack, scene=stack.scene.model_copy(update=changes))


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
