"""A reconstruction from the files of a stack and a model: the estimate alone, or a folder as `run` writes it."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter

from ommatid.analysis.baselines import missing_methods
from ommatid.batch.film import cached_film
from ommatid.batch.frames import Frame, FrameOptions, reconstruct_file
from ommatid.batch.remote import SILENT
from ommatid.page.batch_index import INDEX, cached_index, write_film_index
from ommatid.reconstruct.output import result_files, run_json
from ommatid.reconstruct.output.estimate_formats import check_formats, check_picture
from ommatid.reconstruct.output.result_files import Region
from ommatid.reconstruct.output.run_json import RUN, HeldOutReport, RunReport
from ommatid.reconstruct.restore import check_camera
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import Cluster, worker_pool
from ommatid.runtime.execution.workers import Workers
from ommatid.runtime.files import UNREADABLE, file_digest, write_whole
from ommatid.runtime.input_files import read_text, real_path
from ommatid.runtime.outputs.kinds import check_folder, check_inside, check_name, check_output
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.scene import TRUTH, WORLD_PICTURE, CalibrationTable, Scene, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables import toml

from .stages import StageResults, calibrated_model, earlier_report, finish, with_baselines, write_page

STACK, MODEL = "stack.exr", "model.npz"
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy", ".npz", ".toml", ".json", ".html")


def is_folder(output: Path) -> bool:
    """Return True if `-o` names a folder, not an OpenEXR file. Raises InputError for the name of another file."""
    if output.is_dir():
        check_folder(output)
        return True
    if output.suffix.lower() in PICTURES:
        advice = output.with_suffix(".exr")
        raise InputError(f"{output}: expected the name of an OpenEXR file, such as {advice}, or of a folder")
    return output.suffix.lower() != ".exr"


def reconstruct_files(
    stack: Path,
    options: FrameOptions,
    output: Path,
    progress: Progress,
    cluster: Cluster | None = None,
    workers: int | None = None,
) -> RunReport:
    """Reconstruct a stack with a model, and write the estimate (OpenEXR), its picture and formats.

    Returns the content of run.json, with the means of the regions.
    Raises InputError for wrong files and options, and for other files in the way, MachineError for a full disk.
    """
    check_output(output, stack, options.model, *(stack.parent / name for name in (TRUTH, WORLD_PICTURE)))
    check_output(output.with_suffix(".png"))
    check_picture(output)
    check_formats(output, options.formats)
    options.read(stack)  # refuses wrong files before workers are started
    with _tile_workers(cluster, workers) as pool:
        return reconstruct_file(stack, output, options, pool, progress)


def reconstruct_folder(
    stack: Path,
    options: FrameOptions,
    folder: Path,
    progress: Progress,
    cluster: Cluster | None = None,
    workers: int | None = None,
) -> tuple[RunReport, bool]:
    """Reconstruct into a folder that then holds what a run writes, with copies of the stack, the model and the truth.

    Returns the content of run.json, and False if it was up to date. Raises InputError for wrong files and options, also
    for a folder that holds the stack or the model, and MachineError for a full disk.
    """
    sources = {real_path(path) for path in (stack, options.model, stack.parent / TRUTH)}
    for name in (STACK, MODEL, TRUTH, WORLD_PICTURE):
        if real_path(folder / name) in sources:
            raise InputError(f"{folder / name}: would replace a file that is read; choose another folder with -o")
    with occupied(folder, result_files.ESTIMATE):
        _fill(folder, stack, options)
        with _tile_workers(cluster, workers) as pool:
            return finish_folder(folder, progress, options.regions, pool, options.force)


def _fill(folder: Path, stack: Path, options: FrameOptions) -> None:
    """Copy a stack, its model and its truth into a folder, stack and model as `options` change them.

    Raises InputError for wrong files and options.
    """
    recorded, calibrated = options.read(stack)
    check_camera(recorded.camera, calibrated, (stack, options.model))
    _remove_other_scene(folder, recorded)
    if result_files.truth_beside(stack, recorded) is not None:
        for name in (TRUTH, WORLD_PICTURE):
            _copy(stack.parent / name, folder / name)
    if options.changes or options.lenses:
        stack_file.write(folder / STACK, recorded)
    else:
        _copy(stack, folder / STACK)
    if options.lenses:
        model_file.write(folder / MODEL, calibrated)
    else:
        _copy(options.model, folder / MODEL)


def check_held_out_files(stack: Path, options: FrameOptions, *, fitted: bool, progress: Progress) -> HeldOutReport:
    """Predict every sub-imager of a stack from all others.

    fitted : True replaces an independent prior by one fitted to the stack
    Raises InputError for wrong files and options, and for a scene without noise.
    """
    from ommatid.reconstruct.held_out.check import check_held_out

    recorded, calibrated = options.read(stack)
    check_camera(recorded.camera, calibrated, (stack, options.model))
    return check_held_out(recorded, calibrated, fitted=fitted, progress=progress)


def finish_folder(
    folder: Path,
    progress: Progress,
    regions: Sequence[Region] = (),
    workers: Workers | None = None,
    force: bool = False,
) -> tuple[RunReport, bool]:
    """Reconstruct the stack in a folder with the model in it, and write the page, unless they are up to date."""
    begun, names = perf_counter(), (folder / STACK, folder / MODEL)
    recorded, calibrated = stack_file.read(names[0]), model_file.read(names[1])
    report, made = result_files.cached_results(
        folder, recorded, calibrated, names, progress, workers, tuple(regions), force
    )
    earlier = earlier_report(folder, report.fingerprint)
    if earlier is None:
        files = max(perf_counter() - begun - report.stages["reconstruct"].seconds, 0.0)
        report = _with_design(report, recorded.scene).with_times(files, None)
    return finish(StageResults(earlier or report, recorded, calibrated), folder, SILENT), made


def _design_instead(report: RunReport, scene: Scene) -> str:
    """Return a note if H is the one as designed, but the stack's scene asks for another; else ""."""
    asked = scene.calibration.method
    if report.stages["calibrate"].method != "ideal" or asked == "ideal":
        return ""
    return f"H as designed was taken, although the scene asks for calibration.method '{asked}'"


