"""Many frames of one camera: each stack reconstructed with the same model, which is prepared once.

The first frame is reconstructed in this process. What it prepared then serves the others, here or in other processes.
A frame's EXR file holds its run.json, and the fingerprint of everything that it was made from.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.reconstruct.methods.method import Prepared
from ommatid.reconstruct.output import result_files
from ommatid.reconstruct.output.estimate_formats import Format, check_formats, files_in_formats, write_formats
from ommatid.reconstruct.output.result_files import Region
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.restore import check_camera, check_region
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import worker_pool
from ommatid.runtime.execution.workers import Workers
from ommatid.runtime.files import UNREADABLE, clear_abandoned, file_digest, fingerprint, not_written, temporary_file
from ommatid.runtime.input_files import real_path
from ommatid.runtime.outputs.kinds import check_folder, check_name
from ommatid.runtime.outputs.occupied import new_folder
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH, WORLD_PICTURE
from ommatid.scenes.stack import Stack

SENT = "preconditioner", "errors"  # what the first frame prepared and other processes take over; they make the rest


@dataclass(frozen=True)
class FrameOptions:
    """How frames are reconstructed: the file of H, changes (KEY=VALUE), names of lens types, regions and formats.

    force : True to reconstruct also frames that are up to date
    """

    model: Path
    changes: tuple[str, ...] = ()
    lenses: tuple[str, ...] = ()
    regions: tuple[Region, ...] = ()
    formats: tuple[Format, ...] = ()
    force: bool = False

    def read_model(self) -> Model:
        """Read H of the lens types."""
        model = model_file.read(self.model)
        return model.restrict(self.lenses) if self.lenses else model

    def read(self, path: Path) -> tuple[Stack, Model]:
        """Read a stack, and its model. Raises InputError for wrong files and options."""
        stack, model = stack_file.read(path), self.read_model()
        for region in self.regions:
            check_region(*region, stack.camera.shape)
        return self.applied(stack, path), model

    def applied(self, stack: Stack, path: Path) -> Stack:
        """Return a stack of the lens types, with the changes."""
        stack = stack.restrict(self.lenses) if self.lenses else stack
        return result_files.with_estimator_changes(stack, list(self.changes), path)


@dataclass(frozen=True)
class Frame:
    """A stack's file and the file of its estimate, with the fingerprint of everything that the estimate depends on."""

    stack: Path
    output: Path
    fingerprint: str

    def finished(self) -> RunReport | None:
        """Return the report of an estimate that is there and up to date, else None."""
        with suppress(*UNREADABLE):
            report = result_files.read_report(self.output)
            if report.fingerprint == self.fingerprint and self.output.with_suffix(".png").is_file():
                return report
        return None


# Each frame with a function that returns its report and True if it was made, or raises its error.
Reports = Iterator[tuple[Frame, Callable[[], tuple[RunReport, bool]]]]


def reconstruct_frames(
    stacks: Sequence[Path], folder: Path, options: FrameOptions, workers: int | None, progress: Progress
) -> Reports:
    """Yield the frames as they end; estimates and pictures are in `folder` under the names of the stacks.

    workers : processes that share the frames, None for this one
    Raises InputError, before anything is written, if two stacks have one name, if one is not of the model's camera, or
    if another file is in the way.
    """
    outputs = _outputs(stacks, folder, options.model)
    model = options.read_model()
    for stack in stacks:
        _check(stack, model, options)
    for output in outputs:
        check_formats(output, options.formats)
    check_folder(folder)
    common, pairs = _common(options), zip(stacks, outputs, strict=True)
    frames = [Frame(stack, output, _made_from(stack, common)) for stack, output in pairs]
    return _reports(folder, frames, Prepared(model), options, workers, progress)


