"""The claims of the paper (Wood, Rajan and Christensen), in words of this program, and claims of its own, checked.

Errors are expected squared errors per pixel (Eq. 5) in squared units of f; noise means its variance. Unless stated
otherwise the estimator expects the actual noise. Claims on photographs are checked by simulated reconstructions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf, isfinite

import numpy as np

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.methods.tile_solver import disjoint_tiles, merge_tiles, tile_posterior
from ommatid.reconstruct.prediction import observability
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.study import Row
from ommatid.simulate.ideal import ideal_matrix

from .photographs import WHOLE_BITS, Photograph, Trials
from .tile_errors import (
    ACTUAL,
    COMBINATIONS,
    COMPLETE_SIDES,
    EXPECTED,
    LEAST,
    SIDES,
    THREE,
    TWICE,
    TWO,
    PaperTile,
    Tiles,
    gallery,
    inner,
    tile,
)

YES, NO, QUALIFIED = "yes", "no", "with qualifications"
PAPER, OWN = "paper", "ommatid"  # sources of claims
CLAIMS = "claims.csv"
SAME = 1.1  # ratio of curves that cannot be distinguished on axes of eight decades
ABOUT_TEN = (8.0, 12.5)  # "about 10 times"
ORDER_OF_TEN = 3.0  # the least ratio of the order of magnitude of ten
SLIGHTLY = 0.8  # ratio of errors below which "slightly better" is too weak
LOUD, QUIET = 1.0, 0.1  # noise variances that the claims name


@dataclass(frozen=True)
class Claim:
    """A statement, the verdict (yes, no, with qualifications), its numbers, and the qualification.

    source : of the statement: the paper, or this program, which generalises the paper's ranks of H to formulas, and its
        comparison of trimmed tiles to the 35 x 35 tile
    figure : the figure that shows it, by the name of its file; empty without one
    """

    claim: str
    holds: str
    numbers: dict[str, float]
    remark: str = ""
    source: str = PAPER
    figure: str = ""

    @property
    def row(self) -> Row:
        """The claim as a row of claims.csv."""
        numbers = "; ".join(f"{name}: {number:.9g}" for name, number in self.numbers.items())
        names = {"claim": self.claim, "source": self.source, "figure": self.figure, "holds": self.holds}
        return {**names, "numbers": numbers, "remark": self.remark}


def shown_in(figure: str, claims: Iterable[Claim]) -> list[Claim]:
    """Return claims with the figure that shows them."""
    return [replace(claim, figure=figure) for claim in claims]


def verdict(holds: bool, qualified: bool = False) -> str:
    """Return the verdict in words."""
    return (QUALIFIED if qualified else YES) if holds else NO


def error_claims(tiles: Tiles) -> list[Claim]:
    """Check the claims on expected errors, by the figures that show them."""
    return [
        *shown_in("fig2", [check(tiles) for check in (_one_type, _two_types, _null_space, _three_types, _second_set)]),
        *shown_in("fig3", [_edges(tiles), _trimming(tiles), _relative_trimming(tiles, 19)]),
        *shown_in("fig4", [_larger_tile(tiles), _larger_tile_and_null_space(tiles), _relative_trimming(tiles, 35)]),
        *shown_in("fig5", [_longer_lenses(tiles)]),
        *shown_in("tile_sizes", [_joined(tiles)]),
    ]


def rank_claims() -> list[Claim]:
    """Check the claims on the null space of H."""
    return shown_in("fig1", [_one_rank(), _two_ranks()])


def _one_type(tiles: Tiles) -> Claim:
    ratios = {side: _largest_ratio(tiles[side, TWICE]) for side in COMPLETE_SIDES}
    floors = {side: tiles[side, TWICE].floor for side in COMPLETE_SIDES}
    qualified = ratios[35] > SAME
    remark = (
        f"not on the 35 x 35 tile: type I sees all of it, its floor is {floors[35]:.4g} and no longer {floors[19]:.4g},"
        " and noise of variance 1 shows above it"
    )
    return Claim(
        "two sets of type I: all estimators are indistinguishable and flat below noise 1",
        verdict(ratios[19] <= SAME, qualified),
        {f"{side}: largest error over smallest": ratio for side, ratio in ratios.items()},
        remark if qualified else "",
    )


def _largest_ratio(tile: PaperTile) -> float:
    """Return largest over smallest mean error of all estimators for noise up to 1, at the ends of straight lines."""
    lines = [tile.line(expected) for expected in EXPECTED]
    errors = [float(line.at(actual).mean()) for line in lines for actual in (LEAST, LOUD)]
    return max(errors) / min(errors)


def _two_types(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    better, never_cross = True, False
    for side in COMPLETE_SIDES:
        one_type, two_types = ([tiles[side, lenses].line(expected) for expected in EXPECTED] for lenses in (TWICE, TWO))
        crossings = [first.crossing(second) for first, second in zip(one_type, two_types, strict=True)]
        crossed = [noise for noise in crossings if isfinite(noise)]
        better &= min(crossings) > QUIET and all(
            first.prior.mean() > second.prior.mean() for first, second in zip(one_type, two_types, strict=True)
        )
        never_cross |= len(crossed) < len(crossings)
        if crossed:
            numbers |= {f"{side}: least noise at which they cross": min(crossed)}
            numbers |= {f"{side}: largest noise at which they cross": max(crossed)}
    remark = "two types remain better far beyond 0.1"
    remark += ", on the 35 x 35 tile for some estimators at any noise" if never_cross else ""
    return Claim(
        "two types are better than one (two sets of it) below noise 0.1",
        verdict(better, min(numbers.values(), default=inf) > 10 * QUIET),
        numbers,
        remark if better else "",
    )


def _null_space(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    holds = True
    for side in COMPLETE_SIDES:
        for lenses in (TWICE, TWO):
            tile, least = tiles[side, lenses], tiles[side, lenses].mse(LEAST)
            holds &= tile.floor > 0 and least < 1.001 * tile.floor
            numbers[f"{side} {tile.name}: error at noise 1e-6"] = least
            numbers[f"{side} {tile.name}: the prior's in the null space"] = tile.floor
    return Claim("one type or two: the null space keeps the error from improving at low noise", verdict(holds), numbers)


def _three_types(tiles: Tiles) -> Claim:
    knees = {
        (side, expected): tiles[side, THREE].line(expected).knee / expected
        for side in COMPLETE_SIDES
        for expected in EXPECTED
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
    for side in COMPLETE_SIDES:
        error = tiles[side, TWO].matched(LEAST)
        row, column = divmod(int(error.argmax()), side)
        distance = min(row, column, side - 1 - row, side - 1 - column)
        mean, trimmed = float(error.mean()), inner(error, side)
        holds &= distance < TRIM and trimmed < mean
        numbers[f"{side}: largest error"] = float(error.max())
        numbers[f"{side}: its distance from the border, pixels"] = distance
        numbers[f"{side}: mean"] = mean
        numbers[f"{side}: mean, trimmed by {TRIM}"] = trimmed
    return Claim(
        "two types: the error is largest at the tile's edges, and trimming lowers the average", verdict(holds), numbers
    )


def _trimming(tiles: Tiles) -> Claim:
    numbers: dict[str, float] = {}
    holds, qualified = True, False
    for side in COMPLETE_SIDES:
        error, tile = tiles[side, TWICE].matched(LEAST), tiles[side, TWICE]
        lens_type = tile.camera.types[0]
        first, seen = lens_type.origin[0], int(lens_type.span[0])
        view = error.reshape(side, side)[first : first + seen, first : first + seen].ravel()
        holds &= inner(view, seen, 1) >= view.mean()
        numbers[f"{side}: mean of the {seen} x {seen} pixels it sees"] = float(view.mean())
        numbers[f"{side}: trimmed by 1"] = inner(view, seen, 1)
        if seen < side:
            qualified = True
            numbers[f"{side}: mean of the whole tile"] = float(error.mean())
            numbers[f"{side}: whole tile trimmed by {TRIM}"] = inner(error, side)
    remark = "on the whole 19 x 19 tile trimming lowers the average: it removes pixels that type I does not see"
    return Claim(
        "type I alone: trimming does not lower the average",
        verdict(holds, qualified),
        numbers,
        remark if holds and qualified else "",
    )


def _larger_tile(tiles: Tiles) -> Claim:
    small, large = ([tiles[side, THREE].line(expected) for expected in EXPECTED] for side in COMPLETE_SIDES)
    ratios = [
        float(second.at(noise).mean() / first.at(noise).mean())
        for first, second in zip(small, large, strict=True)
        for noise in map(float, ACTUAL)
    ]
    holds, qualified = max(ratios) < 1, min(ratios) < SLIGHTLY
    return Claim(
        "three types: the 35 x 35 tile does slightly better than the 19 x 19",
        verdict(holds, qualified),
        {"error of 35 over error of 19, least": min(ratios), "largest": max(ratios)},
        "it does better by more than slightly" if holds and qualified else "",
    )


def _longer_lenses(tiles: Tiles) -> Claim:
    # The error of three types is proportional to small noise: ratios of error are ratios of noise.
    ratios = [tiles[41, THREE].mse(LEAST) / tiles[side, THREE].mse(LEAST) for side in COMPLETE_SIDES]
    holds = min(ratios) > ORDER_OF_TEN
    qualified = not all(ABOUT_TEN[0] <= ratio <= ABOUT_TEN[1] for ratio in ratios)
    return Claim(
        "41 x 41 with 1/5, 1/6 and 1/7 needs about 10 times less noise for the same error",
        verdict(holds, qualified),
        {f"times less than {side}": ratio for side, ratio in zip(COMPLETE_SIDES, ratios, strict=True)},
        "it needs less noise, but not ten times less" if holds and qualified else "",
    )


def _unseen(side: int, lens: str) -> int:
    """Return a: dimensions that a lens type leaves open along one axis, m - 1 plus the pixels it does not see."""
    lens_type = gallery(side, (lens,)).types[0]
    return int(lens_type.ratio) - 1 + side - int(lens_type.span[0])


def _nullity(side: int, lenses: tuple[str, ...]) -> int:
    return observability(ideal_matrix(gallery(side, lenses))).null_space


def _one_rank() -> Claim:
    nullities = {(side, lens): _nullity(side, (lens,)) for side in SIDES for lens in THREE}
    axes = {(side, lens): _unseen(side, lens) for side, lens in nullities}
    holds = all(nullities[key] == 2 * a * key[0] - a**2 for key, a in axes.items())
    return Claim(
        "one type leaves a null space of 2aN - a^2 dimensions, a = m - 1 plus unseen pixels, N the tile's side",
        verdict(holds),
        {f"{side} {lens} (a = {axes[side, lens]}): null space": count for (side, lens), count in nullities.items()},
        source=OWN,
    )


def _two_ranks() -> Claim:
    pairs = list(combinations(THREE, 2))
    nullities = {(side, pair): _nullity(side, pair) for side in SIDES for pair in pairs}
    axes = {(side, pair): [_unseen(side, lens) for lens in pair] for side, pair in nullities}
    all_three = {side: _nullity(side, THREE) for side in SIDES}
    holds = all(nullities[key] == 2 * a * b for key, (a, b) in axes.items()) and not any(all_three.values())
    numbers: dict[str, float] = {
        f"{side} {'+'.join(pair)} (a = {axes[side, pair][0]}, b = {axes[side, pair][1]}): null space": count
        for (side, pair), count in nullities.items()
    }
    numbers |= {f"{side} {'+'.join(THREE)}: null space": count for side, count in all_three.items()}
    return Claim("two coprime types leave 2ab dimensions, three leave none", verdict(holds), numbers, source=OWN)


EQUAL = 1e-9  # relative difference of errors that two methods compute in float64
JOINED_SIDE, PARTS = 35, 2  # of the tile that is cut into parts, and parts along either axis


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
        PAPER if side == 19 else OWN,
    )


def _larger_tile_and_null_space(tiles: Tiles) -> Claim:
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
    for side in COMPLETE_SIDES:
        one, two = tile(side, TWICE[:1]), tiles[side, TWICE]
        halved = [abs(two.mse(noise) / one.mse(noise / 2) - 1) for noise in map(float, ACTUAL)]
        holds &= max(halved) < EQUAL and one.rank == two.rank
        numbers[f"{side}: largest relative difference from one set at half the noise"] = max(halved)
        numbers[f"{side}: null space of one set"] = two.camera.unknowns - one.rank
        numbers[f"{side}: null space of two"] = two.camera.unknowns - two.rank
        numbers[f"{side}: error of two over error of one, noise {LEAST:g}"] = two.mse(LEAST) / one.mse(LEAST)
    return Claim("a second equal set of lenses only averages noise", verdict(holds), numbers)


def _joined(tiles: Tiles) -> Claim:
    """Compare a tile that Eq. 7 joins from four with the whole, and with the four before they are joined."""
    numbers: dict[str, float] = {}
    holds = True
    for lenses in (TWO, THREE):
        whole = tiles[JOINED_SIDE, lenses]
        half, problem = -(-whole.side // PARTS), _quiet(whole)
        tiles_of, recorded = disjoint_tiles(whole.camera.shape, (half, half)), np.zeros(problem.measurements)
        parts = [tile_posterior(problem, recorded, pixels).variance for pixels in tiles_of]
        apart, joined = float(np.concatenate(parts).mean()), merge_tiles(problem, recorded, tiles_of).variance
        difference = float(np.abs(joined / whole.matched(LEAST) - 1).max())
        holds &= difference < EQUAL and apart > whole.mse(LEAST)
        numbers[f"{whole.name}: error of four parts of the {whole.side} x {whole.side} tile"] = apart
        numbers[f"{whole.name}: joined"] = float(joined.mean())
        numbers[f"{whole.name}: error of the whole tile"] = whole.mse(LEAST)
        numbers[f"{whole.name}: largest relative difference of a pixel"] = difference
    return Claim("joining tiles by Eq. 7 brings what a larger tile brings", verdict(holds), numbers)


def _quiet(whole: PaperTile) -> Problem:
    """Return the problem of a tile at the least noise."""
    problem = whole.problem
    return replace(problem, noise_variance=LEAST * problem.noise_variance)


SIGMAS = 4.0  # standard errors that a ratio may be off, so that one of twenty ratios hardly ever is by chance


def photograph_claims(photograph: Photograph) -> list[Claim]:
    """Check the claims on quantisation and on photographs."""
    return shown_in("fig7", [_quantisation(photograph), _photographs(photograph)])


def _quantisation(photograph: Photograph) -> Claim:
    trials = photograph.quantised
    bits = [noise.bits or 0 for noise in trials.noises]
    ratios, errors = _noise_ratios(trials)
    off = np.flatnonzero(np.abs(ratios - 1) > SIGMAS * errors)
    first = bits[int(off[-1])] + 1 if off.size else bits[0]
    numbers = {
        f"error it causes over predicted at {count} bits": float(ratio)
        for count, ratio in zip(bits, ratios, strict=True)
    }
    whole = float(_noise_ratios(photograph.whole)[0].mean())
    numbers |= {"standard error at most": float(errors.max()), f"whole numbers, from {WHOLE_BITS} bits on": whole}
    holds = first <= WHOLE_BITS
    remark = (
        f"from {first} bits on: where a smooth image changes by less than a step, neighbours are rounded alike; pixels"
        f" that are whole numbers err {1 - whole:.0%} less from {WHOLE_BITS} bits on"
    )
    return Claim(
        "quantisation acts as added noise of variance step^2 / 12",
        verdict(holds, qualified=True),
        numbers,
        remark if holds else "",
    )


def _noise_ratios(trials: Trials) -> tuple[FloatArray, FloatArray]:
    """Return the error that the noise causes over what Eq. 5 predicts, (Q,), and its standard error."""
    ratios = trials.from_noise.mean(axis=1) / trials.noise_part
    return ratios, trials.spread / np.sqrt(trials.from_noise.shape[1])


def _photographs(photograph: Photograph) -> Claim:
    trials = photograph.noisy
    ratios = trials.mean / trials.predicted
    noise = np.array([table.variance for table in trials.noises])
    quiet, loud = noise <= QUIET, noise >= LOUD
    error = float(np.sqrt(np.mean(trials.spread[quiet] ** 2) / (quiet.sum() * trials.measured.shape[1])))
    holds = bool((ratios[loud] < 1).all()) and ratios[quiet].mean() < 1 + SIGMAS * error
    numbers = {
        f"measured over predicted at noise {noise[index]:g}": float(ratios[index]) for index in np.flatnonzero(loud)
    }
    numbers[f"mean up to noise {QUIET:g}"] = float(ratios[quiet].mean())
    numbers["its standard error"] = error
    remark = "a photograph is smoother than the prior, which helps where the prior decides; at low noise it is no help"
    return Claim("real photographs do somewhat better than predicted", verdict(holds), numbers, remark if holds else "")
