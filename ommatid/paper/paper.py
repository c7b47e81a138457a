"""Compute the paper's figures and claims (Wood, Rajan and Christensen): plots, numbers and verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.figures.camera_drawing import camera_drawing
from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import write_csv, write_text
from ommatid.runtime.outputs.kinds import check_output
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, stream
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.scenes.tables.gallery import GALLERY

from . import figures
from .claims import CLAIM_COLUMNS, CLAIMS, PAPER, Claim, error_claims, photograph_claims, rank_claims
from .figures import RECONSTRUCTION_NOISE
from .photographs import PHOTOGRAPH, Photograph, TileCrops, Trials, crop_tiles, load, reconstructed, simulate_trials
from .tile_errors import (
    ACTUAL,
    COMBINATIONS,
    SIDES,
    SIZES,
    THREE,
    PaperTile,
    Tiles,
    distortion,
    sweep,
    tiles,
    whole_frame,
)

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

Row = Sequence[str | float]


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
        return _write_all(folder, image, seed, progress, files, (picture, crops), started)


@dataclass(frozen=True)
class Computed:
    """What the figures show.

    picture : the whole photograph;  estimates : of its tiles by the lens types, (T, N)
    diverse : tiles of the figure of distortion;  frames : errors of a whole frame by the lens types
    """

    tiles: Tiles
    picture: FloatArray
    photograph: Photograph
    estimates: dict[str, FloatArray]
    diverse: list[PaperTile]
    frames: dict[str, float]


def _write_all(
    folder: Path,
    image: str,
    seed: int,
    progress: Progress,
    files: FigureFiles,
    pictures: tuple[FloatArray, TileCrops],
    started: float,
) -> dict[str, Any]:
    picture, crops = pictures
    computed = tiles()
    progress(0.5)
    photograph = simulate_trials(computed[SIDE, THREE], image, crops, seed)
    claims = [*error_claims(computed), *photograph_claims(photograph), *rank_claims()]
    progress(0.8)
    of_photograph = [computed[SIDE, lenses] for lenses in COMBINATIONS]
    estimates = {tile.name: reconstructed(tile, crops.images, RECONSTRUCTION_NOISE, seed) for tile in of_photograph}
    frames = {"+".join(lenses): whole_frame(lenses, SIZE_NOISE) for lenses in COMBINATIONS}
    diverse = [computed[DISTORTION_SIDE, THREE], *distortion()]
    shown = Computed(computed, picture, photograph, estimates, diverse, frames)
    _write_numbers(folder, shown)
    write_csv(folder / CLAIMS, CLAIM_COLUMNS, (claim.row for claim in claims))
    _write_figures(folder, shown, files)
    write_text(folder / PAGE, page(claims))
    progress(1.0)
    return {
        "folder": str(folder),
        "files": list(FILES),
        "picture": {"image": image, "tile": SIDE, "places": [list(corner) for corner in crops.corners], "seed": seed},
        "claims": [asdict(claim) for claim in claims],
        "seconds": perf_counter() - started,
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
        own = "" if claim["source"] == PAPER else "not in the paper, "
        lines.append((claim["claim"], own + claim["holds"] + remark))
    return [
        *lines,
        ("figures and numbers", ", ".join(summary["files"])),
        ("seconds", f"{summary['seconds']:.1f}"),
    ]


def _combinations(computed: Tiles, side: int) -> list[PaperTile]:
    return [computed[side, lenses] for lenses in COMBINATIONS]


def _write_figures(folder: Path, shown: Computed, files: FigureFiles) -> None:
    computed, photograph = shown.tiles, shown.photograph
    camera = read(GALLERY / "tile19.toml")
    files.replace(camera_drawing(camera, derive(camera)), folder / "fig1.png")
    figures.draw_sweeps(folder / "fig2.png", _combinations(computed, 19), files)
    figures.draw_maps(folder / "fig3.png", _combinations(computed, 19), MAP_NOISE, files)
    figures.draw_sweeps(folder / "fig4.png", _combinations(computed, 35), files)
    figures.draw_sides(folder / "fig5.png", [computed[side, THREE] for side in SIDES], files)
    figures.draw_reconstructions(folder / "fig6.png", shown.picture, photograph, shown.estimates, files)
    figures.draw_photograph(folder / "fig7.png", photograph, SIDE, files)
    figures.draw_tile_sizes(folder / "tile_sizes.png", computed, shown.frames, SIZE_NOISE, files)
    figures.draw_distortion(folder / "distortion.png", shown.diverse, DISTORTION_NOISE, files)


def _write_numbers(folder: Path, shown: Computed) -> None:
    computed, photograph, sweeps = shown.tiles, shown.photograph, ("lenses", "expected_noise_variance")
    columns = (*sweeps, "actual_noise_variance", "mse", "trimmed_mse")
    places = [f"tile_{row}_{column}" for row, column in photograph.crops.corners]
    swept = {side: (row for tile in _combinations(computed, side) for row in sweep(tile)) for side in (19, 35)}
    trials = [row for trials in (photograph.noisy, photograph.quantised) for row in _trial_rows(trials)]
    errors = {name: np.mean((each - photograph.crops.images) ** 2, axis=1) for name, each in shown.estimates.items()}
    tables: dict[str, tuple[Sequence[str], Iterable[Row]]] = {
        "fig2": (columns, swept[19]),
        "fig3": (("lenses", "row", "column", "expected_squared_error"), _map_rows(computed)),
        "fig4": (columns, swept[35]),
        "fig5": (("side", *columns[1:4]), _side_rows(computed)),
        "fig6": (("lenses", *places), ((name, *each) for name, each in errors.items())),
        "fig7": (("bits", "noise_variance", "predicted", "mean", *places), trials),
        "tile_sizes": (("lenses", "side", "mse", "mse_of_frame", "seconds"), _size_rows(shown)),
        "distortion": (("lenses", "measurements", "noise_variance", "mse"), _distortion_rows(shown.diverse)),
    }
    for name, (heading, lines) in tables.items():
        numbers = ([float(cell) if isinstance(cell, float) else cell for cell in line] for line in lines)
        write_csv(folder / f"{name}.csv", heading, numbers)


def _size_rows(shown: Computed) -> Iterable[Row]:
    for side, lenses in product(SIZES, COMBINATIONS):
        tile = shown.tiles[side, lenses]
        yield (tile.name, side, tile.mse(SIZE_NOISE), shown.frames[tile.name], tile.seconds)


def _distortion_rows(diverse: list[PaperTile]) -> Iterable[Row]:
    for tile, actual in product(diverse, map(float, ACTUAL)):
        yield (tile.name, tile.camera.measurements, actual, tile.mse(actual))


def _map_rows(computed: Tiles) -> Iterable[Row]:
    for tile in _combinations(computed, 19):
        for pixel, error in enumerate(tile.matched(MAP_NOISE)):
            yield (tile.name, *divmod(pixel, tile.side), error)


def _side_rows(computed: Tiles) -> Iterable[Row]:
    """Yield rows of every estimator that expects a fixed variance, then of the one that expects the actual one."""
    for side in SIDES:
        tile = computed[side, THREE]
        yield from ((side, *row[1:4]) for row in sweep(tile))
        yield from ((side, actual, actual, tile.mse(actual)) for actual in map(float, ACTUAL))


def _trial_rows(trials: Trials) -> Iterable[Row]:
    """Yield a row per level: bits, empty for noise, and the variance that the estimator expects."""
    for level, noise in enumerate(trials.noises):
        bits = "" if noise.bits is None else noise.bits
        variance = noise.variance + noise.quantisation_variance
        yield (bits, variance, trials.predicted[level], trials.mean[level], *trials.measured[level])
