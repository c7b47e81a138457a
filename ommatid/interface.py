"""The Python interface: the commands as functions for notebooks and scripts, with arrays in place of files.

Images are (rows, columns) float64 arrays in the units of the target, 0 to 255, row 0 at the top. There are M
measurements and N = rows x columns unknowns. A wrong scene, option or file raises InputError, and what the machine
refuses raises MachineError; both say in one sentence what was expected, what came, and what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from ommatid.batch.remote import RunObserver
from ommatid.pipeline import stages
from ommatid.reconstruct.output import result_files
from ommatid.reconstruct.output.held_out_report import HeldOutReport
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.prediction import Prediction
from ommatid.reconstruct.restore import Reconstruction
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError, MachineError, naming_source, shortened_repr
from ommatid.runtime.progress import no_progress
from ommatid.scenes import model_file
from ommatid.scenes import scene as scene_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH, Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

from . import notebook

if TYPE_CHECKING:
    import xarray

__all__ = ["InputError", "MachineError", "Model", "Scene", "Stack"]


@dataclass(frozen=True, eq=False)
class Result:
    """A reconstructed image with its posterior standard deviation.

    image, deviation : (rows, columns);  truth : (rows, columns), None where it is not known
    summary : the content of run.json
    reconstruction : the estimator's own record, with its budget of errors and `region`; None for a run read from files
    """

    stack: Stack
    model: Model
    image: FloatArray
    deviation: FloatArray
    truth: FloatArray | None
    summary: RunReport
    reconstruction: Reconstruction | None = None

    @property
    def expected_mse(self) -> float:
        """Expected mean squared error per pixel (Wood et al. 2005, Eq. 5), in squared units of the target."""
        return self.summary.error.predicted_mse

    @property
    def mse(self) -> float | None:
        """Measured mean squared error per pixel, None without the truth."""
        return self.summary.error.mse

    @property
    def trusted(self) -> bool | None:
        """The verdict on the error bars, with reasons in `summary.verdict`; None for runs of earlier versions."""
        return None if self.summary.verdict is None else self.summary.verdict.trusted

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML page, and return its path. Raises InputError or MachineError."""
        from ommatid.page.data import Run
        from ommatid.page.document import page
        from ommatid.runtime.files import write_text
        from ommatid.simulate.ideal import matrix_as_designed

        run = Run(
            folder=Path(path).parent,
            report=self.summary,
            stack=self.stack,
            model=self.model,
            estimate=self.image.astype(np.float32),
            variance=np.square(self.deviation).astype(np.float32),
            truth=None if self.truth is None else self.truth.astype(np.float32),
        )
        ideal = partial(matrix_as_designed, self.stack.camera)
        write_text(Path(path), page(run, ideal, None, self.summary.fingerprint))
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
        return notebook.result_html(self.stack.scene.title, self.image, self.deviation, self.truth, self.summary)


def read_scene(path: str | Path, set: str | Sequence[str] = (), lens: str | Sequence[str] = ()) -> Scene:
    """Read a scene file, or a scene of the gallery by its name.

    set : changes of keys, such as "noise.variance=1e-2";  lens : names of the lens types to keep, absent: all
    Raises InputError that names the file and the key.
    """
    names = lens.split(",") if isinstance(lens, str) and lens else lens
    return scene_file.read(Path(path), [set] if isinstance(set, str) else set, [name.strip() for name in names])


def read_stack(path: str | Path) -> Stack:
    """Read recorded sub-images, stack.exr. Raises InputError if the file is missing, damaged or of another kind."""
    return stack_file.read(Path(path))


def read_model(path: str | Path) -> Model:
    """Read an observation model, model.npz. Raises InputError if the file is missing, damaged or of another kind."""
    return model_file.read(Path(path))


def read_run(folder: str | Path) -> Result:
    """Read the folder of a finished run; its maps are float32.

    Raises InputError if a file is missing or damaged.
    """
    from ommatid.page.data import read_run

    run = read_run(Path(folder))
    truth = None if run.truth is None else run.truth.astype(np.float64)
    deviation = np.sqrt(run.variance.astype(np.float64))
    return Result(run.stack, run.model, run.estimate.astype(np.float64), deviation, truth, run.report)


def target_image(scene: Scene | str | Path) -> FloatArray:
    """Load the image on the target, (rows, columns), with which an estimate is compared.

    Where the scene has a world, it is rendered as an ideal pinhole camera sees it. Raises InputError.
    """
    setup = _setup(scene)
    if setup.scene.world is None:
        return setup.image
    from ommatid.simulate.ground_truth import cached_truth

    with TemporaryDirectory(prefix="ommatid-") as folder:
        return cached_truth(Path(folder) / TRUTH, setup)


def predict(scene: Scene | str | Path, rays: bool = True) -> Prediction:
    """Predict the error of a scene's run (Eq. 5), the rank of H and its null space, without rendering a picture.

    rays : False for a perfect H and a perfect rendering, in closed form
    Raises InputError if memory does not suffice.
    """
    from ommatid.analysis.predict import predict_scene

    opened = _scene(scene)
    with naming_source(opened.source):
        return predict_scene(opened, rays)