def _with_design(report: RunReport, scene: Scene) -> RunReport:
    """Add the note to the verdict."""
    note, verdict = _design_instead(report, scene), report.verdict
    if not note:
        return report
    return report.with_changes(verdict=verdict.model_copy(update={"notes": (*verdict.notes, note)}))


def _design_warnings(folder: Path) -> tuple[str, ...]:
    """Return the note on a finished run as a warning, nothing without one."""
    note = _design_instead(run_json.read(folder), stack_file.read_header(folder / STACK)[0])
    return (f"{folder / STACK}: {note}; `ommatid calibrate` yields the camera's",) if note else ()


def _write_page(folder: Path) -> None:
    """Write the page of a finished run. Raises InputError if its files are of several runs."""
    results = StageResults.read(folder)
    regions = [(region.corner, region.size) for region in results.report.regions]
    truth = result_files.truth_beside(folder / STACK, results.stack)
    if results.report.fingerprint != result_files.fingerprint_of(results.stack, results.model, truth, regions):
        raise InputError(f"{folder}: run.json is of another stack or model than those beside it; run the scene again")
    result_files.check_results(folder, results.report.fingerprint)
    write_page(results, folder, SILENT)


@dataclass(frozen=True)
class ReportOutcome:
    """Folders with a page, the page of the batch if there are several, and warnings."""

    folders: tuple[Path, ...]
    index: Path | None
    warnings: tuple[str, ...]


def finish_film(
    folder: Path, frames: Sequence[tuple[Frame, RunReport | None, str]], options: FrameOptions
) -> tuple[Path, str]:
    """Write film.gif and index.html of frames that are reconstructed; return the index, and in words what is shown.

    frames : with the report of each, or the reason of its failure
    """
    finished = [frame for frame, report, _ in frames if report is not None]
    with occupied(folder):
        film = cached_film(folder, finished, options) if finished else None
        reports = [(frame.output.stem, report, failure) for frame, report, failure in frames]
        return write_film_index(folder, reports, film), "" if film is None else f"{film.path}, {film.words}"


