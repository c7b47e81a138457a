"""The Python interface: the commands as functions for notebooks and scripts, with arrays in place of files.

Images are (rows, columns) float64 arrays in the units of the target, 0 to 255, row 0 at the top. There are M
measurements and N = rows x columns unknowns. A wrong scene, option or file raises InputError, and what the machine
refuses raises MachineError; both say in one sentence what was expected, what came, and what to do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike

from ommatid.batch.remote import SILENT
from ommatid.pipeline import stages
from ommatid.reconstruct.output.run_json import HeldOutReport
from ommatid.reconstruct.prediction import Prediction
from ommatid.reconstruct.restore import check_camera
from ommatid.result import Reconstructor
from ommatid.runtime.arrays import FloatArray, as_numbers
from ommatid.runtime.errors import InputError, MachineError, naming_source
from ommatid.runtime.progress import no_progress
from ommatid.scenes import model_file
from ommatid.scenes import scene as scene_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH, Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.toml import changes_of

from .result import Result, check_type, show_in_notebooks

__all__ = ["InputError", "MachineError", "Model", "Reconstructor", "Result", "Scene", "Stack"]


def read_scene(
    path: str | Path,
    set: Mapping[str, object] | str | Sequence[str] = (),
    lens: str | Sequence[str] = (),
    allow_outside: bool = False,
) -> Scene:
    """Read a scene file, or a scene of the gallery by its name.

    set : keys with their values, {"noise.variance": 1e-2}, None to remove a key; or as texts, ["noise.variance=1e-2"]
    lens : names of the lens types to keep, absent: all
    allow_outside : True if the files of its world may be outside the folder of the world's file
    Raises InputError that names the file and the key.
    """
    names = lens.split(",") if isinstance(lens, str) and lens else lens
    given = changes_of(set) if isinstance(set, Mapping) else [set] if isinstance(set, str) else set
    changes = [*given, *([scene_file.ALLOW_OUTSIDE] if allow_outside else ())]
    return scene_file.read(Path(path), changes, [name.strip() for name in names])


def read_stack(path: str | Path) -> Stack:
    """Read recorded sub-images, stack.exr. Raises InputError if the file is missing, damaged or of another kind."""
    return stack_file.read(Path(path))


def read_model(path: str | Path) -> Model:
    """Read an observation model, model.npz. Raises InputError if the file is missing, damaged or of another kind."""
    return model_file.read(Path(path))


def read_result(folder: str | Path) -> Result:
    """Read the folder of a finished run; its maps are float32.

    Raises InputError if a file is missing or damaged.
    """
    from ommatid.page.data import read_run

    run = read_run(Path(folder))
    truth = None if run.truth is None else run.truth.astype(np.float64)
    deviation = np.sqrt(run.variance.astype(np.float64))
    return Result(run.stack, run.model, run.estimate.astype(np.float64), deviation, truth, stored=run.report)


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
    """Render the sub-images of a scene: (M,) values with the sensor's noise, and their variances.

    Raises InputError for a scene that cannot be rendered here.
    """
    from ommatid.simulate.render import cached_stack
    from ommatid.simulate.validation import check_scene

    setup = _setup(scene)
    check_scene(setup, calibrates=False)
    with TemporaryDirectory(prefix="ommatid-") as folder:
        stack, _ = cached_stack(Path(folder) / "stack.exr", setup, no_progress)
    return replace(stack, scene=setup.resolved)  # which names the scene file, not the temporary one


def stack(scene: Scene | str | Path, arrays: Mapping[str, ArrayLike]) -> Stack:
    """Make a stack of sub-images that are arrays already, in units of f and upright.

    arrays : by lens type, (rows, columns of the lens array, rows, columns of a sub-image) each, as `Stack.arrays`
        returns them; NaN marks dead pixels
    Raises InputError for a scene with a [sensor], and for missing arrays, other names, shapes or infinite values.
    """
    return stack_file.stack_from_arrays(_scene(scene), arrays)


def observe(model: Model, images: ArrayLike, seed: int, scene: Scene | str | Path | None = None) -> Stack | list[Stack]:
    """Record given images without rendering: H f with the sensor's noise, bits and saturation.

    images : (rows, columns) for one stack, (..., rows, columns) for a list of stacks in the order of the leading axes;
        on the grid of H, in units of f
    seed : of the noise; each of several images has streams of its own, which follow from the seed and its number
    scene : whose [noise] or [sensor] records, and whose [prior] and [estimator] apply later; None: that of the model
    Raises InputError for other shapes, for values that are not finite, and if scene and model are of different cameras.
    """
    from ommatid.simulate.render import observed_stacks

    check_type("model", model, Model, "read_model")
    setup = Setup.from_scene(model.scene if scene is None else _scene(scene))
    check_camera(setup.camera, model, (setup.scene.source, "the model"))
    stacks = observed_stacks(setup, model, as_numbers(images, "images"), seed)
    return stacks[0] if np.ndim(images) == 2 else stacks


def calibrate(scene: Scene | str | Path, stack: Stack | None = None) -> Model:
    """Find H of a scene, (M, N), with the variance of its every entry.

    stack : with calibration.samples = "auto" the stack that H is for, as in `run`; None: images drawn from the prior
    Raises InputError for a scene that cannot be calibrated here.
    """
    setup = _setup(scene)
    if stack is not None:
        check_type("stack", stack, Stack, "read_stack")
        if stack.camera.describe() != setup.camera.describe():
            raise InputError(f"{setup.scene.source}: expected a stack of this scene's camera, got one of another")
    with TemporaryDirectory(prefix="ommatid-") as folder:
        model, _ = stages.calibrated_model(setup, Path(folder) / "model.npz", no_progress, stack)
    return replace(model, scene=setup.resolved)


def reconstruct(stack: Stack, model: Model, truth: FloatArray | None = None) -> Result:
    """Reconstruct a stack as its scene says (Eq. 4), with the posterior standard deviation per pixel (Eq. 5).

    truth : with which the estimate is compared, (rows, columns) or (N,), of f or of a world finer than f
    Raises InputError if stack and model are of different cameras, or if memory does not suffice.
    """
    check_type("stack", stack, Stack, "read_stack")
    check_type("model", model, Model, "read_model")
    return Reconstructor(model)(stack, truth)


def prepare(model: Model, scene: Scene | str | Path | None = None) -> Reconstructor:
    """Prepare the reconstruction of many stacks with one model: `reconstructor = prepare(model, scene)`.

    Then `reconstructor(stack)` returns what `reconstruct(stack, model)` does. Preconditioner, factorisation and error
    bars are computed for the first stack, and again only for one whose noise differs.

    scene : whose [prior], [estimator] and [tiles] apply to every stack; None: those of each stack's own scene
    Raises InputError if scene and model are of different cameras.
    """
    check_type("model", model, Model, "read_model")
    return Reconstructor(model, None if scene is None else _scene(scene))


def check(stack: Stack, model: Model, *, fitted: bool = True) -> HeldOutReport:
    """Predict every sub-imager of a stack from all others, and name those that disagree; needs no truth.

    fitted : True replaces an independent prior by one fitted to the stack, since a photograph is no draw of it
    Raises InputError if stack and model are of different cameras, or if a measurement has no noise.
    """
    from ommatid.reconstruct.held_out.check import check_held_out

    check_type("stack", stack, Stack, "read_stack")
    check_type("model", model, Model, "read_model")
    check_camera(stack.camera, model, ("the stack", "the model"))
    return check_held_out(stack, model, fitted=fitted)


def run(scene: Scene | str | Path, folder: str | Path) -> Result:
    """Render, calibrate, reconstruct and report into a folder; what is up to date there is not repeated.

    Raises InputError for a wrong scene, MachineError for a full disk.
    """
    stages.SceneWork(stages.run)(_setup(scene), Path(folder), SILENT)
    return read_result(folder)


def _scene(scene: Scene | str | Path) -> Scene:
    return scene if isinstance(scene, Scene) else read_scene(scene)


def _setup(scene: Scene | str | Path) -> Setup:
    return stages.checked_setup(_scene(scene))


show_in_notebooks()
