"""The commands that need no scene file: reconstruct and check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import failures, frames, options, output
from .options import Json, Lenses, Sets, Strict

StackAndModel = Annotated[
    list[Path],
    typer.Argument(
        metavar="STACK... MODEL",
        help="Recorded sub-images, stack.exr, of one frame or several, then their observation model, model.npz.",
    ),
]
Estimates = Annotated[
    Path,
    typer.Option("-o", "--output", metavar="FILE", help="File to write; of several stacks the folder of their files."),
]
StackFile = Annotated[Path, typer.Argument(metavar="STACK", help="Recorded sub-images, stack.exr.")]
ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Their observation model, model.npz.")]
Regions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        metavar="ROW,COLUMN,ROWS,COLUMNS",
        help="Print the mean of a region with its posterior standard deviation; may be repeated.",
        show_default=False,
    ),
]
TileScheduler = Annotated[
    str, typer.Option("--scheduler", metavar="ADDRESS", help="Send the tiles of a frame to this Dask cluster.")
]
TileWorkers = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", min=1, help="Distribute several stacks, or the tiles of one, over N processes."
    ),
]
ScenePrior = Annotated[
    bool,
    typer.Option(
        "--scene-prior", help="Assume the scene's prior (default: an independent one is replaced by a fitted one)."
    ),
]
StrictCheck = Annotated[bool, typer.Option("--strict", help="Exit with code 3 if the result is not to be trusted.")]


def reconstruct(
    files: StackAndModel,
    file: Estimates,
    sets: Sets = None,
    lens: Lenses = "",
    region: Regions = None,
    scheduler: TileScheduler = "",
    workers: TileWorkers = None,
    strict: Strict = False,
    as_json: Json = False,
) -> None:
    """Reconstruct from files alone: one frame, or several of one camera."""
    from ommatid.analysis import run_table
    from ommatid.pipeline.reconstruction import reconstruct_files
    from ommatid.reconstruct.output.verdict_words import is_trusted

    *stacks, model = files
    asked = options.changes(sets), options.lens_names(lens), options.regions(region)
    if len(stacks) != 1 or file.is_dir():
        frames.reconstruct(stacks, model, file, *asked, scheduler, workers, strict, as_json)
        return
    stack = stacks[0]
    with output.progress_bar("reconstruct") as progress:
        report = reconstruct_files(stack, model, file, *asked, progress, scheduler, workers)
    output.print_result({"file": str(file), **report.plain()}, [(str(file), run_table.rows(report))], as_json)
    if strict and not is_trusted(report):
        raise failures.BatchError(failures.NOT_TRUSTED)


def check(
    stack: StackFile,
    model: ModelFile,
    sets: Sets = None,
    lens: Lenses = "",
    scene_prior: ScenePrior = False,
    strict: StrictCheck = False,
    as_json: Json = False,
) -> None:
    """Predict every sub-imager from all others.

    Names those that disagree: their H is wrong, or their pixels. Needs no truth.
    """
    from ommatid.analysis.held_out import table
    from ommatid.pipeline.held_out import check_files

    asked = options.changes(sets), options.lens_names(lens)
    with output.progress_bar("check") as progress:
        report = check_files(stack, model, *asked, fitted=not scene_prior, progress=progress)
    output.print_result(report.plain(), [(f"{stack}, predicted sub-imagers", table.rows(report))], as_json)
    if strict and report.verdict.trusted is False:
        raise failures.BatchError(failures.NOT_TRUSTED)
