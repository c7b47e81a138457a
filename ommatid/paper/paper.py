"""The paper's figures and claims in one go (Wood, Rajan and Christensen), computed anew: plots, numbers and verdicts.

H of a perfect camera and the recording of its light are passed in; everything else is Eq. 4 and Eq. 5.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.runtime.files import check_output, make_folder, write_csv
from ommatid.runtime.progress import Progress, no_progress

from . import figures
from .claims import Claim, errors, ranks
from .photograph_claims import pictures
from .photographs import PHOTOGRAPH, Photograph, Record, Trials, cut, load, seeds, simulate_trials
from .tile_errors import ACTUAL, COMBINATIONS, SIDES, THREE, MatrixOf, PaperTile, Tiles, distortion, sweep, tiles

SIDE = 35  # of the photograph's tiles
FRACTIONS = 3  # experiment by whose seed pixels get fractions
SHOWN = 1e-4  # noise variance of the maps
SMALLEST, BENT = 19, 1e-2  # side of the tile, and noise variance of the maps, of the figure of distortion
CLAIMS = "claims.csv"
FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig7", "distortion")

Row = Sequence[str | float]


def write_paper(
    folder: Path,
    matrix_of: MatrixOf,
    record: Record,
    image: str = PHOTOGRAPH,
    seed: int = 0,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write figures 2, 3, 4, 5, 7 and one of distortion, each as PNG and CSV, and the claims; say what was found.

    matrix_of : H, (M, N), of a perfect camera
    record : from the light, (M,), of a camera, the noise and its seed to recorded values, (M,)
    image : the photograph of Fig. 7, a file or `photo:NAME`
    Raises InputError for a picture or a folder that will not do, DeniedError where it cannot be written.
    """
    started = perf_counter()
    chosen = cut(load(image), SIDE, image, np.random.default_rng(seeds(seed, FRACTIONS)(0, 0)))
    make_folder(folder)
    for name in _names():
        check_output(folder / name, Path(image))
    computed = tiles(matrix_of)
    progress(0.4)
    found = simulate_trials(computed[SIDE, THREE], image, chosen, record, seed)
    progress(0.5)
    judged = [*errors(computed), *ranks(matrix_of), *pictures(found)]
    progress(0.8)
    diverse = [computed[SMALLEST, THREE], *distortion(matrix_of)]
    _write_numbers(folder, computed, found, judged)
    write_csv(folder / "distortion.csv", ("lenses", "measurements", "noise_variance", "mse"), _diverse(diverse))
    _write_figures(folder, computed, found)
    figures.draw_distortion(folder / "distortion.png", diverse, BENT)
    progress(1.0)
    return {
        "folder": str(folder),
        "files": list(_names()),
        "picture": {"image": image, "tile": SIDE, "places": [list(place) for place in chosen.places], "seed": seed},
        "claims": [asdict(claim) for claim in judged],
        "seconds": perf_counter() - started,
    }


def rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of the printed table: each claim, and whether it holds, with the catch."""
    lines: list[tuple[str, str]] = []
    for claim in description["claims"]:
        catch = f": {claim['remark']}" if claim["remark"] else ""
        lines.append((claim["claim"], claim["holds"] + catch))
    return [
        *lines,
        ("figures and numbers", ", ".join(description["files"])),
        ("seconds", f"{description['seconds']:.1f}"),
    ]


def _names() -> tuple[str, ...]:
    return *(f"{figure}.{kind}" for figure in FIGURES for kind in ("png", "csv")), CLAIMS


def _combinations(computed: Tiles, side: int) -> list[PaperTile]:
    return [computed[side, lenses] for lenses in COMBINATIONS]


def _write_figures(folder: Path, computed: Tiles, found: Photograph) -> None:
    figures.draw_sweeps(folder / "fig2.png", _combinations(computed, 19))
    figures.draw_maps(folder / "fig3.png", _combinations(computed, 19), SHOWN)
    figures.draw_sweeps(folder / "fig4.png", _combinations(computed, 35))
    figures.draw_sides(folder / "fig5.png", [computed[side, THREE] for side in SIDES])
    figures.draw_photograph(folder / "fig7.png", found, SIDE)


def _write_numbers(folder: Path, computed: Tiles, found: Photograph, judged: list[Claim]) -> None:
    columns = ("lenses", "expected_noise_variance", "actual_noise_variance", "mse", "trimmed_mse")
    for name, side in (("fig2.csv", 19), ("fig4.csv", 35)):
        write_csv(folder / name, columns, (row for tile in _combinations(computed, side) for row in sweep(tile)))
    write_csv(folder / "fig3.csv", ("lenses", "row", "column", "expected_squared_error"), _maps(computed))
    write_csv(folder / "fig5.csv", ("side", *columns[1:4]), _sides(computed))
    numbered = [f"tile_{place[0]}_{place[1]}" for place in found.cut.places]
    write_csv(folder / "fig7.csv", ("bits", "noise_variance", "predicted", "mean", *numbered), _measured(found))
    write_csv(folder / CLAIMS, ("claim", "holds", "numbers", "remark"), map(_claim, judged))


def _maps(computed: Tiles) -> Iterable[Row]:
    for tile in _combinations(computed, 19):
        for place, error in enumerate(tile.matched(SHOWN)):
            yield (tile.name, *divmod(place, tile.side), error)


def _sides(computed: Tiles) -> Iterable[Row]:
    """Every estimator that expects a fixed variance, then the one that expects the actual one."""
    for side in SIDES:
        tile = computed[side, THREE]
        yield from ((side, *row[1:4]) for row in sweep(tile))
        yield from ((side, actual, actual, tile.mse(actual)) for actual in map(float, ACTUAL))


def _diverse(shown: list[PaperTile]) -> Iterable[Row]:
    for tile in shown:
        yield from ((tile.name, tile.camera.measurements, actual, tile.mse(actual)) for actual in map(float, ACTUAL))


def _measured(found: Photograph) -> Iterable[Row]:
    """Of noise first, with bits left empty, then of quantisation, with the variance that the estimator expects."""
    for trials in (found.noisy, found.quantised):
        yield from _levels(trials)


def _levels(trials: Trials) -> Iterable[Row]:
    for level, noise in enumerate(trials.noises):
        bits = "" if noise.bits is None else noise.bits
        variance = noise.variance + noise.quantisation_variance
        yield (bits, variance, trials.predicted[level], trials.mean[level], *trials.measured[level])


def _claim(claim: Claim) -> Row:
    numbers = "; ".join(f"{name}: {number:.9g}" for name, number in claim.numbers.items())
    return claim.claim, claim.holds, numbers, claim.remark