def _outputs(stacks: Sequence[Path], folder: Path, model: Path) -> list[Path]:
    """Return the file of each estimate. Raises InputError for equal names, and where a file that is read is in the way.

    A folder that does not exist is made later.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder for the estimates of {len(stacks)} stacks, got a file")
    first: dict[str, Path] = {}
    for stack in stacks:
        check_name(stack.stem, stack)
        if stack.stem in first:
            raise InputError(
                f"{first[stack.stem]} and {stack}: expected stacks of different names, got two '{stack.stem}', whose"
                " estimates would be one file; rename one of them"
            )
        first[stack.stem] = stack
    outputs = [folder / f"{stack.stem}.exr" for stack in stacks]
    read = {real_path(path) for stack in stacks for path in (stack, stack.parent / TRUTH)} | {real_path(model)}
    for output in outputs:
        if real_path(output) in read:
            raise InputError(f"{output}: would replace a file that is read; choose another folder with -o")
    return outputs


def _check(path: Path, model: Model, options: FrameOptions) -> None:
    """Raise InputError unless a stack, by its header, is one that `options` can be applied to and of the model."""
    scene, camera = stack_file.read_header(path)
    if options.lenses:
        camera = camera.restrict(options.lenses)[0]
    check_camera(camera, model, (path, options.model))
    nothing = Stack(scene, camera, np.zeros(0), np.zeros(0), {})
    result_files.with_estimator_changes(nothing, list(options.changes), path)
    for region in options.regions:
        check_region(*region, camera.shape)


def _common(options: FrameOptions) -> list[Any]:
    """Return what all frames are made from."""
    return [file_digest(options.model), options.changes, options.lenses, options.regions]


def _made_from(stack: Path, common: list[Any]) -> str:
    beside = [stack.parent / name for name in (TRUTH, WORLD_PICTURE)]
    return fingerprint([*common, file_digest(stack), *(file_digest(path) for path in beside if path.is_file())])


def _reports(
    folder: Path,
    frames: Sequence[Frame],
    prepared: Prepared,
    options: FrameOptions,
    workers: int | None,
    progress: Progress,
) -> Reports:
    """Yield the frames that are up to date, then the others as they end."""
    with new_folder(folder):
        clear_abandoned(folder)
        missing: list[Frame] = []
        for frame in frames:
            report = None if options.force else frame.finished()
            if report is None:
                missing.append(frame)
            else:
                write_formats(frame.output, options.formats)
                yield frame, lambda report=report: (report, False)
        several = workers is not None and workers > 1
        made = _in_processes(missing, prepared, options, workers or 1) if several else _here(missing, prepared, options)
        for number, (frame, work) in enumerate(made, 1):
            yield frame, work
            progress(number / len(missing))


def _here(frames: Sequence[Frame], prepared: Prepared, options: FrameOptions) -> Reports:
    for frame in frames:
        yield frame, partial(_made, frame, prepared, options)


def _in_processes(frames: Sequence[Frame], prepared: Prepared, options: FrameOptions, workers: int) -> Reports:
    """Yield the first frame, made here by its caller, then the others as processes make them."""
    yield from _here(frames[:1], prepared, options)
    others = frames[1:]
    if not others:
        return
    with temporary_file(frames[0].output.with_name("prepared")) as contents:
        try:
            contents.write_bytes(pickle.dumps(prepared.contents(*SENT)))
        except OSError as error:
            raise not_written(frames[0].output.parent, error) from error
        with worker_pool(count=min(workers, len(others))) as pool:
            for index, result in pool.each(partial(_made_in_process, options, contents), others):
                yield others[index], result


def reconstruct_file(
    stack: Path, output: Path, options: FrameOptions, workers: Workers | None, progress: Progress
) -> RunReport:
    """Reconstruct one stack into an EXR file and its picture, in any case; workers : for its tiles, None: threads."""
    prepared, frame = Prepared(options.read_model()), Frame(stack, output, _made_from(stack, _common(options)))
    return _made(frame, prepared, options, workers, progress)[0]


def _made(
    frame: Frame,
    prepared: Prepared,
    options: FrameOptions,
    workers: Workers | None = None,
    progress: Progress = no_progress,
) -> tuple[RunReport, bool]:
    """Reconstruct a frame and write its files, the EXR file first: a disk that is full for it keeps the old ones."""
    stack = options.applied(stack_file.read(frame.stack), frame.stack)
    truth = result_files.truth_beside(frame.stack, stack)
    names = frame.stack, options.model
    shared = workers, progress, prepared, frame.fingerprint, options.regions
    outcome, report = result_files.reconstruct(stack, prepared.model, truth, names, *shared)
    picture = frame.output.with_suffix(".png")
    earlier = [picture, *files_in_formats(frame.output)]
    result_files.write_estimate(frame.output, outcome, result_files.record_of(report))
    for path in earlier:
        path.unlink(missing_ok=True)
    result_files.write_picture(picture, outcome.estimate.reshape(outcome.shape))
    write_formats(frame.output, options.formats)
    return report, True


def _made_in_process(options: FrameOptions, contents: Path, frame: Frame) -> tuple[RunReport, bool]:
    return _made(frame, _prepared(options, contents), options)


@lru_cache(maxsize=1)
def _prepared(options: FrameOptions, contents: Path) -> Prepared:
    """Return what the first frame prepared, once per process."""
    return Prepared(options.read_model()).with_contents(pickle.loads(contents.read_bytes()))
