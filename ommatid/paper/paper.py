"""Compute the paper's figures and claims (Wood, Rajan and Christensen): plots, numbers and verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.runtime.files import write_csv
from ommatid.runtime.outputs.kinds import check_output
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, stream

from . import figures
from .claims import PAPER, Claim, error_claims, photograph_claims, rank_claims, tile_claims
from .photographs import PHOTOGRAPH, Photograph, TileCrops, Trials, crop_tiles, load, simulate_trials
from .tile_errors import ACTUAL, COMBINATIONS, SIDES, THREE, PaperTile, Tiles, distortion, sweep, tiles

SIDE = 35  # of the photograph's tiles
MAP_NOISE = 1e-4  # variance
DISTORTION_SIDE, DISTORTION_NOISE = 19, 1e-2  # of the figure of distortion: side of the tile, variance of the maps
CLAIMS = "claims.csv"
FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig7", "distortion")
FILES = (*(f"{figure}.{suffix}" for figure in FIGURES for suffix in ("png", "csv")), CLAIMS)

Row = Sequence[str | float]


def write_paper(
    folder: Path,
    image: str = PHOTOGRAPH,
    seed: int = 0,
    progress: Progress = no_progress,
    files: FigureFiles = SCREEN_PNG,
) -> dict[str, Any]:
    """Write figures 2, 3, 4, 5, 7 and one of distortion, each as PNG and CSV, and the claims; return a summary.

    image : the photograph of Fig. 7, a file or `photo:NAME`;  files : of the figures
    Raises InputError for an unsuitable image or folder, MachineError where it cannot be written.
    """
    started = perf_counter()
    crops = crop_tiles(load(image), SIDE, image, stream(seed, Purpose.FRACTIONS))
    with occupied(folder):
        for name in FILES:
            check_output(folder / name, Path(image))
        return _write_all(folder, image, seed, progress, files, crops, started)


def _write_all(
    folder: Path, image: str, seed: int, progress: Progress, files: FigureFiles, crops: TileCrops, started: float
) -> dict[str, Any]:
    computed = tiles()
    progress(0.4)
    photograph = simulate_trials(computed[SIDE, THREE], image, crops, seed)
    progress(0.5)
    claims = [*error_claims(computed), *tile_claims(computed), *photograph_claims(photograph), *rank_claims()]
    progress(0.8)
    diverse = [computed[DISTORTION_SIDE, THREE], *distortion()]
    _write_numbers(folder, computed, photograph, diverse)
    write_csv(folder / CLAIMS, ("claim", "source", "holds", "numbers", "remark"), map(claim_row, claims))
    _write_figures(folder, computed, photograph, files)
    figures.draw_distortion(folder / "distortion.png", diverse, DISTORTION_NOISE, files)
    progress(1.0)
    return {
        "folder": str(folder),
        "files": list(FILES),
        "picture": {"image": image, "tile": SIDE, "places": [list(corner) for corner in crops.corners], "seed": seed},
        "claims": [asdict(claim) for claim in claims],
        "seconds": perf_counter() - started,
    }


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


def _write_figures(folder: Path, computed: Tiles, photograph: Photograph, files: FigureFiles) -> None:
    figures.draw_sweeps(folder / "fig2.png", _combinations(computed, 19), files)
    figures.draw_maps(folder / "fig3.png", _combinations(computed, 19), MAP_NOISE, files)
    figures.draw_sweeps(folder / "fig4.png", _combinations(computed, 35), files)
    figures.draw_sides(folder / "fig5.png", [computed[side, THREE] for side in SIDES], files)
    figures.draw_photograph(folder / "fig7.png", photograph, SIDE, files)


def _write_numbers(folder: Path, computed: Tiles, photograph: Photograph, diverse: list[PaperTile]) -> None:
    columns = ("lenses", "expected_noise_variance", "actual_noise_variance", "mse", "trimmed_mse")
    for name, side in (("fig2.csv", 19), ("fig4.csv", 35)):
        _write_table(folder / name, columns, (row for tile in _combinations(computed, side) for row in sweep(tile)))
    _write_table(folder / "fig3.csv", ("lenses", "row", "column", "expected_squared_error"), _map_rows(computed))
    _write_table(folder / "fig5.csv", ("side", *columns[1:4]), _side_rows(computed))
    numbered = [f"tile_{row}_{column}" for row, column in photograph.crops.corners]
    trials = [row for trials in (photograph.noisy, photograph.quantised) for row in _trial_rows(trials)]
    _write_table(folder / "fig7.csv", ("bits", "noise_variance", "predicted", "mean", *numbered), trials)
    _write_table(
        folder / "distortion.csv",
        ("lenses", "measurements", "noise_variance", "mse"),
        (
            (tile.name, tile.camera.measurements, actual, tile.mse(actual))
            for tile in diverse
            for actual in map(float, ACTUAL)
        ),
    )


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


def claim_row(claim: Claim) -> Row:
    """Return a claim as a row of claims.csv."""
    numbers = "; ".join(f"{name}: {number:.9g}" for name, number in claim.numbers.items())
    return claim.claim, claim.source, claim.holds, numbers, claim.remark


def _write_table(path: Path, columns: Sequence[str], lines: Iterable[Row]) -> None:
    """Write a CSV file of numbers to their last digit."""
    write_csv(path, columns, ([float(cell) if isinstance(cell, float) else cell for cell in line] for line in lines))
