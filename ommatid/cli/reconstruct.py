"""The commands on files that need no scene file: reconstruct, of one or several stacks, report, figure and check."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable_sentence

from . import failures, options, output
from .options import Baselines, Changes, FolderIfAny, Force, Formats, Json, Output, Printing, Processes, Strict

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")  # suffixes of recorded frames

if TYPE_CHECKING:
    from ommatid.batch.frames import Frame, FrameOptions
    from ommatid.figures.saving import FigureFiles
    from ommatid.reconstruct.output.run_json import RunReport
    from ommatid.runtime.execution.cluster import Cluster

    # A frame with its report, or None with the reason of its failure and the exit code.
    FrameResult = tuple[Frame, RunReport | None, str, int]

StackAndModel = Annotated[
    list[Path],
    typer.Argument(
        metavar="STACK... MODEL",
        help="Recorded sub-images, stack.exr, of one frame or several, then their observation model, model.npz.",
    ),
]
Estimates = Annotated[
    Path,
    typer.Option(
        "-o",
        "--output",
        metavar="DIR|FILE",
        help="Folder of the results, or an EXR file for the estimate alone.",
    ),
]
StackFile = Annotated[Path, typer.Argument(metavar="STACK", help="Recorded sub-images, stack.exr.")]
ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Their observation model, model.npz.")]
StackOrFolders = Annotated[
    list[Path],
    typer.Argument(
        metavar="STACK|DIR [DIR]",
        help="A folder of results, a folder of such folders, or a stack; or two folders of results to compare.",
    ),
]
Regions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        metavar="ROW,COLUMN,ROWS,COLUMNS",
        help="Print the mean of a region with its error bar; may be repeated.",
        show_default=False,
    ),
]
ScenePrior = Annotated[
    bool,
    typer.Option("--scene-prior", help="Keep an independent prior, which is replaced by a fitted one by default."),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run, such as out/tile19.")]
Panels = Annotated[
    str,
    typer.Option(
        "--panels",
        metavar="NAME,...",
        help="Some of truth, sub-image, estimate, error, deviation, in this order (default: all that are known).",
    ),
]
Crop = Annotated[
    str,
    typer.Option("--crop", metavar="ROW,COLUMN,ROWS,COLUMNS", help="Show this part of the target (default: all)."),
]
DarkGround = Annotated[bool, typer.Option("--dark-ground", help="Draw light on dark, for dark slides.")]


def reconstruct(
    files: StackAndModel,
    file: Estimates,
    changes: Changes,
    processes: Processes,
    printing: Printing,
    region: Regions = None,
    formats: Formats = "",
    force: Force = False,
    strict: Strict = False,
) -> None:
    """Reconstruct from files: one frame, or several of one camera."""
    from ommatid.batch.frames import FrameOptions

    detail, (others, figures) = printing.detail, options.formats(formats)
    *stacks, model = files
    _check_kinds(stacks, model)
    regions = tuple(options.region("--region", text) for text in region or ())
    common = FrameOptions(model, *changes.both, regions, others, force)
    if len(stacks) == 1:
        _reconstruct_one(stacks[0], common, file, processes.pool, detail, strict, figures)
        return
    if processes.scheduler:
        raise InputError("--scheduler: sends the tiles of one stack, got several stacks; take --workers instead")
    _check_no_figures(figures)
    _reconstruct_many(stacks, common, file, processes.workers, strict, detail)


def _check_kinds(stacks: Sequence[Path], model: Path) -> None:
    """Raise InputError where names say that files are of another kind, or in another order."""
    for stack in stacks:
        if stack.suffix == ".npz":
            raise InputError(f"{stack}: expected a stack, an OpenEXR file, got a model; name the model last")
        if stack.suffix.lower() in PICTURES:
            raise InputError(
                f"{stack}: expected a stack, an OpenEXR file, got a picture; make a stack of recorded frames by:"
                f" ommatid import SCENE {stack} -o stack.exr"
            )
    if model.is_dir():
        raise InputError(f"{model}: expected a model, got a folder; name its model.npz, or: ommatid report {model}")


def _check_no_figures(figures: FigureFiles) -> None:
    if len(figures.formats) > 1:
        raise InputError(f"--format {figures.formats[1]}: figures are those of a folder of one result; name it with -o")


def _reconstruct_one(
    stack: Path,
    common: FrameOptions,
    file: Path,
    pool: tuple[Cluster | None, int | None],
    detail: output.Detail | None,
    strict: bool,
    figures: FigureFiles,
) -> None:
    """Reconstruct one stack into a folder or a file, and print the result; None for `detail`: as JSON."""
    from ommatid.figures.saving import SCREEN_PNG
    from ommatid.pipeline import reconstruction
    from ommatid.pipeline.stages import write_figures
    from ommatid.reconstruct.output import facts
    from ommatid.reconstruct.output.estimate_formats import write_formats

    whole = reconstruction.is_folder(file)
    if not whole:
        _check_no_figures(figures)
    with output.progress_bar("reconstruct", quiet=detail == "verdict") as progress:
        if whole:
            report, made = reconstruction.reconstruct_folder(stack, common, file, progress, *pool)
        else:
            report, made = reconstruction.reconstruct_files(stack, common, file, progress, *pool), True
    if whole:
        write_formats(file / "estimate.exr", common.formats)
    if figures != SCREEN_PNG:
        write_figures(file, figures)
    if detail != "verdict":
        output.say_done("reconstruct", made, file)
    if detail is None:
        output.print_json({"folder" if whole else "file": str(file), **report.plain()})
    else:
        page = file / "report.html" if whole else None
        output.print_report(str(file), page, report, [(str(file), facts.rows(report))], detail)
    if strict and not report.verdict.trusted:
        raise failures.BatchError(failures.NOT_TRUSTED)


def _reconstruct_many(
    stacks: Sequence[Path],
    common: FrameOptions,
    folder: Path,
    workers: int | None,
    strict: bool,
    detail: output.Detail | None,
) -> None:
    """Reconstruct every stack with one model, and print a row, a table or a verdict for each; None: as JSON.

    Raises InputError before anything is written if a stack is not of the model's camera, and BatchError at the end if a
    frame failed or, if `strict`, if one is not to be trusted.
    """
    from ommatid.batch.frames import reconstruct_frames
    from ommatid.page.batch_index import INDEX
    from ommatid.page.cached import check_own_page
    from ommatid.pipeline.reconstruction import finish_film

    if not stacks:
        missing = "name a stack before it" if common.model.suffix == ".npz" else "name its model, model.npz, after it"
        raise InputError(f"{common.model}: expected stacks and then their model, got one file; {missing}")
    check_own_page(folder / INDEX)
    ended: dict[Path, FrameResult] = {}
    with output.progress_bar("reconstruct", quiet=detail == "verdict") as progress:
        for frame, work in reconstruct_frames(stacks, folder, common, workers, progress):
            try:
                report, made = work()
            except Exception as error:
                ended[frame.stack] = frame, None, printable_sentence(error), failures.report(error)
                continue
            ended[frame.stack] = frame, report, "", 0
            if detail != "verdict":
                output.say_done("reconstruct", made, frame.output)
    frames = [ended[stack] for stack in stacks]
    index, shown = finish_film(folder, [(frame, report, failure) for frame, report, failure, _ in frames], common)
    if detail != "verdict":
        output.say(f"film: {shown}; {index}" if shown else f"{index}: written")
    _print_frames(folder, frames, detail)
    doubted = strict and not all(report is None or report.verdict.trusted for _, report, *_ in frames)
    worst = max(failures.NOT_TRUSTED if doubted else 0, *(code for *_, code in frames))
    if worst:
        raise failures.BatchError(worst)


def _print_frames(folder: Path, frames: Sequence[FrameResult], detail: output.Detail | None) -> None:
    from ommatid.reconstruct.output import facts

    finished = [(frame.output.name, report) for frame, report, *_ in frames if report is not None]
    if detail is None:
        documents: list[dict[str, Any]] = []
        for frame, report, failure, code in frames:
            content = {"error": failure, "exit_code": code} if report is None else report.plain()
            documents.append({"file": str(frame.output), "stack": str(frame.stack), **content})
        output.print_json(documents)
    elif detail == "verdict":
        output.print_lines(facts.verdict_line(*pair) for pair in finished)
    elif detail == "table":
        output.print_tables((name, facts.rows(report)) for name, report in finished)
    else:
        rows = [
            (frame.output.name, f"failed: {failure}") if report is None else facts.frame_row(frame.output.name, report)
            for frame, report, failure, _ in frames
        ]
        output.print_tables([(f"{len(frames)} frames: {folder}", rows)])


def report(
    paths: StackOrFolders, folder: FolderIfAny = None, baselines: Baselines = False, as_json: Json = False
) -> None:
    """Write the page of a run, a folder of runs or a stack, or of two runs side by side."""
    from ommatid.pipeline.reconstruction import report_path

    if len(paths) > 1:
        _report_two(paths, folder, baselines, as_json)
        return
    with output.progress_bar("report") as progress:
        outcome = report_path(paths[0], folder, progress, baselines=baselines)
    output.warn_all(outcome.warnings)
    pages = [str(reported / "report.html") for reported in outcome.folders]
    index = {} if outcome.index is None else {"index": str(outcome.index)}
    output.print_json({"pages": pages, **index}) if as_json else output.print_lines([*pages, *index.values()])


def figure(
    run: Run,
    file: Output,
    panels: Panels = "",
    crop: Crop = "",
    dark: DarkGround = False,
    as_json: Json = False,
) -> None:
    """Draw panels of a run for a slide or a paper: .pdf, .svg or .png."""
    from ommatid.reconstruct.output.slide import write_slide

    names = tuple(name.strip() for name in panels.split(",")) if panels else ()
    part = options.region("--crop", crop) if crop else None
    drawn = write_slide(run, file, names, part, dark)
    output.say(f"{file}: written, {', '.join(drawn)}")
    output.print_result({"file": str(file), "panels": list(drawn)}, [], as_json)


def _report_two(paths: Sequence[Path], folder: Path | None, baselines: bool, as_json: bool) -> None:
    """Write the page that compares two runs. Raises InputError for other numbers of them, or without a folder."""
    from ommatid.page.comparison import write_comparison

    if len(paths) != 2 or folder is None or baselines:
        got = "--baselines" if baselines else f"{len(paths)} folders" if len(paths) != 2 else "no -o"
        raise InputError(f"report: expected two folders of results to compare and -o DIR, got {got}")
    page = write_comparison(paths[0], paths[1], folder)
    output.print_json({"pages": [str(page)]}) if as_json else output.print_lines([str(page)])


def check(
    stack: StackFile,
    model: ModelFile,
    changes: Changes,
    scene_prior: ScenePrior = False,
    strict: Strict = False,
    as_json: Json = False,
) -> None:
    """Predict every sub-imager from all others.

    Names those that disagree: their H is wrong, or their pixels. Needs no truth.
    """
    from ommatid.batch.frames import FrameOptions
    from ommatid.pipeline.reconstruction import check_held_out_files
    from ommatid.reconstruct.output.verdict_words import held_out_rows

    common = FrameOptions(model, *changes.both)
    with output.progress_bar("check") as progress:
        report = check_held_out_files(stack, common, fitted=not scene_prior, progress=progress)
    output.print_result(report.plain(), [(f"{stack}, predicted sub-imagers", held_out_rows(report))], as_json)
    if strict and report.verdict.trusted is False:
        raise failures.BatchError(failures.NOT_TRUSTED)
