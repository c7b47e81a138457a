"""The command that needs no scene file: reconstruct."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import failures, options, output
from .options import Json, Lenses, Output, Sets, Strict

StackFile = Annotated[Path, typer.Argument(metavar="STACK", help="Recorded sub-images, stack.exr.")]
ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Their observation model, model.npz.")]
Region = Annotated[
    str,
    typer.Option(
        "--region",
        metavar="ROW,COLUMN,ROWS,COLUMNS",
        help="Print the mean of a region with its posterior standard deviation.",
    ),
]
TileScheduler = Annotated[
    str, typer.Option("--scheduler", metavar="ADDRESS", help="Send the tiles of a frame to this Dask cluster.")
]
TileWorkers = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", min=1, help="Distribute the tiles of a frame over N processes."),
]


def reconstruct(
    stack: StackFile,
    model: ModelFile,
    file: Output,
    sets: Sets = None,
    lens: Lenses = "",
    region: Region = "",
    scheduler: TileScheduler = "",
    workers: TileWorkers = None,
    strict: Strict = False,
    as_json: Json = False,
) -> None:
    """Reconstruct from files alone."""
    from ommatid.analysis import run_table
    from ommatid.pipeline.reconstruction import reconstruct_files
    from ommatid.reconstruct.output.verdict_words import is_trusted

    asked = options.changes(sets), options.lens_names(lens), options.region(region)
    with output.progress_bar("reconstruct") as progress:
        report = reconstruct_files(stack, model, file, *asked, progress, scheduler, workers)
    output.print_result({"file": str(file), **report.plain()}, [(str(file), run_table.rows(report))], as_json)
    if strict and not is_trusted(report):
        raise failures.BatchError(failures.NOT_TRUSTED)