def render(scene: Scene | str | Path) -> Stack:
    """Render the sub-images of a scene: (M,) values and variances, with the sensor's noise.

    Raises InputError for a scene that cannot be rendered here.
    """
    from ommatid.simulate.cache import cached_stack
    from ommatid.simulate.validation import check_scene

    setup = _setup(scene)
    check_scene(setup, calibrates=False)
    with TemporaryDirectory(prefix="ommatid-") as folder:
        stack, _ = cached_stack(Path(folder) / "stack.exr", setup, no_progress)
    return replace(stack, scene=setup.resolved)  # which names the scene file, not the temporary one


def calibrate(scene: Scene | str | Path, stack: Stack | None = None) -> Model:
    """Find H of a scene, (M, N), with the variance of its every entry.

    stack : with calibration.samples = "auto" the stack that H is for, as in `run`; None: images drawn from the prior
    Raises InputError for a scene that cannot be calibrated here.
    """
    from ommatid.analysis.calibration_goal import for_stack
    from ommatid.simulate.cache import cached_model
    from ommatid.simulate.validation import check_scene

    setup = _setup(scene)
    with TemporaryDirectory(prefix="ommatid-") as folder:
        path = Path(folder) / "model.npz"
        if stack is None:
            model, _ = stages.calibrated_model(setup, path, no_progress)
        else:
            _check_type("stack", stack, Stack, "read_stack")
            check_scene(setup)
            if stack.camera.describe() != setup.camera.describe():
                raise InputError(f"{setup.scene.source}: expected a stack of this scene's camera, got one of another")
            model, _ = cached_model(path, setup, no_progress, for_stack(stack))
    return replace(model, scene=setup.resolved)


def reconstruct(stack: Stack, model: Model, truth: FloatArray | None = None) -> Result:
    """Reconstruct a stack as its scene says (Eq. 4), with the posterior standard deviation per pixel (Eq. 5).

    truth : with which the estimate is compared, (rows, columns) or (N,), of f or of a world finer than f
    Raises InputError if stack and model are of different cameras, or if memory does not suffice.
    """
    _check_type("stack", stack, Stack, "read_stack")
    _check_type("model", model, Model, "read_model")
    flat = None if truth is None else _flat_truth(truth, stack.camera)
    names = Path("the stack"), Path("the model")
    outcome, report = result_files.reconstruct(stack, model, flat, names)
    report = report.with_changes(fingerprint=result_files.fingerprint_of(stack, model))
    image, deviation = outcome.estimate.reshape(outcome.shape), np.sqrt(outcome.expected.variance)
    shaped = None if outcome.truth is None else outcome.truth.reshape(outcome.shape)
    return Result(stack, model, image, deviation.reshape(outcome.shape), shaped, report, outcome)


def check(stack: Stack, model: Model, *, fitted: bool = True) -> HeldOutReport:
    """Predict every sub-imager of a stack from all others, and name those that disagree; needs no truth.

    fitted : True replaces an independent prior by one fitted to the stack, since a photograph is no draw of it
    Raises InputError if stack and model are of different cameras, or if a measurement has no noise.
    """
    from ommatid.reconstruct.held_out.check import check_held_out
    from ommatid.reconstruct.output.held_out_report import held_out_report
    from ommatid.reconstruct.restore import check_match

    _check_type("stack", stack, Stack, "read_stack")
    _check_type("model", model, Model, "read_model")
    check_match(stack, model, ("the stack", "the model"))
    return held_out_report(check_held_out(stack, model, fitted=fitted))


def run(scene: Scene | str | Path, folder: str | Path) -> Result:
    """Render, calibrate, reconstruct and report into a folder; what is up to date there is not repeated.

    Raises InputError for a wrong scene, MachineError for a full disk.
    """
    stages.run(_setup(scene), Path(folder), RunObserver(lambda _: nullcontext(no_progress), lambda _stage, _made: None))
    return read_run(folder)


def _check_type(name: str, value: object, expected: type, reader: str) -> None:
    """Raise InputError for an argument of another type, such as a path."""
    if not isinstance(value, expected):
        raise InputError(
            f"{name}: expected a {expected.__name__}, got {shortened_repr(value)}; read files with ommatid.{reader}"
        )


def _flat_truth(truth: FloatArray, camera: Camera) -> FloatArray:
    """Return the truth flattened. Raises InputError for another shape, and for values that are not finite numbers."""
    world = camera.world
    try:
        image = np.asarray(truth, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"truth: expected an array of numbers, got {shortened_repr(truth)}") from error
    if image.shape not in (camera.shape, (camera.unknowns,), world.shape, (world.unknowns,)):
        raise InputError(f"truth: expected {camera.rows} x {camera.columns} pixels, got an array of {image.shape}")
    if not np.isfinite(image).all():
        raise InputError("truth: expected finite values, got NaN or infinity; leave out a truth that is not known")
    return image.ravel()


def _scene(scene: Scene | str | Path) -> Scene:
    return scene if isinstance(scene, Scene) else read_scene(scene)


def _setup(scene: Scene | str | Path) -> Setup:
    return stages.checked_setup(_scene(scene))


notebook.show_in_notebooks()
