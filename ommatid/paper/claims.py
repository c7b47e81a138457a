"""The claims of the paper (Wood, Rajan and Christensen), each with the numbers that decide whether it holds.

Errors are expected squared errors a pixel (Eq. 5) in squared units of f, noise means its variance. Where nothing else
is said the estimator expects what the noise is.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import inf, isfinite

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.prediction import observability

from .tile_errors import (
    ACTUAL,
    DRAWN,
    EXPECTED,
    LEAST,
    SIDES,
    THREE,
    TWICE,
    TWO,
    MatrixOf,
    PaperTile,
    Tiles,
    gallery,
    inner,
)

YES, NO, CATCH = "yes", "no", "with a catch"
SAME = 1.1  # curves within this factor cannot be told apart on axes of eight decades
TEN = (8.0, 12.5)  # "about 10 times"
FEW_TIMES = 3.0  # the order of magnitude of ten, at least
SLIGHTLY = 0.8  # of an error: below it "slightly better" says too little
LOUD, QUIET = 1.0, 0.1  # noise variances of which the claims speak


@dataclass(frozen=True)
class Claim:
    """What the paper says, whether it holds (yes, no, with a catch), the numbers, and the catch in words."""

    claim: str
    holds: str
    numbers: dict[str, float]
    remark: str = ""


def verdict(holds: bool, catch: bool = False) -> str:
    """The word for it."""
    return (CATCH if catch else YES) if holds else NO


def errors(tiles: Tiles) -> list[Claim]:
    """The claims on expected errors, which are Fig. 2 to 5."""
    return [
        claim(tiles)
        for claim in (_one_type, _two_types, _null_space, _three_types, _edges, _trimming, _larger_tile, _longer_lenses)
    ]


def ranks(matrix_of: MatrixOf) -> list[Claim]:
    """The claims on what H leaves open."""
    return [_one_rank(matrix_of), _two_ranks(matrix_of)]


def _one_type(tiles: Tiles) -> Claim:
    apart = {side: _apart(tiles[side, TWICE]) for side in DRAWN}
    floors = {side: tiles[side, TWICE].floor for side in DRAWN}
    catch = apart[35] > SAME
    why = (
        f"not on the 35 x 35 tile: type I sees all of it, its floor is {floors[35]:.4g} and no longer {floors[19]:.4g},"
        " and noise of variance 1 shows above it"
    )
    return Claim(
        "two sets of type I: all estimators are indistinguishable and flat below noise 1",
        verdict(apart[19] <= SAME, catch),
        {f"{side}: largest error over smallest": ratio for side, ratio in apart.items()},
        why if catch else "",
    )


def _apart(tile: PaperTile) -> float:
    """Largest over smallest mean error of all estimators for noise up to 1; each error is a line, so its ends do."""
    lines = [tile.line(expected) for expected in EXPECTED]
    errors = [float(line.at(actual).mean()) for line in lines for actual in (LEAST, LOUD)]
    return max(errors) / min(errors)


def _two_types(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    better, never = True, False
    for side in DRAWN:
        one, two = ([tiles[side, lenses].line(expected) for expected in EXPECTED] for lenses in (TWICE, TWO))
        crossings = [first.crossing(second) for first, second in zip(one, two, strict=True)]
        crossed = [noise for noise in crossings if isfinite(noise)]
        better &= min(crossings) > QUIET and all(
            first.prior.mean() > second.prior.mean() for first, second in zip(one, two, strict=True)
        )
        never |= len(crossed) < len(crossings)
        if crossed:
            numbers |= {f"{side}: least noise at which they cross": min(crossed)}
            numbers |= {f"{side}: largest noise at which they cross": max(crossed)}
    why = "two types stay the better ones far beyond 0.1"
    why += ", on the 35 x 35 tile for some estimators at any noise" if never else ""
    return Claim(
        "two types are better than one (two sets of it) below noise 0.1",
        verdict(better, min(numbers.values(), default=inf) > 10 * QUIET),
        numbers,
        why if better else "",
    )


def _null_space(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    holds = True
    for side in DRAWN:
        for lenses in (TWICE, TWO):
            tile, least = tiles[side, lenses], tiles[side, lenses].mse(LEAST)
            holds &= tile.floor > 0 and least < 1.001 * tile.floor
            numbers[f"{side} {tile.name}: error at noise 1e-6"] = least
            numbers[f"{side} {tile.name}: the prior's in the null space"] = tile.floor
    return Claim("one type or two: the null space keeps the error from improving at low noise", verdict(holds), numbers)


def _three_types(tiles: Tiles) -> Claim:
    knees = {
        (side, expected): tiles[side, THREE].line(expected).knee / expected for side in DRAWN for expected in EXPECTED
    }
    return Claim(
        "three types: the error falls with the noise until below the expected variance",
        verdict(max(knees.values()) < 1),
        {
            f"{side}: noise where it flattens over the expected {expected:g}": knee
            for (side, expected), knee in knees.items()
        },
    )


def _edges(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    holds = True
    for side in DRAWN:
        error = tiles[side, TWO].matched(LEAST)
        row, column = divmod(int(error.argmax()), side)
        away = min(row, column, side - 1 - row, side - 1 - column)
        full, within = float(error.mean()), inner(error, side)
        holds &= away < TRIM and within < full
        numbers[f"{side}: largest error"] = float(error.max())
        numbers[f"{side}: its distance from the border, pixels"] = away
        numbers[f"{side}: mean"] = full
        numbers[f"{side}: mean, trimmed by {TRIM}"] = within
    return Claim(
        "two types: the error is largest at the tile's edges, and trimming lowers the average", verdict(holds), numbers
    )


def _trimming(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    holds, catch = True, False
    for side in DRAWN:
        error, tile = tiles[side, TWICE].matched(LEAST), tiles[side, TWICE]
        kind = tile.camera.types[0]
        first, seen = kind.origin[0], int(kind.span[0])
        view = error.reshape(side, side)[first : first + seen, first : first + seen].ravel()
        holds &= inner(view, seen, 1) >= view.mean()
        numbers[f"{side}: mean of the {seen} x {seen} pixels it sees"] = float(view.mean())
        numbers[f"{side}: trimmed by 1"] = inner(view, seen, 1)
        if seen < side:
            catch = True
            numbers[f"{side}: mean of the whole tile"] = float(error.mean())
            numbers[f"{side}: whole tile trimmed by {TRIM}"] = inner(error, side)
    why = "on the whole 19 x 19 tile trimming does lower the average: the pixels that type I does not see go"
    return Claim(
        "type I alone: trimming does not lower the average",
        verdict(holds, catch),
        numbers,
        why if holds and catch else "",
    )


def _larger_tile(tiles: Tiles) -> Claim:
    small, large = ([tiles[side, THREE].line(expected) for expected in EXPECTED] for side in DRAWN)
    ratios = [
        float(second.at(noise).mean() / first.at(noise).mean())
        for first, second in zip(small, large, strict=True)
        for noise in map(float, ACTUAL)
    ]
    return Claim(
        "three types: the 35 x 35 tile does slightly better than the 19 x 19",
        verdict(max(ratios) < 1, min(ratios) < SLIGHTLY),
        {"error of 35 over error of 19, least": min(ratios), "largest": max(ratios)},
        "better it does, by more than slightly" if min(ratios) < SLIGHTLY and max(ratios) < 1 else "",
    )


def _longer_lenses(tiles: Tiles) -> Claim:
    # The error of three types is in proportion to small noise: ratios of error are ratios of noise.
    ratios = [tiles[41, THREE].mse(LEAST) / tiles[side, THREE].mse(LEAST) for side in DRAWN]
    about = [TEN[0] <= ratio <= TEN[1] for ratio in ratios]
    return Claim(
        "41 x 41 with 1/5, 1/6 and 1/7 needs about 10 times less noise for the same error",
        verdict(min(ratios) > FEW_TIMES, not all(about)),
        {f"times less than {side}": ratio for side, ratio in zip(DRAWN, ratios, strict=True)},
        "less noise it needs, but not ten times less" if min(ratios) > FEW_TIMES and not all(about) else "",
    )


def _open_axis(side: int, lens: str) -> int:
    """a: dimensions that a lens type leaves open along one axis, m - 1 plus the pixels it does not see."""
    kind = gallery(side, (lens,)).types[0]
    return int(kind.ratio) - 1 + side - int(kind.span[0])


def _open(side: int, lenses: tuple[str, ...], matrix_of: MatrixOf) -> int:
    return observability(matrix_of(gallery(side, lenses))).null_space


def _one_rank(matrix_of: MatrixOf) -> Claim:
    found = {(side, lens): _open(side, (lens,), matrix_of) for side in SIDES for lens in THREE}
    axes = {(side, lens): _open_axis(side, lens) for side, lens in found}
    right = all(found[key] == 2 * a * key[0] - a**2 for key, a in axes.items())
    return Claim(
        "one type leaves a null space of 2aN - a^2 dimensions, a = m - 1 plus unseen pixels, N the tile's side",
        verdict(right),
        {f"{side} {lens} (a = {axes[side, lens]}): null space": count for (side, lens), count in found.items()},
    )


def _two_ranks(matrix_of: MatrixOf) -> Claim:
    pairs = list(combinations(THREE, 2))
    found = {(side, pair): _open(side, pair, matrix_of) for side in SIDES for pair in pairs}
    axes = {(side, pair): [_open_axis(side, lens) for lens in pair] for side, pair in found}
    all_three = {side: _open(side, THREE, matrix_of) for side in SIDES}
    right = all(found[key] == 2 * a * b for key, (a, b) in axes.items()) and not any(all_three.values())
    numbers: dict[str, float] = {
        f"{side} {'+'.join(pair)} (a = {axes[side, pair][0]}, b = {axes[side, pair][1]}): null space": count
        for (side, pair), count in found.items()
    }
    numbers |= {f"{side} {'+'.join(THREE)}: null space": count for side, count in all_three.items()}
    return Claim("two coprime types leave 2ab dimensions, three leave none", verdict(right), numbers)