def report_path(path: Path, output: Path | None, progress: Progress, *, baselines: bool = False) -> ReportOutcome:
    """Write the page of a finished run, of a folder of runs, or of a stack.

    path : a folder of results; a folder of such folders; a folder with stack.exr; or a stack
    output : for a stack the folder of its results, None: a folder beside it of its name
    baselines : True compares the estimates with other methods, too

    A stack is reconstructed with model.npz beside it, or without one with H as designed.
    Raises InputError if there is nothing to report.
    """
    outcome = _report(path, output, progress)
    if not baselines:
        return outcome
    missing = dict[str, None]()
    for folder in outcome.folders:
        with occupied(folder):
            compared = finish(with_baselines(StageResults.read(folder), folder, progress), folder, SILENT)
            missing[missing_methods(compared.unknowns)] = None
    return replace(outcome, warnings=(*outcome.warnings, *filter(None, missing)))


def _report(path: Path, output: Path | None, progress: Progress) -> ReportOutcome:
    """Write the pages, as `report_path` does without baselines."""
    if path.is_file():
        if path.suffix.lower() != ".exr":
            raise InputError(f"{path}: expected a folder of results, or a stack, which ends in .exr")
        in_run = path.name == STACK and output is None
        if not in_run and output is None:
            check_name(path.stem, path)
        return _report_stack(path, path.parent if in_run else output or path.with_suffix(""), progress)
    if output is not None:
        raise InputError(f"{path}: -o is the folder of a stack's results; a folder is reported in place, leave out -o")
    alone = (path / STACK).is_file()
    if alone and not (path / RUN).is_file():
        return _report_stack(path / STACK, path, progress)
    inside = sorted(run.parent for run in path.glob(f"*/{RUN}") if run.with_name(STACK).is_file())
    for folder in () if alone else inside:
        check_inside(folder)
    folders = (path,) if alone else tuple(inside)
    if not folders:
        raise InputError(f"{path}: expected a stack, or a folder with stack.exr or with folders of runs, got none")
    for number, folder in enumerate(folders):
        with occupied(folder):
            _write_page(folder)
        progress((number + 1) / len(folders))
    if not alone:
        with occupied(path):
            cached_index(path, dict.fromkeys(folders, ""))
    warnings = tuple(warning for folder in folders for warning in _design_warnings(folder))
    return ReportOutcome(folders, None if alone else path / INDEX, warnings)


def _report_stack(stack: Path, folder: Path, progress: Progress) -> ReportOutcome:
    """Reconstruct a stack with the model beside it, or with H as designed, and write the page."""
    model, warnings = stack.with_name(MODEL), ()
    with occupied(folder, result_files.ESTIMATE):
        if not model.is_file():
            model = folder / MODEL
            warnings = (_write_designed_model(stack, model, progress),)
        if real_path(folder) != real_path(stack.parent):
            _fill(folder, stack, FrameOptions(model))
        finish_folder(folder, progress)
    return ReportOutcome((folder,), None, warnings or _design_warnings(folder))


def _write_designed_model(stack: Path, model: Path, progress: Progress) -> str:
    """Write H as designed for the camera of a stack, and return a warning. Raises InputError without a closed form."""
    scene, _ = stack_file.read_header(stack)
    ideal = CalibrationTable(method="ideal")
    calibrated_model(Setup.from_scene(with_tables(scene, calibration=ideal)), model, progress)
    return f"{stack}: there is no {MODEL} beside it, so H as designed is taken; `ommatid calibrate` yields the camera's"


def _remove_other_scene(folder: Path, recorded: Stack) -> None:
    """Remove the scene.toml that an earlier run wrote beside its stack, unless `recorded` is of the same scene."""
    with suppress(*UNREADABLE):
        written = toml.loads(read_text(folder / "scene.toml"))
        earlier, _ = stack_file.read_header(folder / STACK)
        if written == earlier.plain() != recorded.scene.plain():
            (folder / "scene.toml").unlink()


def _copy(source: Path, target: Path) -> None:
    """Copy a file, if there is one, unless the same is there."""

    def write(beside: Path) -> None:
        shutil.copyfile(source, beside)

    if source.is_file() and not (target.is_file() and file_digest(source) == file_digest(target)):
        write_whole(target, write)


@contextmanager
def _tile_workers(cluster: Cluster | None, count: int | None) -> Generator[Workers | None]:
    """Yield workers for the tiles of a frame; None where threads of this process solve them."""
    if cluster is None and count is None:
        yield None
        return
    with worker_pool(cluster, count) as workers:
        workers.check_versions(partial(versions, "scipy"))
        yield workers
