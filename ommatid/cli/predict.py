"""Commands that render no picture and expect errors from Eq. 5 alone: predict and design."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ommatid.runtime.errors import InputError

from . import failures, options, output
from .options import Changes, FolderIfAny, Formats, Json, Printing, SceneFile, SceneFiles, Sweeps

NoRays = Annotated[bool, typer.Option("--no-rays", help="A perfect H and a perfect rendering: Eq. 5 without rays.")]
Steer = Annotated[
    str,
    typer.Option(
        "--steer",
        metavar="RUN|ROW,COLUMN,ROWS,COLUMNS",
        help="Place windows where they lower the errors of a run or a region most.",
    ),
]


def predict(
    scenes: SceneFiles,
    changes: Changes,
    printing: Printing,
    sweep: Sweeps = None,
    folder: FolderIfAny = None,
    no_rays: NoRays = False,
    formats: Formats = "",
) -> None:
    """Predict the error, the rank and the null space of H, and compare several scenes.

    From Eq. 5, and a few rays where they matter: no picture is rendered.
    """
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import Batch, BatchFiles, batch_members, batch_warnings, run_batch
    from ommatid.pipeline.sections import predicted_lines, predicted_sections

    if folder is not None and not sweep:
        raise InputError("predict: -o is for the table and the plot of a --sweep; name keys to sweep, or leave it out")
    detail, figures = printing.detail, options.figure_files(formats)
    members = batch_members(scenes, Path(), sweep, *changes.both)
    output.warn_all(batch_warnings(members))
    with output.batch_bars(len(members), printing.quiet) as bars:
        predicted = partial(stages.predict_scene, rays=not no_rays)
        batch = Batch(predicted, bars.observer, lambda _, description: description)
        files = BatchFiles(folder, None, figures)
        outcome = run_batch(batch, members, failures.report, progress=bars.progress, files=files, with_folders=False)
    sections = predicted_sections(members, outcome, detail)
    if detail == "verdict":
        output.print_lines(predicted_lines(outcome.documents))
    failures.finish_batch(replace(outcome, sections=sections), printing.as_json)


def design(
    scene: SceneFile,
    changes: Changes,
    steer: Steer = "",
    folder: FolderIfAny = None,
    formats: Formats = "",
    as_json: Json = False,
) -> None:
    """Choose the best camera of the lens types of [design], with a bound on every other choice."""
    from ommatid.pipeline.design import prove_best_camera, steer_windows
    from ommatid.scenes.scene import read

    figures = options.figure_files(formats)
    described = read(scene, *changes.both)
    title = described.title or scene.stem
    with output.progress_bar("design") as progress:
        if steer:
            document, rows = steer_windows(described, steer, folder, figures)
            title = f"{title}: windows of further sub-imagers"
        else:
            document, rows = prove_best_camera(described, folder, figures, progress)
            title = f"{title}: the best camera"
    output.print_result(document, [(title, rows)], as_json)
