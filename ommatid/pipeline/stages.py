"""The stages of a scene. Each reads and writes files in the scene's folder; those up to date are not made again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ommatid.batch.batch import RENDERED, Member, check_files, clear_results, prepare
from ommatid.batch.remote import RunObserver, Stages
from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.machine import one_thread
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup

if TYPE_CHECKING:
    from ommatid.reconstruct.output.estimate_formats import Format
    from ommatid.reconstruct.output.run_json import RunReport
    from ommatid.scenes.model import Model
    from ommatid.scenes.stack import Stack


@dataclass(frozen=True)
class StageResults:
    """What the stages of a run made or found in its folder; `report` has the time of the page once it is written."""

    report: RunReport
    stack: Stack
    model: Model

    @classmethod
    def read(cls, folder: Path) -> StageResults:
        """Read those of a finished run. Raises InputError."""
        from ommatid.reconstruct.output import run_json
        from ommatid.scenes import model_file
        from ommatid.scenes import stack as stack_file

        return cls(run_json.read(folder), stack_file.read(folder / "stack.exr"), model_file.read(folder / "model.npz"))


def open_scene(path: Path, changes: Sequence[str] = (), lenses: Sequence[str] = ()) -> Setup:
    """Read a scene, and check it, its camera and its target image, before anything is written. Raises InputError."""
    return checked_setup(read(path, changes, lenses))


def checked_setup(scene: Scene) -> Setup:
    """Derive the camera of a scene and load its image, if it names one. Raises InputError if either cannot be done."""
    setup = Setup.from_scene(scene)  # first, since it is fast and finds most errors
    if scene.world is not None:
        from ommatid.simulate.renderer.world import files

        files(scene)
    without_picture = scene.target.image is None and scene.world is None
    return setup if without_picture else replace(setup, given_image=setup.picture)


def open_member(member: Member) -> Setup:
    """Check a scene of a batch, its camera and its target image, before anything is written. Raises InputError."""
    return checked_setup(member.content)


def run(
    setup: Setup, folder: Path, observer: RunObserver, force: bool = False, baselines: bool = False
) -> dict[str, Any]:
    """Execute all stages of a scene, here or on a worker, and return the content of run.json.

    force : True to make again what is up to date;  baselines : True to compare with other methods
    """
    return finish(results(setup, folder, observer, force), folder, observer, baselines).plain()


@dataclass(frozen=True)
class SceneWork:
    """Stages, and what else is done with a scene, even if its results are up to date, by one process at a time.

    formats : of the estimate;  figures : files of the figures
    A scene that is refused before it is rendered leaves nothing in its folder.
    """

    stages: Stages
    formats: tuple[Format, ...] = ()
    figures: FigureFiles = SCREEN_PNG

    def __call__(self, setup: Setup, folder: Path, observer: RunObserver) -> dict[str, Any]:
        """Do the work, here or on a worker, and return the description."""
        with occupied(folder, RENDERED):
            description = self.stages(setup, folder, observer)
            if self.figures != SCREEN_PNG:
                write_figures(folder, self.figures)
            if self.formats:
                from ommatid.reconstruct.output.estimate_formats import write_formats

                write_formats(folder / "estimate.exr", self.formats)
            return description


def write_figures(folder: Path, figures: FigureFiles) -> None:
    """Write the figures of a finished run in these files. Raises InputError or MachineError."""
    from ommatid.analysis.depth_error import PICTURE, draw
    from ommatid.reconstruct.output import run_json
    from ommatid.reconstruct.output.overview import write_overview
    from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate
    from ommatid.scenes import stack as stack_file

    report, stack = run_json.read(folder), stack_file.read(folder / "stack.exr")
    write_overview(folder, stack, read_estimate(folder / ESTIMATE).channels, report, figures)
    if report.depth:
        draw(folder / PICTURE, stack.camera, report.depth, files=figures)


def with_baselines(results: StageResults, folder: Path, progress: Progress) -> StageResults:
    """Compare results with other methods, unless they were. Raises InputError where the truth is not known."""
    from ommatid.analysis.baselines import cached_baselines
    from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate

    truth = read_estimate(folder / ESTIMATE).channels.get("truth")
    if truth is None:
        raise InputError(f"{folder}: --baselines compares with the truth, which is not known here; leave it out")
    report, files = results.report, (results.stack, results.model)
    found = cached_baselines(folder, report.fingerprint, *files, truth.astype("float64"), progress)
    return replace(results, report=report.with_changes(baselines=found.reports))


def check_run(setup: Setup, folder: Path) -> None:
    """Raise InputError for what would stop a run of a scene after some work. Nothing is written."""
    from ommatid.analysis.study import check_study
    from ommatid.reconstruct.method_choice import choose_method
    from ommatid.simulate.renderer.variant import check_transport_variant, choose
    from ommatid.simulate.validation import check_scene

    scene, camera = setup.scene, setup.camera
    check_scene(setup)
    if scene.study is not None and "transport" in scene.study.models:
        with naming_source(scene.source):
            check_transport_variant(choose(scene.render.variant), "study.models")
    choose_method(scene, camera, setup.is_applied)  # checks the memory before any work
    check_study(scene, camera)
    check_files(setup, folder)


def results(setup: Setup, folder: Path, observer: RunObserver, force: bool = False) -> StageResults:
    """Execute all stages of a scene but write neither its page nor run.json; force : to make them all again."""
    with observer.progress("check"):
        check_run(setup, folder)
    if force:
        clear_results(folder, setup)
    return _computed(setup, folder, observer)


@one_thread()
def _computed(setup: Setup, folder: Path, observer: RunObserver) -> StageResults:
    """Render, calibrate and reconstruct."""
    from ommatid.reconstruct.output.result_files import cached_results
    from ommatid.reconstruct.output.run_json import TimeReport

    scene, camera = setup.scene, setup.camera
    start_up, begun = None if observer.start_up is None else observer.start_up(), perf_counter()
    stack, rendered = _rendered(setup, folder, observer)
    with observer.progress("calibrate") as progress:
        from ommatid.analysis.calibration_goal import for_stack
        from ommatid.simulate.calibrate import cached_model

        model, calibrated = cached_model(folder / "model.npz", setup, progress, for_stack(stack))
    observer.done("calibrate", calibrated)
    with observer.progress("reconstruct") as progress:
        report, made = cached_results(folder, stack, model, (folder / "stack.exr", folder / "model.npz"), progress)
    observer.done("reconstruct", made)
    worked = {"render": rendered, "calibrate": calibrated, "reconstruct": made}
    files = perf_counter() - begun - sum(report.stages[name].seconds for name, ran in worked.items() if ran)
    earlier = earlier_report(folder, report.fingerprint)
    if earlier is not None:  # its time limit was that of another command
        spent = earlier.spent.model_dump(include={"start_up"}, exclude_none=True)
        report = earlier.with_changes(spent=TimeReport(**spent))
    if earlier is None and scene.world is not None:
        from ommatid.analysis.depth_error import depth_error_of_run

        report = report.with_changes(depth=depth_error_of_run(folder, camera))
    if scene.study is not None:
        report = _with_study(report, setup, stack, folder, observer)
    if earlier is None:
        report = report.with_times(max(files, 0.0), start_up)
    return StageResults(report, stack, model)


def finish(results: StageResults, folder: Path, observer: RunObserver, baselines: bool = False) -> RunReport:
    """Write the page and run.json of results, with the baselines beside them, unless they are up to date.

    baselines : True to compare them with other methods first
    Returns the content of run.json.
    """
    from ommatid.analysis.baselines import known_baselines
    from ommatid.reconstruct.output import run_json

    if baselines:
        with observer.progress("baselines") as progress:
            results = with_baselines(results, folder, progress)
    elif (known := known_baselines(folder, results.report.fingerprint)) is not None:
        results = replace(results, report=results.report.with_changes(baselines=known.reports))
    begun, report = perf_counter(), results.report
    write_page(results, folder, observer)
    if run_json.PAGE not in report.stages:
        report = report.with_stage(run_json.PAGE, perf_counter() - begun)
    earlier = earlier_report(folder, report.fingerprint)
    if earlier is None or report.plain() != earlier.plain():
        run_json.write(folder, report)
    return report


def earlier_report(folder: Path, fingerprint: str) -> RunReport | None:
    """Return the content of run.json if it is of the estimate with this fingerprint."""
    from ommatid.reconstruct.output import run_json

    with suppress(OSError, ValueError, InputError):
        report = run_json.read(folder)
        return report if report.fingerprint == fingerprint else None
    return None


def write_page(results: StageResults, folder: Path, observer: RunObserver) -> None:
    """Write report.html of results unless it is up to date."""
    from ommatid.page.cached import cached_page

    with observer.progress("report"):
        made = cached_page(folder, results.report, results.stack, results.model)
    observer.done("report", made)


def render(setup: Setup, folder: Path, observer: RunObserver, force: bool = False) -> dict[str, Any]:
    """Render a scene, here or on a worker, and describe its stack; force : to render it again."""
    from ommatid.simulate.validation import check_scene

    check_scene(setup, calibrates=False)
    check_files(setup, folder)
    if force:
        clear_results(folder, setup)
    stack, _ = _rendered(setup, folder, observer)
    return {"sub_images": len(setup.camera.sub_imagers), **stack.record}


def predict_scene(setup: Setup, folder: Path, observer: RunObserver, rays: bool = True) -> dict[str, Any]:
    """Predict the error of a scene and its electrons, without rendering or writing anything."""
    from ommatid.analysis.predict import electrons, predict_scene
    from ommatid.analysis.prediction_table import json_of

    del folder, observer
    with naming_source(setup.scene.source):
        prediction, light = predict_scene(setup.scene, rays), electrons(setup)
    return {**json_of(prediction), **({} if light is None else {"light": light})}


def calibrated_model(setup: Setup, path: Path, progress: Progress, stack: Stack | None = None) -> tuple[Model, bool]:
    """Return the model at `path` and False if it is up to date; else calibrate it, and True.

    An adaptive calibration stops by the expected error of `stack`, without one by that of images drawn from the prior.
    """
    from ommatid.simulate.calibrate import cached_model, is_adaptive
    from ommatid.simulate.validation import check_scene, check_scene_memory

    if setup.scene.calibration.method != "ideal":
        check_scene(setup)
    check_scene_memory(setup)
    stopping_rule = None
    if is_adaptive(setup.scene):
        from ommatid.analysis.calibration_goal import for_prior, for_stack

        stopping_rule = for_prior(setup) if stack is None else for_stack(stack)
    return cached_model(path, setup, progress, stopping_rule)


def export_scene(path: Path, output: Path, changes: Sequence[str] = (), lenses: Sequence[str] = ()) -> dict[str, Any]:
    """Write the scene in `path` as a plain Mitsuba scene, and describe its files and sensors.

    Raises InputError for a scene with a world or with lenses that are more than pinholes.
    """
    from ommatid.runtime.outputs.kinds import check_output
    from ommatid.scenes.tables.gallery import find_scene
    from ommatid.simulate.renderer.plugins import export

    check_output(output, find_scene(path))
    setup = open_scene(path, changes, lenses)
    if setup.scene.world is not None:
        raise InputError(f"{path}: world.file is a Mitsuba scene already; export serves flat targets, remove [world]")
    picture = export(setup, output)
    return {"file": str(output), "picture": str(picture), "sensors": [sub.name for sub in setup.camera.sub_imagers]}


def library_versions(with_variant: bool) -> dict[str, str]:
    """Return the versions that have to agree on all machines for equal results.

    with_variant : True adds the variant that 'auto' selects
    """
    from ommatid.simulate.renderer.variant import choose

    required = versions("mitsuba", "drjit", "scipy")
    if with_variant:
        required["the variant that render.variant 'auto' stands for"] = choose("auto")
    return required


def _rendered(setup: Setup, folder: Path, observer: RunObserver) -> tuple[Stack, bool]:
    prepare(setup, folder)
    with observer.progress("render") as progress:
        from ommatid.simulate.render import cached_stack

        stack, made = cached_stack(folder / "stack.exr", setup, progress)
    observer.done("render", made)
    return stack, made


def _with_study(report: RunReport, setup: Setup, stack: Stack, folder: Path, observer: RunObserver) -> RunReport:
    """Add the errors with every model of H that the scene's study names, unless the report has them."""
    from ommatid.analysis.calibration_goal import for_stack
    from ommatid.analysis.study import study_cases, study_models
    from ommatid.reconstruct.output.result_files import truth_beside

    begun, models = perf_counter(), study_models(setup, folder, no_progress, for_stack(stack))
    made = [case.model for case in report.study] != list(models)
    if made:
        with observer.progress("study") as progress:
            cases = study_cases(stack, models, truth_beside(folder / "stack.exr", stack), progress)
        report = report.with_changes(study=cases).with_stage("study", perf_counter() - begun)
    observer.done("study", made)
    return report
