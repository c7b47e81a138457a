"""The claims of the paper on what trimming, larger tiles, a second set of lenses and joined tiles bring.

Errors are expected squared errors per pixel (Eq. 5) in squared units of f, at the least noise of the figures; the
estimator expects the actual noise.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np

from ommatid.reconstruct.methods.tile_merging import Posterior, disjoint_tiles, merge_posteriors, tile_posterior
from ommatid.reconstruct.problem import Problem

from .claims import NO, Claim, verdict
from .tile_errors import ACTUAL, COMBINATIONS, COMPLETE_SIDES, LEAST, THREE, TWO, PaperTile, Tiles, inner, tile

EQUAL = 1e-9  # relative difference of errors that two methods compute in float64
JOINED_SIDE, PARTS = 35, 2  # of the tile that is cut into parts, and parts along either axis


def tile_claims(tiles: Tiles) -> list[Claim]:
    """Check the claims that compare tiles and combinations of lens types."""
    trimming = [_relative_trimming(tiles, side) for side in COMPLETE_SIDES]
    return [*trimming, _null_space(tiles), _second_set(tiles), _joined(tiles)]


def _relative_trimming(tiles: Tiles, side: int) -> Claim:
    errors = {lenses: tiles[side, lenses].matched(LEAST) for lenses in (TWO, THREE)}
    removed = {lenses: 1 - inner(error, side) / float(error.mean()) for lenses, error in errors.items()}
    holds = verdict(removed[THREE] < removed[TWO])
    remark = f"does not hold: it removes {removed[THREE]:.1%} with three types and {removed[TWO]:.1%} with two"
    return Claim(
        f"three types: trimming the {side} x {side} tile brings relatively less than with two",
        holds,
        {f"{'+'.join(lenses)}: share of the error that it removes": share for lenses, share in removed.items()},
        remark if holds == NO else "",
    )


def _null_space(tiles: Tiles) -> Claim:
    small, large = COMPLETE_SIDES
    ratios = {lenses: tiles[small, lenses].mse(LEAST) / tiles[large, lenses].mse(LEAST) for lenses in COMBINATIONS}
    limited = {lenses: all(tiles[side, lenses].floor > 0 for side in COMPLETE_SIDES) for lenses in COMBINATIONS}
    most_open = min(ratio for lenses, ratio in ratios.items() if limited[lenses])
    most_complete = max(ratio for lenses, ratio in ratios.items() if not limited[lenses])
    return Claim(
        f"the {large} x {large} tile helps most where a null space limits the error",
        verdict(most_open > most_complete),
        {f"{'+'.join(lenses)}: error of {small} over error of {large}": ratio for lenses, ratio in ratios.items()},
    )


def _second_set(tiles: Tiles) -> Claim:
    """Compare two sets of every lens type with one set at half the noise, which averaging them would leave."""
    numbers: dict[str, float] = {}
    holds = True
    for (side, lenses), two in tiles.items():
        if len(set(lenses)) == 1:
            one = tile(side, lenses[:1])
            halved = [abs(two.mse(noise) / one.mse(noise / 2) - 1) for noise in map(float, ACTUAL)]
            holds &= max(halved) < EQUAL and one.form.rank == two.form.rank
            numbers[f"{side}: largest relative difference from one set at half the noise"] = max(halved)
            numbers[f"{side}: null space of one set"] = two.camera.unknowns - one.form.rank
            numbers[f"{side}: null space of two"] = two.camera.unknowns - two.form.rank
            numbers[f"{side}: error of two over error of one, noise {LEAST:g}"] = two.mse(LEAST) / one.mse(LEAST)
    return Claim("a second equal set of lenses only averages noise", verdict(holds), numbers)


def _joined(tiles: Tiles) -> Claim:
    """Compare a tile that Eq. 7 joins from four with the whole, and with the four before they are joined."""
    numbers: dict[str, float] = {}
    holds = True
    for lenses in (TWO, THREE):
        whole = tiles[JOINED_SIDE, lenses]
        parts = _parts(whole)
        apart = float(np.concatenate([part.variance for part in parts]).mean())
        joined = _join(whole, parts).variance
        difference = float(np.abs(joined / whole.matched(LEAST) - 1).max())
        holds &= difference < EQUAL and apart > whole.mse(LEAST)
        numbers[f"{whole.name}: error of four parts of the {whole.side} x {whole.side} tile"] = apart
        numbers[f"{whole.name}: joined"] = float(joined.mean())
        numbers[f"{whole.name}: error of the whole tile"] = whole.mse(LEAST)
        numbers[f"{whole.name}: largest relative difference of a pixel"] = difference
    return Claim("joining tiles by Eq. 7 brings what a larger tile brings", verdict(holds), numbers)


def _parts(whole: PaperTile) -> list[Posterior]:
    half = -(-whole.side // PARTS)
    problem = _quiet(whole)
    return [
        tile_posterior(problem, np.zeros(problem.measurements), pixels)
        for pixels in disjoint_tiles(whole.camera.shape, (half, half))
    ]


def _join(whole: PaperTile, parts: list[Posterior]) -> Posterior:
    problem = _quiet(whole)
    return reduce(lambda one, other: merge_posteriors(one, other, problem, np.zeros(problem.measurements)), parts)


def _quiet(whole: PaperTile) -> Problem:
    """Return the problem of a tile at the least noise."""
    problem = whole.form.problem
    return replace(problem, noise_variance=LEAST * problem.noise_variance)
