"""Compute the paper's figures and claims (Wood, Rajan and Christensen): plots, numbers and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from ommatid.figures.camera_drawing import camera_drawing
from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.runtime.files import write_text
from ommatid.runtime.outputs.kinds import check_output
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, stream
from ommatid.runtime.study import write_rows
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.scenes.tables.gallery import GALLERY

from . import figures
from .claims import CLAIMS, OWN, PAPER, Claim, error_claims, photograph_claims, rank_claims
from .figures import RECONSTRUCTION_NOISE, Shown
from .photographs import PHOTOGRAPH, Photograph, crop_tiles, load, reconstructed, simulate_trials
from .tile_errors import COMBINATIONS, THREE, Tiles, distortion, tiles, whole_frame

SIDE = 35  # of the photograph's tiles
MAP_NOISE = 1e-4  # variance
DISTORTION_SIDE, DISTORTION_NOISE = 19, 1e-2  # of the figure of distortion: side of the tile, variance of the maps
SIZE_NOISE = 1e-2  # variance, of the figure of tile sizes
PAGE = "index.html"
FIGURES = {  # with their captions; the first seven are numbered as in the paper
    "fig1": "Figure 1. The camera of the 19 x 19 tile: its section, its sensor, and one sub-image of each lens type",
    "fig2": "Figure 2. Error of the 19 x 19 tile against the noise, with one, two and three lens types",
    "fig3": "Figure 3. Error within the 19 x 19 tile, whole and trimmed",
    "fig4": "Figure 4. Error of the 35 x 35 tile against the noise",
    "fig5": "Figure 5. Tiles of three sizes with three lens types",
    "fig6": "Figure 6. A photograph, six of its tiles, and their estimates",
    "fig7": "Figure 7. Measured and predicted errors of the six tiles, against noise and bits",
    "tile_sizes": "Not in the paper: error and time against the size of a tile",
    "distortion": "Not in the paper: distortion as lens diversity",
}
PICTURES = tuple(f"{figure}.png" for figure in FIGURES)
TABLES = tuple(f"{figure}.csv" for figure in FIGURES if figure != "fig1")
FILES = (*PICTURES, *TABLES, CLAIMS, PAGE)


def write_paper(
    folder: Path,
    image: str = PHOTOGRAPH,
    seed: int = 0,
    progress: Progress = no_progress,
    files: FigureFiles = SCREEN_PNG,
) -> dict[str, Any]:
    """Write the figures as PNG and CSV, the claims, and a page of both; return a summary.

    image : the photograph of Fig. 7, a file or `photo:NAME`;  files : of the figures
    Raises InputError for an unsuitable image or folder, MachineError where it cannot be written.
    """
    started = perf_counter()
    picture = load(image)
    crops = crop_tiles(picture, SIDE, image, stream(seed, Purpose.FRACTIONS))
    with occupied(folder):
        for name in FILES:
            check_output(folder / name, Path(image))
        found = tiles()
        progress(0.5)
        photograph = simulate_trials(found[SIDE, THREE], image, crops, seed)
        claims = [*error_claims(found), *photograph_claims(photograph), *rank_claims()]
        progress(0.8)
        of_photograph = [found[SIDE, lenses] for lenses in COMBINATIONS]
        estimates = {tile.name: reconstructed(tile, crops.images, RECONSTRUCTION_NOISE, seed) for tile in of_photograph}
        shown = {"fig6": figures.reconstructions(picture, image, crops, estimates), **_figures(found, photograph)}
        for name, (figure, lines) in shown.items():
            files.replace(figure, folder / f"{name}.png")
            if lines:
                write_rows(folder / f"{name}.csv", lines)
        write_rows(folder / CLAIMS, [claim.row for claim in claims])
        write_text(folder / PAGE, page(claims))
    progress(1.0)
    return {
        "folder": str(folder),
        "files": list(FILES),
        "picture": {"image": image, "tile": SIDE, "places": [list(corner) for corner in crops.corners], "seed": seed},
        "claims": [asdict(claim) for claim in claims],
        "seconds": perf_counter() - started,
    }


def _figures(tiles: Tiles, photograph: Photograph) -> dict[str, Shown]:
    """Return all figures but the sixth by name, each with the rows of its table; the first has none."""
    camera = read(GALLERY / "tile19.toml")
    frames = {"+".join(lenses): whole_frame(lenses, SIZE_NOISE) for lenses in COMBINATIONS}
    return {
        "fig1": (camera_drawing(camera, derive(camera)), []),
        "fig2": figures.sweeps(tiles, 19),
        "fig3": figures.maps([tiles[19, lenses] for lenses in COMBINATIONS], MAP_NOISE),
        "fig4": figures.sweeps(tiles, 35),
        "fig5": figures.sides(tiles),
        "fig7": figures.photograph(photograph, SIDE),
        "tile_sizes": figures.tile_sizes(tiles, frames, SIZE_NOISE),
        "distortion": figures.distortion([tiles[DISTORTION_SIDE, THREE], *distortion()], DISTORTION_NOISE),
    }


def page(claims: Sequence[Claim]) -> str:
    """Return the page of all figures, each with the claims that it shows, as HTML."""
    from ommatid.page.document import fill

    figures = [(name, caption, [each for each in claims if each.figure == name]) for name, caption in FIGURES.items()]
    content = {"title": "Reconstruction with lens diversity: the paper", "figures": figures, "paper": PAPER}
    return fill("paper.html", {**content, "document": "", "stamp": ""})


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the lines of the printed table: each claim with its verdict and qualification."""
    lines: list[tuple[str, str]] = []
    for claim in summary["claims"]:
        remark = f": {claim['remark']}" if claim["remark"] else ""
        own = "not in the paper, " if claim["source"] == OWN else ""
        lines.append((claim["claim"], own + claim["holds"] + remark))
    return [
        *lines,
        ("figures and numbers", ", ".join(summary["files"])),
        ("seconds", f"{summary['seconds']:.1f}"),
    ]
