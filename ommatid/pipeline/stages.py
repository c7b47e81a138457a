"""The stages of a scene, one after the other: they meet in the files of its folder, and what is up to date stays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ommatid.batch.batch import Member, prepare
from ommatid.batch.remote import RunObserver
from ommatid.reconstruct.output.run_json import RunReport, StudyCase
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.processors import one_thread, processors
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.cache import cached_model, cached_stack
from ommatid.simulate.calibrate import is_adaptive
from ommatid.simulate.renderer.variant import check_transport_variant
from ommatid.simulate.renderer.variant import choose as choose_variant
from ommatid.simulate.validation import check_scene, check_scene_memory


def opened(path: Path, changes: Sequence[str] = (), lenses: Sequence[str] = ()) -> Setup:
    """A scene, its camera and its target, all checked before anything is written."""
    return checked(read(path, changes, lenses))


def checked(scene: Scene) -> Setup:
    """Derive the camera of a scene and load its image. Raises InputError if either cannot be done."""
    camera = derive(scene)  # first: it is cheap, and refuses most of what is wrong
    if scene.world is not None:
        from ommatid.simulate.renderer.world import files

        files(scene)
    return Setup(scene, camera, load(scene))


def member_opened(changes: Sequence[str], lenses: Sequence[str], member: Member) -> Setup:
    """A scene of a batch, with its own changes after those of all."""
    return opened(member.scene, (*changes, *member.changes), lenses)


def fitting(changes: Sequence[str], lenses: Sequence[str], members: Sequence[Member]) -> int:
    """In how many processes a batch is done soonest, of as many as memory holds."""
    from ommatid.batch.cost_model import concurrent_by_memory, estimate_cost, fastest_process_count

    efforts = [estimate_cost(member, changes, lenses) for member in members]
    most = min(concurrent_by_memory([one.memory for one in efforts]), len(members), processors())
    return fastest_process_count([one.seconds for one in efforts], most, processors())


def run(setup: Setup, folder: Path, watch: RunObserver) -> dict[str, Any]:
    """What `run` does of a scene, here or on a worker, and says of it."""
    report = results(setup, folder, watch)
    write_page(setup.camera, folder, watch)
    return report.plain()


@one_thread()
def results(setup: Setup, folder: Path, watch: RunObserver) -> RunReport:
    """All of a run but its page, and what run.json says of it."""
    from ommatid.analysis import study
    from ommatid.analysis.calibration_goal import for_stack
    from ommatid.reconstruct.method_choice import choose_method
    from ommatid.reconstruct.output import run_json
    from ommatid.reconstruct.output.result_files import cached_results

    scene, camera = setup.scene, setup.camera
    check_scene(setup)
    if scene.study is not None and "transport" in scene.study.models:
        with naming_source(scene.source):
            check_transport_variant(choose_variant(scene.render.variant), "study.models")
    choose_method(scene, camera, setup.has_structured_matrix)  # what memory does not hold is refused before any work
    study.check_study(scene, camera)
    stack = _rendered(setup, folder, watch)
    with watch.progress("calibrate") as progress:
        model, made = cached_model(folder / "model.npz", setup, progress, for_stack(stack))
    watch.done("calibrate", made)
    with watch.progress("reconstruct") as progress:
        report, made = cached_results(folder, stack, model, (folder / "stack.exr", folder / "model.npz"), progress)
    watch.done("reconstruct", made)
    complete = report
    if scene.world is not None:
        from ommatid.analysis.depth_error import depth_error_of_run

        complete = complete.with_changes(depth=depth_error_of_run(folder, camera))
    if scene.study is not None:
        complete = complete.with_changes(study=_studied(setup, stack, folder, watch))
    if complete.plain() != report.plain():
        run_json.write(folder, complete)
    return complete


def write_page(camera: Camera, folder: Path, watch: RunObserver) -> None:
    """Show the run whose results stand in a folder on a page."""
    from ommatid.page.cached import cached_page
    from ommatid.simulate.ideal import matrix_as_designed

    with watch.progress("report"):
        made = cached_page(folder, partial(matrix_as_designed, camera))
    watch.done("report", made)


def render(setup: Setup, folder: Path, watch: RunObserver) -> dict[str, Any]:
    """What `render` does of a scene, here or on a worker, and says of it."""
    stack = _rendered(setup, folder, watch)
    return {"sub_images": len(setup.camera.sub_imagers), **stack.record}


def predict_scene(setup: Setup, folder: Path, watch: RunObserver) -> dict[str, Any]:
    """What `predict` says of a scene of a sweep; nothing is rendered, and nothing written."""
    from ommatid.analysis.predict import predict_scene
    from ommatid.analysis.prediction_table import json_of

    del folder, watch
    with naming_source(setup.scene.source):
        return json_of(predict_scene(setup.scene))


def calibrated(setup: Setup, path: Path, progress: Progress) -> tuple[Model, bool]:
    """H alone, kept at `path`, and whether it had to be made; its samples are judged by images of the prior."""
    if setup.scene.calibration.method != "ideal":
        check_scene(setup)
    check_scene_memory(setup)
    judge = None
    if is_adaptive(setup.scene):
        from ommatid.analysis.calibration_goal import for_prior

        judge = for_prior(setup)
    return cached_model(path, setup, progress, judge)


def exported(path: Path, output: Path, changes: Sequence[str] = (), lenses: Sequence[str] = ()) -> dict[str, Any]:
    """Write the scene in `path` as a plain Mitsuba scene, and describe its files and sensors.

    Raises InputError for a scene with a world or with lenses that are more than pinholes.
    """
    from ommatid.runtime.files import check_output
    from ommatid.simulate.renderer.export import export

    check_output(output, path)
    setup = opened(path, changes, lenses)
    if setup.scene.world is not None:
        raise InputError(f"{path}: world.file is a Mitsuba scene already; export serves flat targets, remove [world]")
    picture = export(setup, output)
    return {"file": str(output), "picture": str(picture), "sensors": [sub.name for sub in setup.camera.sub_imagers]}


def facts(chosen: bool) -> dict[str, str]:
    """What has to be the same on all machines for results to be the same; `chosen`: the variant is left to them."""
    found = versions("mitsuba", "drjit", "scipy")
    if chosen:
        found["the variant that render.variant 'auto' stands for"] = choose_variant("auto")
    return found


def _rendered(setup: Setup, folder: Path, watch: RunObserver) -> Stack:
    check_scene(setup, calibrates=False)
    prepare(setup, folder)
    with watch.progress("render") as progress:
        stack, made = cached_stack(folder / "stack.exr", setup, progress)
    watch.done("render", made)
    return stack


def _studied(setup: Setup, stack: Stack, folder: Path, watch: RunObserver) -> tuple[StudyCase, ...]:
    """The same stack with every idea of H that the scene's study names."""
    from ommatid.analysis.calibration_goal import for_stack
    from ommatid.analysis.models import study_models
    from ommatid.analysis.study import cached_study
    from ommatid.reconstruct.output.result_files import truth_beside

    with watch.progress("study") as progress:
        known = study_models(setup, folder, no_progress, for_stack(stack))
        cases, made = cached_study(folder, stack, known, truth_beside(folder / "stack.exr", stack), progress)
    watch.done("study", made)
    return cases
