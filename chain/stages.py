"""The stages of a scene, one after the other: they meet in the files of its folder, and what is up to date stays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from scenes.batch import Member, prepare
from scenes.camera import Camera, derive
from scenes.errors import naming
from scenes.parcel import Watch
from scenes.picture import Image, load
from scenes.processors import one_thread, processors
from scenes.progress import no_progress
from scenes.scene import Scene, read
from scenes.stack import Stack
from scenes.versions import versions
from simulate.kept import kept_model, kept_stack
from simulate.refuse import refuse
from simulate.variant import choose as choose_variant
from simulate.variant import refuse_slow_transport


def opened(path: Path, changes: Sequence[str] = (), lenses: Sequence[str] = ()) -> tuple[Scene, Camera, Image]:
    """A scene, its camera and its target, all checked before anything is written."""
    scene = read(path, changes, lenses)
    camera = derive(scene)  # first: it is cheap, and refuses most of what is wrong
    if scene.world is not None:
        from simulate.world import files

        files(scene)
    return scene, camera, load(scene)


def member_opened(changes: Sequence[str], lenses: Sequence[str], member: Member) -> tuple[Scene, Camera, Image]:
    """A scene of a batch, with its own changes after those of all."""
    return opened(member.scene, (*changes, *member.changes), lenses)


def fitting(changes: Sequence[str], lenses: Sequence[str], members: Sequence[Member]) -> int:
    """In how many processes a batch is done soonest, of as many as memory holds."""
    from .effort import effort, held, soonest

    efforts = [effort(member, changes, lenses) for member in members]
    most = min(held([one.memory for one in efforts]), len(members), processors())
    return soonest([one.seconds for one in efforts], most, processors())


def run(scene: Scene, camera: Camera, image: Image, folder: Path, watch: Watch) -> dict[str, Any]:
    """What `run` does of a scene, here or on a worker, and says of it."""
    description = results(scene, camera, image, folder, watch)
    tell(camera, folder, watch)
    return description


@one_thread()
def results(scene: Scene, camera: Camera, image: Image, folder: Path, watch: Watch) -> dict[str, Any]:
    """All of a run but its page, and what run.json says of it."""
    from reconstruct import study
    from reconstruct.choice import choose
    from reconstruct.report import write_run
    from reconstruct.results import RUN, kept_results

    from .judges import by_stack

    exact = scene.calibration.method == "ideal" and camera.boxed
    refuse(scene, camera)
    if scene.study is not None and "transport" in scene.study.models:
        with naming(scene.source):
            refuse_slow_transport(choose_variant(scene.render.variant), "study.models")
    choose(scene, camera, exact)  # what memory does not hold is refused before any work
    study.refuse(scene, camera)
    stack = _rendered(scene, camera, image, folder, watch)
    with watch.progress("calibrate") as progress:
        model, made = kept_model(folder / "model.npz", scene, camera, progress, by_stack(stack))
    watch.done("calibrate", made)
    with watch.progress("reconstruct") as progress:
        description, made = kept_results(folder, stack, model, (folder / "stack.exr", folder / "model.npz"), progress)
    watch.done("reconstruct", made)
    more: dict[str, Any] = {}
    if scene.world is not None:
        from reconstruct.depth import of_run

        more["depth"] = of_run(folder, camera)
    if scene.study is not None:
        more["study"] = _studied(scene, camera, stack, folder, watch)
    if any(description.get(key) != value for key, value in more.items()):
        write_run(folder / RUN, {**description, **more})
    return {**description, **more}


def tell(camera: Camera, folder: Path, watch: Watch) -> None:
    """Show the run whose results stand in a folder on a page."""
    from reconstruct.page.kept import kept_page
    from simulate.ideal import matrix_as_designed

    with watch.progress("report"):
        made = kept_page(folder, partial(matrix_as_designed, camera))
    watch.done("report", made)


def render(scene: Scene, camera: Camera, image: Image, folder: Path, watch: Watch) -> dict[str, Any]:
    """What `render` does of a scene, here or on a worker, and says of it."""
    stack = _rendered(scene, camera, image, folder, watch)
    return {"sub_images": len(camera.sub_imagers), **stack.record}


def foresee(scene: Scene, camera: Camera, image: Image, folder: Path, watch: Watch) -> dict[str, Any]:
    """What `predict` says of a scene of a sweep; nothing is rendered, and nothing written."""
    from .prediction import predicted

    del camera, image, folder, watch
    with naming(scene.source):
        return predicted(scene).describe()


def facts(chosen: bool) -> dict[str, str]:
    """What has to be the same on all machines for results to be the same; `chosen`: the variant is left to them."""
    found = versions("mitsuba", "drjit", "scipy")
    if chosen:
        found["the variant that render.variant 'auto' stands for"] = choose_variant("auto")
    return found


def _rendered(scene: Scene, camera: Camera, image: Image, folder: Path, watch: Watch) -> Stack:
    refuse(scene, camera, calibrates=False)
    prepare(scene, image, folder)
    with watch.progress("render") as progress:
        stack, made = kept_stack(folder / "stack.exr", scene, camera, image, progress)
    watch.done("render", made)
    return stack


def _studied(scene: Scene, camera: Camera, stack: Stack, folder: Path, watch: Watch) -> list[dict[str, Any]]:
    """The same stack with every idea of H that the scene's study names."""
    from reconstruct.results import truth_beside
    from reconstruct.study import kept_study
    from simulate.models import models

    from .judges import by_stack

    with watch.progress("study") as progress:
        known = models(scene, camera, folder, no_progress, by_stack(stack))
        cases, made = kept_study(folder, stack, known, truth_beside(folder / "stack.exr", stack), progress)
    watch.done("study", made)
    return cases
