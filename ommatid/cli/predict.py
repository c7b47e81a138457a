"""Commands that render no picture and expect errors from Eq. 5 alone: predict and design."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ommatid.runtime.errors import InputError

from . import failures, options, output
from .options import SCREEN, FigureFormats, FigureResolution, Json, Lenses, SceneFile, Sets, Sweeps

if TYPE_CHECKING:
    from ommatid.figures.saving import FigureFiles

SweepFolder = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder of the table and the plot of --sweep.")
]
DesignFolder = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="DIR", help="Folder of the best cameras and the front."),
]
NoRays = Annotated[
    bool, typer.Option("--no-rays", help="A perfect H and a perfect rendering for every scene: Eq. 5 without rays.")
]
Candidates = Annotated[
    str, typer.Option("--candidates", metavar="1/M,...", help="Magnifications; dots continue the step before.")
]


Steer = Annotated[
    str,
    typer.Option(
        "--steer",
        metavar="RUN|ROW,COLUMN,ROWS,COLUMNS",
        help="Place the windows of [design] where they lower a run's errors, or those of a region, most.",
    ),
]


def predict(
    scene: SceneFile,
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    folder: SweepFolder = None,
    no_rays: NoRays = False,
    figure_formats: FigureFormats = "",
    figure_resolution: FigureResolution = SCREEN,
    as_json: Json = False,
) -> None:
    """Predict the error, the rank and the null space of H.

    From Eq. 5, and a few rays where they matter: no picture is rendered.
    """
    asked = options.changes(sets), options.lens_names(lens)
    if sweep:
        figures = options.figure_files(figure_formats, figure_resolution)
        _predict_sweep(scene, sweep, folder, *asked, not no_rays, figures, as_json)
        return
    if folder is not None:
        raise InputError("predict: -o is for the table and the plot of a --sweep; name keys to sweep, or leave it out")
    from ommatid.analysis.predict import electrons, predict_scene
    from ommatid.analysis.prediction_table import json_of
    from ommatid.pipeline.sections import prediction_sections
    from ommatid.runtime.errors import naming_source
    from ommatid.scenes.formats.picture import conversions
    from ommatid.scenes.scene import read
    from ommatid.scenes.setup import Setup

    described = read(scene, *asked)
    output.warn_all(conversions(described))
    with naming_source(described.source):
        prediction, light = predict_scene(described, rays=not no_rays), electrons(Setup.from_scene(described))
    sections = prediction_sections(described, prediction, light)
    document = {"scene": str(scene), **json_of(prediction), **({} if light is None else {"light": light})}
    output.print_result([document], sections, as_json)


def design(
    scene: SceneFile,
    candidates: Candidates = "",
    steer: Steer = "",
    sets: Sets = None,
    lens: Lenses = "",
    folder: DesignFolder = None,
    figure_formats: FigureFormats = "",
    figure_resolution: FigureResolution = SCREEN,
    as_json: Json = False,
) -> None:
    """Choose lens types, with a bound on every other choice.

    Without --candidates: the best camera of the lens types of [design], with as many readings as the scene's.
    With it: the expected error (Eq. 5) with one more lens type of each magnification.
    """
    from ommatid.analysis.best_camera import candidates as candidates_of
    from ommatid.analysis.design import magnifications
    from ommatid.pipeline.design import compare_lens_types, prove_best_camera, steer_windows
    from ommatid.scenes.scene import read
    from ommatid.scenes.tables.estimation import DesignTable

    if candidates and (folder is not None or steer):
        raise InputError("design: --candidates writes no files and places no windows; leave it out, or -o and --steer")
    added = magnifications(candidates) if candidates else []
    figures = options.figure_files(figure_formats, figure_resolution)
    described = read(scene, options.changes(sets), options.lens_names(lens))
    title = described.title or scene.stem
    with output.progress_bar("design") as progress:
        if candidates:
            comparison = compare_lens_types(described, added, progress)
            document, rows = comparison.describe(), comparison.rows()
            title = f"{title}: the expected error with one more lens type"
        elif steer:
            document, rows = steer_windows(described, steer, folder, figures)
            title = f"{title}: windows of further sub-imagers"
        else:
            listed = magnifications((described.design or DesignTable()).magnifications, "design.magnifications")
            wanted = candidates_of(described, listed)
            document, rows = prove_best_camera(described, wanted, folder, figures, progress)
            title = f"{title}: the best camera"
    output.print_result(document, [(title, rows)], as_json)


def _predict_sweep(
    scene: Path,
    sweep: list[str],
    folder: Path | None,
    changes: tuple[str, ...],
    lenses: tuple[str, ...],
    rays: bool,
    figures: FigureFiles,
    as_json: bool,
) -> None:
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import batch_members, run_batch, scene_batch

    members = batch_members([scene], Path(), sweep, changes, lenses)
    predicted = partial(stages.predict_scene, rays=rays)
    batch = scene_batch(predicted, output.observer, lambda _, description: description)
    outcome = run_batch(batch, members, failures.report, sweep_folder=folder, with_folders=False, figures=figures)
    failures.finish_batch(outcome, as_json)
