"""Commands on the program's own numbers: the paper's claims, numerical stability, error against run time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from . import options, output
from .options import Changes, Folder, Formats, Json, SceneFile, Within

Photograph = Annotated[
    str, typer.Option("--image", metavar="FILE", help="Photograph of Figures 6 and 7, or photo:NAME.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of the noise in Figures 6 and 7.")]
Which = Annotated[
    Literal["lens-diversity", "multiscale"],
    typer.Option("--which", help="Wood, Rajan and Christensen, or Fu, Litterio, Felzenszwalb and Zia."),
]


def paper(
    folder: Folder = Path("paper"),
    which: Which = "lens-diversity",
    image: Photograph = "photo:camera",
    seed: Seed = 0,
    formats: Formats = "",
    as_json: Json = False,
) -> None:
    """Compute the paper's figures and claims anew, or the expected errors of a second one."""
    from ommatid.paper import multiscale
    from ommatid.paper.paper import rows, write_paper

    if which == "multiscale":
        title = "Expected errors by pixels of several sizes"
        with output.progress_bar("paper") as progress:
            description = multiscale.write_multiscale(folder, progress)
    else:
        title, figures = f"The paper's claims: {folder / 'index.html'}", options.figure_files(formats)
        with output.progress_bar("paper") as progress:
            description = write_paper(folder, image, seed, progress, figures)
    output.print_result(description, [(title, rows(description))], as_json)


def stability(
    folder: Folder = Path("stability"),
    formats: Formats = "",
    as_json: Json = False,
) -> None:
    """Count correct digits on stiff and extreme cases, against exact arithmetic."""
    from ommatid.scenes.camera import derive
    from ommatid.scenes.scene import read
    from ommatid.scenes.tables.gallery import GALLERY
    from ommatid.simulate.ideal import ideal_matrix
    from ommatid.stability.cases import CHANGES, LENSES
    from ommatid.stability.stability import rows, write_stability

    figures = options.figure_files(formats)
    tile = GALLERY / "tile19.toml"
    matrices = {name: ideal_matrix(derive(read(tile, CHANGES, lenses))) for name, lenses in LENSES.items()}
    with output.progress_bar("stability") as progress:
        summary = write_stability(folder, matrices, progress, figures)
    output.print_result(summary, [("Stiff and extreme cases", rows(summary))], as_json)


def bench(
    scene: SceneFile,
    changes: Changes,
    folder: Folder = Path("out"),
    within: Within = "4 min",
    formats: Formats = "",
    as_json: Json = False,
) -> None:
    """Measure error against run time of every stage.

    Takes samplers, methods and algorithms with more and more samples, and recommends the cheapest that reach the noise.
    """
    from ommatid.bench.bench import bench as measure
    from ommatid.bench.bench import rows
    from ommatid.bench.figure import write_figures
    from ommatid.figures.saving import SCREEN_PNG
    from ommatid.pipeline.stages import open_scene

    figures, seconds = options.figure_files(formats), options.seconds(within)
    setup = open_scene(scene, *changes.both)
    with output.progress_bar("bench") as progress:
        table, made = measure(setup, folder, seconds, progress)
    if figures != SCREEN_PNG:
        write_figures(folder, table, figures)
    output.say_done("bench", made, folder / "bench.json")
    output.print_result(table.describe(), [(f"Error against run time: {table.title}", rows(table))], as_json)
